"""Curves of a run, as TensorBoard events and as JSON lines."""

import json
from collections.abc import Mapping
from pathlib import Path

from progden_jax._files import replacing


class Curves:
    """Writes scalars of a run to `folder`/curves.jsonl and, for TensorBoard, `folder`/tensorboard.

    Parameters
    ----------
    step : what was written beyond this step, by a run that was killed later, is dropped.
    """

    def __init__(self, folder: Path, step: int) -> None:
        try:
            from tensorboardX import SummaryWriter
        except ImportError:
            raise ValueError(
                "training needs tensorboardX for its curves: pip install 'progden_jax[train]'."
            ) from None
        path = folder / "curves.jsonl"
        if path.exists():
            kept = [line for line in path.read_text().splitlines() if _step(line) <= step]
            with replacing(path) as temporary:
                temporary.write_text("".join(f"{line}\n" for line in kept))
        self._lines = path.open("a")
        self._events = SummaryWriter(str(folder / "tensorboard"), purge_step=step + 1)

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Add these values at this step."""
        for name, value in values.items():
            self._events.add_scalar(name, value, step)
        self._lines.write(json.dumps({"step": step, **values}) + "\n")
        self._lines.flush()

    def close(self) -> None:
        """Write what is still held."""
        self._lines.close()
        self._events.close()


def _step(line: str) -> float:
    try:
        return json.loads(line)["step"]
    except (ValueError, KeyError):
        return float("inf")
