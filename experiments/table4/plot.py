"""What each part of the method is worth: errors by spp without it (paper, Table 4).

    progden sweep experiments/table4/sweep.yaml -o runs/table4-found      # needs no training
    python -m experiments.table4.train                                    # into runs/table4
    progden sweep experiments/table4/trained.yaml -o runs/table4-found
    python -m experiments.table4.plot runs/table4-found

A method called "NAME, without PART" is an ablation of the one called NAME.
"""

import json
from collections.abc import Sequence
from pathlib import Path

import progden_jax as pd
from experiments import _common, _plots
from progden_jax.evaluation import Row


def budgets(rows: Sequence[Row]) -> str:
    """What was trained for it: how long, and how it did on scenes held out of train/."""
    files = {row.method: Path(str(row.settings.get("mixer"))) for row in rows}
    lines = []
    for method, path in files.items():
        if path.is_file() and (said := getattr(pd.load_mixer(path), "metadata", {})).get("config"):
            kept = f"{said['steps']} of {json.loads(said['config'])['steps']}"
            lines.append((method, kept, float(said["score"]), said["commit"]))
    header = ("run", "best step", "held-out score", "commit")
    return f"{_common.markdown(header, lines)}\n\n" if lines else ""


def ordering(rows: Sequence[Row], whole: str, ablations: Sequence[str]) -> str:
    """Where a part left out makes it worse, as the paper finds, and by how much."""
    lines, spps = [], sorted({row.spp for row in rows})
    for metric, title in _plots.METRICS.items():
        means = _plots.over_scenes(rows, metric)
        for name in ablations:
            changes = (f"{means[name][spp] / means[whole][spp] - 1:+.2%}" for spp in spps)
            lines.append((title, name, *changes))
    header = ("over the whole method's", "ablation", *(f"{spp} spp" for spp in spps))
    return _common.markdown(header, lines)


def draw(rows: Sequence[Row], output: Path) -> str:
    """Tables alone."""
    parts = []
    for own in _plots.by_denoiser(rows).values():
        parts.append(f"{budgets(own)}{_plots.summary(own)}")
        every = _plots.methods(own)
        for whole in every:
            ablations = [name for name in every if name.startswith(f"{whole}, ")]
            if ablations:
                parts.append(f"## {whole}\n\n{ordering(own, whole, ablations)}")
    return "\n\n".join(parts)


def main() -> None:
    _plots.command(__doc__, Path(__file__).parent, draw)


if __name__ == "__main__":
    main()
