"""What mixing gains over OIDN, beside the closed form and what an oracle could gain (paper, Table 3).

python -m experiments.table3.run [--mixers NAME_OR_FILE ...]
"""

import progden_jax as pd
from experiments import _common, _mixes
from experiments._mixes import Mix
from progden_jax import mixers

WINDOWS = (7, 15, 31)
"""Of the paper's closed form; the best of them is what a mixer must beat."""


def main() -> None:
    parser = _mixes.parser(__doc__)
    parser.add_argument("--denoisers", nargs="*", default=("oidn-hdr", "oidn-hdr-alb-nrm"))
    parser.add_argument("--mixers", nargs="*", help="names or files; by default what is shipped")
    arguments = parser.parse_args()
    names = _common.begin(arguments)
    for which in arguments.denoisers:
        denoiser = pd.denoisers.load(which)
        chosen = arguments.mixers or ([which] if which in mixers.names() else [])
        mixes = {"closed form": Mix(pd.ClosedForm())}
        mixes |= {f"paper's closed form, {w}×{w}": Mix(pd.ClosedForm(w, 0.0)) for w in WINDOWS}
        mixes |= {f"mix by {name}": Mix(pd.load_mixer(name)) for name in chosen}
        series = _common.series(arguments.data, names, arguments.spp)
        errors = _mixes.measure(denoiser, mixes, series)
        print(f"## {which}\n\n{_mixes.summary(errors, list(mixes))}\n", flush=True)


if __name__ == "__main__":
    main()
