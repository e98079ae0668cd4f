"""What a denoiser alone takes for one frame, the first time and again.

    python -m experiments.performance.denoisers [--denoiser nfor oidn-hdr] [--size 1024x1024]

The frame is made of renders side by side, with albedo and normals.
"""

import time
from typing import Any

import jax

import progden_jax as pd
from experiments import _common
from experiments.performance.programs import load_frame
from experiments.performance.run import size_of


def seconds(run: Any) -> tuple[float, float]:
    """Of one call, by the clock and by processor time."""
    clock, processor = time.perf_counter(), time.process_time()
    jax.block_until_ready(run())
    return time.perf_counter() - clock, time.process_time() - processor


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
        for what in ("first", "again"):
            clock, processor = seconds(lambda d=denoiser: pd.denoise(frame, d).image)
            rows.append((name, what, f"{clock:.1f}", f"{processor:.1f}"))
    print(_common.markdown(("denoiser", "call", "s", "processor s"), rows))


if __name__ == "__main__":
    main()
