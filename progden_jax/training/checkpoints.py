"""Checkpoints that are whole or not there, and what they belong to."""

import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Any

import jax

from progden_jax._files import replacing
from progden_jax.training.config import RunConfig
from progden_jax.training.step import State

_FREE = ("log_every", "evaluate_every", "checkpoint_every")


class Checkpoints:
    """The states of one training run on disk, the two latest of them, by orbax.

    Orbax writes beside and renames, so that a kill at any moment leaves the one before.

    Parameters
    ----------
    folder : of the run, made if missing.
    """

    def __init__(self, folder: Path) -> None:
        try:
            import orbax.checkpoint as ocp
        except ImportError:
            raise ValueError(
                "training needs orbax-checkpoint for its checkpoints: pip install 'progden_jax[train]'."
            ) from None
        self._ocp = ocp
        options = ocp.CheckpointManagerOptions(max_to_keep=2, enable_async_checkpointing=False)
        self._manager = ocp.CheckpointManager(
            (folder / "checkpoints").absolute(),
            options=options,
        )

    def save(self, state: State) -> None:
        """Write the state; one of the same step counts as written."""
        step = int(state.step)
        if step not in self._manager.all_steps():
            self._manager.save(step, args=self._ocp.args.StandardSave(_named(state)))

    def restore(self, like: State) -> State | None:
        """The latest state, or None; `like` gives its form."""
        step = self._manager.latest_step()
        if step is None:
            return None
        form = {
            name: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=leaf.sharding)
            for name, leaf in _named(like).items()
        }
        leaves = self._manager.restore(step, args=self._ocp.args.StandardRestore(form))
        return jax.tree.unflatten(jax.tree.structure(like), [leaves[name] for name in form])

    def close(self) -> None:
        """Wait for what is being written."""
        self._manager.close()


def _named(state: State) -> dict[str, jax.Array]:
    """The leaves under numbers: weights may be held in classes that orbax does not know."""
    return {f"{n:04}": leaf for n, leaf in enumerate(jax.tree.leaves(state))}


def describe(kind: str, config: RunConfig, items: Any) -> dict[str, Any]:
    """What a run is made of, as plain JSON."""
    fields = plain(config)
    files = [(item.scene, item.spp, item.path.stat().st_size) for item in items]
    digest = hashlib.blake2b(repr(files).encode(), digest_size=8).hexdigest()
    fields.pop("data")
    return {"kind": kind, "config": fields, "renders": digest}


def claim(folder: Path, description: dict[str, Any], defaults: dict[str, Any]) -> None:
    """Mark the folder as that of this run, or check that it is.

    `defaults` are those of fields, for a run of a version that did not have them yet.

    Raises
    ------
    ValueError
        If another run is there: it cannot be gone on with.
    """
    path = folder / "run.json"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        with replacing(path) as temporary:
            temporary.write_text(json.dumps(description, indent=2) + "\n")
        return
    there = json.loads(path.read_text())
    differing = [
        f"{name} is {new!r} and was {old!r}"
        for name, new in description["config"].items()
        if name not in _FREE and new != (old := {**defaults, **there["config"]}.get(name))
    ]
    differing += [f"the {k} differ" for k in ("kind", "renders") if there.get(k) != description[k]]
    if differing:
        raise ValueError(
            f"{folder} holds a run with other settings ({'; '.join(differing)}): go on with its own, or "
            "choose another folder."
        )


def plain(config: RunConfig) -> dict[str, Any]:
    """The configuration as plain JSON."""
    return {name: _plain(value) for name, value in vars(config).items()}


def defaults_of(config: RunConfig) -> dict[str, Any]:
    """What fields are where nothing is said, as plain JSON."""
    fields = dataclasses.fields(config)
    return {f.name: _plain(f.default) for f in fields if f.default is not dataclasses.MISSING}


def _plain(value: Any) -> Any:
    if isinstance(value, tuple):
        return list(value)
    return dict(value) if hasattr(value, "items") else value
