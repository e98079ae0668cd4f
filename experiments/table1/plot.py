"""What mixing gains over denoisers of one's own, one per input set (paper, Table 1).

progden sweep experiments/table1/sweep.yaml -o runs/table1
python -m experiments.table1.plot runs/table1
"""

from collections.abc import Sequence
from pathlib import Path

from experiments import _common, _plots
from progden_jax.evaluation import Row

MODELS = {
    "den": "denoised",
    "pro-den": "mix",
    "closed form": "mix closed-form",
    "oracle": "oracle",
    "mc-render": "render",
}
"""Names in the paper's table -> methods."""


def means(title: str, rows: Sequence[Row]) -> list[tuple]:
    """The paper's rows: averages over scenes and spp, and shares of the oracle's gain over the denoiser."""
    found = {metric: _plots.over_scenes(rows, metric) for metric in _plots.METRICS}
    gained = {metric: _plots.shares(rows, metric) for metric in _plots.METRICS}
    lines = []
    for model, method in MODELS.items():
        by_spp = {metric: found[metric].get(method) for metric in _plots.METRICS}
        if None in by_spp.values():
            continue
        averages = (
            sum(values[spp] for spp in chosen) / len(chosen)
            for values in by_spp.values()
            if values is not None
            for chosen in [_plots.from_least(values)]
        )
        shared = (f"{gained[metric].get(method, float('nan')):.1%}" for metric in _plots.METRICS)
        lines.append((title if model == "den" else "", model, *averages, *shared))
    return lines


def draw(rows: Sequence[Row], output: Path) -> str:
    """Tables alone."""
    groups = _plots.by_denoiser(rows)
    titles = _plots.METRICS.values()
    header = ("inputs", "model", *titles, *(f"{title}: of the oracle's gain" for title in titles))
    lines = [line for denoiser, own in groups.items() for line in means(denoiser, own)]
    details = (f"## {denoiser}\n\n{_plots.summary(own)}" for denoiser, own in groups.items())
    return "\n\n".join([_common.markdown(header, lines), *details])


def main(description: str | None = __doc__) -> None:
    _plots.command(description, Path(__file__).parent, draw)


if __name__ == "__main__":
    main()
