"""What a denoiser alone takes for one frame, the first time and again.

    python -m experiments.performance.denoisers [--denoiser nfor oidn-hdr] [--size 1024x1024]

The frame is made of renders side by side, with albedo and normals.
"""

import math

import progden_jax as pd
from experiments import _common
from experiments.performance.programs import FORWARD, Program, load_frame
from experiments.performance.run import size_of, take_turns


def main() -> None:
    parser = _common.parser(__doc__)
    parser.set_defaults(data=_common.TRAIN, scenes=4)
    parser.add_argument("--denoiser", nargs="+", default=("nfor",))
    parser.add_argument("--size", default="1024x1024", help="WIDTHxHEIGHT")
    parser.add_argument("--spp", type=int, default=32)
    arguments = parser.parse_args()
    names = _common.begin(arguments, f"{arguments.spp} spp, {arguments.size}")
    frame, _ = load_frame(arguments.data, names, arguments.spp, size_of(arguments.size))
    rows = []
    for name in arguments.denoiser:
        denoiser = pd.denoisers.load(name)
        turn = Program(FORWARD, None, name, lambda d=denoiser: pd.denoise(frame, d).image)
        (times,) = take_turns([turn], rounds=2, budget=math.inf)
        for what, (clock, processor) in zip(("first", "again"), times, strict=True):
            rows.append((name, what, f"{clock:.1f}", f"{processor:.1f}"))
    print(_common.markdown(("denoiser", "call", "s", "processor s"), rows))


if __name__ == "__main__":
    main()
