"""Adaptation by SURE and post-correction in equal time: errors, and ratios to post-correction's.

progden sweep experiments/adaptation/equal_time.yaml -o runs/equal_time
python -m experiments.adaptation.equal_time runs/equal_time
"""

from collections.abc import Sequence
from pathlib import Path

from experiments import _common, _plots
from progden_jax.evaluation import Row, statistics

MIXED = ", mixed"
BASELINE = "post-correction"


def draw(rows: Sequence[Row], output: Path) -> str:
    """Means over scenes, ratios to post-correction on the same renders, and all rows as a CSV."""
    columns = ("relmse", "rmse", "smape", "sure", "denoised_mse", "seconds")
    _common.write_csv(
        output / "equal_time.csv",
        ("scene", "spp", "method", *columns),
        ((r.scene, r.spp, r.method, *(getattr(r, c) for c in columns)) for r in rows),
    )
    table = statistics.means(rows, "relmse")
    header = [f"{spp} spp" for spp in statistics.spps(table)]
    means = [(m, *(found.mean for found in by.values())) for m, by in table.items()]
    return "\n\n".join(
        [_common.markdown(("relMSE", *header), means), *(ratios(rows, s) for s in ("", MIXED))]
    )


def ratios(rows: Sequence[Row], suffix: str) -> str:
    """Geometric means over scenes, and how many of the renders are better off than with post-correction."""
    baseline = BASELINE + suffix
    own = [row for row in rows if row.method.endswith(MIXED) == bool(suffix)]
    table = statistics.relative_to(own, baseline, "relmse")
    before = {(r.scene, r.spp): r.relmse for r in own if r.method == baseline}
    lines = []
    for method, by_spp in table.items():
        pairs = [(r.relmse, before.get((r.scene, r.spp))) for r in own if r.method == method]
        known = [(a, b) for a, b in pairs if a is not None and b is not None]
        better = f"{sum(a < b for a, b in known)} of {len(known)}"
        lines.append((method, *(found.mean for found in by_spp.values()), better))
    header = [f"{spp} spp" for spp in statistics.spps(table)]
    return _common.markdown((f"over {baseline}", *header, "better"), lines)


def main() -> None:
    _plots.command(__doc__, Path(__file__).parent, draw)


if __name__ == "__main__":
    main()
