"""What mixing gains over denoisers of one's own, one per input set (paper, Table 1).

python -m experiments.table1.run [--denoisers NAME_OR_FILE ...] [--mixers NAME_OR_FILE ...]
"""

from collections.abc import Sequence
from pathlib import Path

import progden_jax as pd
from experiments import _common, _mixes
from experiments._mixes import Mix
from progden_jax import denoisers, mixers

DENOISERS = ("unet-hdr", "unet-hdr-var", "unet-hdr-alb-nrm", "unet-hdr-alb-nrm-var")
MODELS = {
    "den": "denoised",
    "pro-den": "mix",
    "closed form": "closed form",
    "oracle": "oracle",
    "mc-render": "render",
}
"""Names in the table -> images."""


def there(which: str) -> bool:
    """Whether the denoiser of that name or file exists."""
    return which in denoisers.names() or Path(which).is_file()


def means(title: str, errors: _mixes.Errors) -> list[tuple]:
    """The paper's rows: averages over scenes and spp, and shares of the oracle's gain over the denoiser."""
    return [
        (
            title if model == "den" else "",
            model,
            *(_mixes.mean(errors, image, label) for label in _mixes.METRICS),
            *(_mixes.share(errors, image, label) for label in _mixes.METRICS),
        )
        for model, image in MODELS.items()
    ]


def main(description: str | None = __doc__, chosen: Sequence[str] = DENOISERS) -> None:
    parser = _mixes.parser(description)
    parser.add_argument("--denoisers", nargs="*", default=chosen, help="names or files")
    parser.add_argument(
        "--mixers", nargs="*", help="one per denoiser; by default what is shipped for it"
    )
    arguments = parser.parse_args()
    given = arguments.mixers or [None] * len(arguments.denoisers)
    if len(given) != len(arguments.denoisers):
        parser.error(f"{len(given)} mixers for {len(arguments.denoisers)} denoisers: give one each")
    names = _common.begin(arguments)

    found: dict[str, _mixes.Errors] = {}
    for which, mixer_name in zip(arguments.denoisers, given, strict=True):
        if not there(which):
            known = ", ".join(denoisers.names())
            print(f"skipped {which}: neither a file nor one of {known}\n", flush=True)
            continue
        denoiser = pd.denoisers.load(which)
        mixer = mixers.load(mixer_name) if mixer_name else mixers.default_for(denoiser)
        mixes = {"closed form": Mix(pd.ClosedForm()), "mix": Mix(mixer)}
        title = f"{which} ({mixer if isinstance(mixer, pd.ClosedForm) else 'its mixer'})"
        series = _common.series(arguments.data, names, arguments.spp)
        found[title] = _mixes.measure(denoiser, mixes, series)
    if not found:
        raise SystemExit("no denoiser to measure: give --denoisers NAME_OR_FILE.")
    shares = (f"{label}: of the oracle's gain" for label in _mixes.METRICS)
    lines = [row for title, errors in found.items() for row in means(title, errors)]
    print(_common.markdown(("inputs", "model", *_mixes.METRICS, *shares), lines))
    for title, errors in found.items():
        print(f"\n## {title}\n\n{_mixes.summary(errors, ['closed form', 'mix'])}", flush=True)


if __name__ == "__main__":
    main()
