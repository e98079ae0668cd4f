"""Which methods on which renders: configurations expanded, and each result given the key it is kept by."""

import dataclasses
import hashlib
import itertools
import json
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import progden_jax
from progden_jax.evaluation import parts
from progden_jax.evaluation import settings as names
from progden_jax.evaluation.settings import Settings
from progden_jax.training import config
from progden_jax.training.config import Meaning
from progden_jax.training.index import Item, earlier, index

RESULTS = 2
"""Part of every key: raise it when the arithmetic behind a result changes."""

PRESETS: dict[str, dict[str, Any]] = {
    "render": {"image": "render"},
    "denoised": {"image": "denoised"},
    "mix": {"image": "mix"},
    "closed-form": {"image": "mix", "mixer": "closed-form"},
    "unbounded": {"image": "mix", "bound": False},
    "paper": {"image": "mix", "estimator": "finite-difference", "probes": 4},
    "oracle": {"image": "oracle"},
}
"""Methods that a list can name."""

DEFAULT_METHODS = ("render", "denoised", "mix", "closed-form")

_FILES = {
    "denoiser": (".tza", ".safetensors"),
    "combiner": (".safetensors",),
    "mixer": (".safetensors",),
}
"""Settings that may be paths, and what these end in."""


class Method(NamedTuple):
    """Settings, and the label that people see."""

    label: str
    settings: Settings


class Cell(NamedTuple):
    """A row that is wanted: one method on one render."""

    key: str
    item: Item
    method: Method


@dataclasses.dataclass(frozen=True)
class Data:
    """The renders that a configuration names."""

    data: tuple[str, ...] = ()  # folders of NAME_SSSSSSspp.exr, searched with their subfolders
    spp: tuple[int, ...] = ()  # samples per pixel; none: all but the reference's
    scenes: tuple[str, ...] = ()  # only these
    reference_spp: int = 0  # of the reference; 0: the highest of each scene
    variance_of: Meaning = "mean"  # what variance channels hold
    crop: int = 0  # side in pixels of the centre square that is looked at; 0: the whole images
    keep_images: tuple[int, ...] = ()  # samples per pixel whose images are kept unasked

    def __post_init__(self) -> None:
        if self.crop < 0:
            raise ValueError(
                f"crop is {self.crop}, expected a side in pixels, or 0 for the whole images."
            )

    def items(self) -> list[Item]:
        """The renders, with absolute paths, sorted by scene and samples per pixel."""
        found = index(self.data, spp=self.spp, reference_spp=self.reference_spp)
        known = {item.scene for item in found}
        if unknown := sorted(set(self.scenes) - known):
            raise ValueError(
                f"scenes names {', '.join(unknown)}; there are {', '.join(sorted(known))}."
            )
        return [
            item._replace(path=item.path.resolve(), reference=item.reference.resolve())
            for item in found
            if not self.scenes or item.scene in self.scenes
        ]


class Plan:
    """All rows that are wanted.

    Parameters
    ----------
    data : names the renders.
    methods : of distinct settings and labels.
    """

    def __init__(self, data: Data, methods: Sequence[Method]) -> None:
        self.data = data
        self.methods = tuple(methods)

    @cached_property
    def items(self) -> list[Item]:
        """The renders."""
        return self.data.items()

    def cells(self) -> list[Cell]:
        """Every method on every render; reads the files, for their contents are part of the keys."""
        shared = {method.label: _method_key(method) for method in self.methods}
        digests: dict[Path, str] = {}

        def digest(path: Path) -> str:
            if path not in digests:
                with path.open("rb") as file:
                    digests[path] = hashlib.file_digest(file, "sha256").hexdigest()
            return digests[path]

        cells = []
        for item in self.items:
            files = [digest(item.path), digest(item.reference), self.data.variance_of]
            if self.data.crop:
                files.append(f"crop {self.data.crop}")
            for method in self.methods:
                own = earlier(item, parts.sub_averages(method.settings)).values()
                read = [*files, *map(digest, own)]
                key = _hash([shared[method.label], item.scene, item.spp, *read])
                cells.append(Cell(key, item, method))
        return cells


def load(
    source: Path | None,
    *,
    data: Mapping[str, Any] | None = None,
    base: Mapping[str, Any] | None = None,
    methods: Sequence[str] = (),
) -> Plan:
    """The plan of a configuration file (.yaml, .toml), or the built-in one.

    The file has the fields of `Data` and these: ``base``, settings that all methods share; ``grid``, setting
    -> values, of which every combination is a method (or a list of such grids); ``list``, one method each:
    names of `PRESETS`, or settings, with a ``label`` if wanted. Paths in it are relative to it. Settings that
    do not matter to a method make no second one of it.

    Parameters
    ----------
    data, base : over the file's; paths relative to the working folder.
    methods : names of `PRESETS`, instead of the file's grid and list.

    Raises
    ------
    ValueError
        If a field, setting or value is unknown; says which, and what could be there.
    """
    values = {} if source is None else config.read(source)
    where = "the command line" if source is None else str(source)
    folder = Path() if source is None else source.parent
    shared = _mapping(values.pop("base", {}), f"{where}: base")
    grids, listed = values.pop("grid", None), values.pop("list", None)
    if source is not None:
        shared = _anchored(shared, folder)
        if isinstance(values.get("data"), str):
            values["data"] = [values["data"]]
        if isinstance(values.get("data"), list):
            values["data"] = [str(folder / str(d)) for d in values["data"]]
    shared |= _anchored(names.flatten(base or {}), Path())
    if methods:
        grids, listed = None, list(methods)
    elif grids is None and listed is None:
        listed = list(DEFAULT_METHODS)
    chosen = [
        *_listed(listed if listed is not None else [], shared, folder, f"{where}: list"),
        *_grids(grids, shared, folder, f"{where}: grid"),
    ]
    made = config.build(Data, {**values, **(data or {})}, source=where)
    return Plan(made, _distinct(chosen, where))


def _listed(
    entries: Any, shared: dict[str, Any], folder: Path, where: str
) -> Iterable[tuple[str | None, Settings]]:
    if not isinstance(entries, list):
        raise ValueError(f"{where} is {entries!r}, expected a list of methods.")
    for number, entry in enumerate(entries, 1):
        source = f"{where}, entry {number}"
        if isinstance(entry, str):
            if entry not in PRESETS:
                raise ValueError(
                    f"{source} is {entry!r}, expected settings or one of {', '.join(PRESETS)}."
                )
            yield None, names.parse({**shared, **PRESETS[entry]}, source=source)
            continue
        own = _mapping(entry, source)
        label = own.pop("label", None)
        if label is not None and not isinstance(label, str):
            raise ValueError(f"{source}: label is {label!r}, expected text.")
        yield label, names.parse({**shared, **_anchored(own, folder)}, source=source)


def _grids(
    grids: Any, shared: dict[str, Any], folder: Path, where: str
) -> Iterable[tuple[str | None, Settings]]:
    if grids is None:
        return
    for grid in grids if isinstance(grids, list) else [grids]:
        axes = _mapping(grid, where)
        for name, choices in axes.items():
            if not isinstance(choices, list) or not choices:
                raise ValueError(
                    f"{where}: {name} is {choices!r}, expected a list of values, such as [{choices}]."
                )
        for combination in itertools.product(*axes.values()):
            own = _anchored(dict(zip(axes, combination, strict=True)), folder)
            yield None, names.parse({**shared, **own}, source=where)


def _distinct(chosen: Iterable[tuple[str | None, Settings]], where: str) -> list[Method]:
    """Each method once, and no label twice."""
    found: dict[str, Method] = {}
    for label, settings in chosen:
        same = json.dumps(settings.flat())
        if same not in found or label is not None:
            found[same] = Method(label or settings.label(), settings)
    by_label: dict[str, Settings] = {}
    for method in found.values():
        if method.label in by_label:
            raise ValueError(
                f"{where}: two methods are called {method.label!r}; give them labels of their own in `list`."
            )
        by_label[method.label] = method.settings
    if not found:
        raise ValueError(f"{where}: there is no method; fill in grid or list.")
    return list(found.values())


def _mapping(value: Any, where: str) -> dict[str, Any]:
    if not isinstance(value, Mapping):
        raise ValueError(f"{where} is {value!r}, expected settings, such as probes: 4.")
    return names.flatten(value)


def _anchored(values: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Paths of files made absolute; names of what is shipped stay."""
    found = dict(values)
    for name, endings in _FILES.items():
        value = found.get(name)
        if not isinstance(value, str):
            continue
        if value.endswith(endings) or (name == "denoiser" and ".py:" in value):
            found[name] = str((folder / value).resolve())
    return found


def _method_key(method: Method) -> str:
    """A file counts by what is in it, not by where it lies."""
    told = method.settings.flat()
    for name in _FILES:
        told.pop(name, None)
    version = (progden_jax.__version__, RESULTS)
    return _hash([version, method.label, told, parts.content(method.settings)])


def _hash(document: Any) -> str:
    return hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()
