"""Training configurations: typed, frozen, from TOML or YAML, by name or file."""

import dataclasses
import difflib
import os
import tomllib
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar, cast

from progden_jax import _checks
from progden_jax.training.losses import LOG_RELMSE, SUPERVISED

Meaning = Literal["mean", "samples", "std", "second-moment"]
"""What variance channels hold, see `progden_jax.read_exr`."""

_FOLDER = Path(__file__).parent / "configs"


@dataclasses.dataclass(frozen=True)
class RunConfig:
    """What training a mixer, a denoiser and a combiner have in common."""

    steps: int  # of the optimiser, the whole one-cycle schedule
    data: tuple[str, ...] = ()  # folders of NAME_SSSSSSspp.exr, searched with their subfolders
    spp: tuple[int, ...] = ()  # samples per pixel to train on; none: all but the reference's
    reference_spp: int = 0  # of the reference; 0: the highest of each scene
    variance_of: Meaning = "mean"  # what variance channels hold
    held_out: float = 0.15  # share of scenes kept for evaluation, chosen by a hash of their names
    held_out_scenes: tuple[str, ...] = ()  # or these scenes instead
    batch: int = 12  # crops per step
    crop: int = 128  # side of a crop in pixels, at most the images' size
    flips: bool = True  # mirror crops at random, left-right and top-bottom
    turns: bool = True  # turn crops by random quarters
    permute_colors: bool = True  # random order of red, green and blue
    exposure_stops: float = 0.0  # radiance times 2^u, u uniform between minus and plus this
    depth_stops: float = 0.0  # depth likewise: scenes have units of their own
    loss: str = "smape"  # smape, relmse, l1, logl1, log-errors, or sure (no reference needed)
    peak_rate: float = 1e-3  # highest learning rate of the cycle
    warmup: float = 0.3  # share of steps until the peak
    start_divisor: float = 25.0  # first rate: the peak over this
    end_divisor: float = 1e4  # last rate: the first over this
    rates: tuple[float, ...] = ()  # learning rates of stages, instead of one cycle
    rate_steps: tuple[int, ...] = ()  # at which the stages after the first begin
    weight_decay: float = 0.0  # decoupled, per unit of learning rate
    clip_norm: float = 1.0  # of the whole gradient; 0: not clipped
    ema: float = 0.0  # decay of the averaged weights that are evaluated and saved; 0: the last ones
    precision: str = "default"  # of products: default (TF32 on GPUs), high or highest (float32)
    start: str = ""  # weights to train on from, a shipped name or a file; none: random ones
    seed: int = 0  # of weights, order and augmentation
    log_every: int = 50  # steps between points of the training curves
    evaluate_every: int = 500  # steps between evaluations on the held-out scenes
    checkpoint_every: int = 500  # steps between checkpoints
    patience: int = 0  # evaluations without a better score until training stops; 0: never

    def __post_init__(self) -> None:
        for name in ("steps", "batch", "crop", "log_every", "evaluate_every", "checkpoint_every"):
            _checks.positive_int(name, getattr(self, name))
        _within(self, "held_out", 0, 1, "a share of the scenes", closed=False)
        _within(self, "warmup", 0, 1, "a share of the steps", closed=False)
        _within(self, "ema", 0, 1, "a decay below 1, such as 0.999")
        for name in ("exposure_stops", "depth_stops", "weight_decay", "clip_norm"):
            _within(self, name, 0, float("inf"), "a number from 0 up")
        for name in ("reference_spp", "patience", "seed"):
            _within(self, name, 0, 2**32, "a whole number from 0 up")
        for name in ("peak_rate", "start_divisor", "end_divisor"):
            _within(self, name, 0, float("inf"), "a number above 0", closed=False)
        _check_stages(self.rates, self.rate_steps)
        _checks.choice("loss", self.loss, (*SUPERVISED, LOG_RELMSE, "log-errors", "sure"))
        _checks.choice("precision", self.precision, ("default", "high", "highest"))


@dataclasses.dataclass(frozen=True)
class MixerConfig(RunConfig):
    """How to train a mixing network for one denoiser, or for several."""

    denoiser: str = "oidn-hdr"  # whose output is mixed in: name or weights file, or NAME+COMBINER
    further: tuple[str, ...] = ()  # more denoisers, each render's image by one of all at random
    method: str = "monte-carlo"  # of the divergence behind SURE, as `progden denoise --method`
    probes: int = 1  # of that method, where it takes them
    draws: int = 1  # divergences with probes of other seeds per image, one at random each time
    architecture: str = "paper"  # see progden_jax.mixers.ARCHITECTURES
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # its settings
    swap: float = 0.5  # probability of swapping (x, σ²) with (y, SURE)
    bound: bool = False  # train through the t-bound, which else is for inference only
    sure_derivative: str = "held"  # loss sure: α held constant, or its derivative by a probe
    score: str = "balanced"  # what decides the best weights: smape, rmse, or the mean of both

    def __post_init__(self) -> None:
        super().__post_init__()
        _checks.positive_int("probes", self.probes)
        _checks.positive_int("draws", self.draws)
        _within(self, "swap", 0, 1, "a probability")
        _checks.choice("score", self.score, ("balanced", "smape", "rmse"))
        _checks.choice("sure_derivative", self.sure_derivative, ("held", "probe"))


@dataclasses.dataclass(frozen=True)
class DenoiserConfig(RunConfig):
    """How to train a denoiser."""

    architecture: str = "unet"  # see progden_jax.denoisers.ARCHITECTURES
    inputs: tuple[str, ...] = ()  # buffers besides the colour, as the architecture takes them
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # as size of a unet
    probes: int = 1  # loss sure: of the divergence, drawn anew each step
    weights_dtype: str = "float32"  # of the weights file; float16 halves it, to three digits

    def __post_init__(self) -> None:
        super().__post_init__()
        _checks.positive_int("probes", self.probes)
        _checks.choice("weights_dtype", self.weights_dtype, ("float32", "float16"))
        for role in self.inputs:
            _checks.choice("inputs", role, ("albedo", "normal", "depth", "variance"))


@dataclasses.dataclass(frozen=True)
class CombinerConfig(RunConfig):
    """How to train a deep combiner."""

    denoiser: str = "nfor"  # name or weights file of the denoiser whose images are combined
    buffers: int = 1  # sub-averages that are combined; made of nested renders, see the guide
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # of its KernelNetwork
    loss: str = "relmse"  # as the paper; smape, relmse, l1, logl1, or log-relmse
    weights_dtype: str = "float32"  # of the weights file; float16 halves it, to three digits

    def __post_init__(self) -> None:
        super().__post_init__()
        _checks.positive_int("buffers", self.buffers)
        _checks.choice("loss", self.loss, (*SUPERVISED, LOG_RELMSE))
        _checks.choice("weights_dtype", self.weights_dtype, ("float32", "float16"))


Config = TypeVar("Config", bound=RunConfig)
Built = TypeVar("Built")


def names(kind: type[RunConfig]) -> tuple[str, ...]:
    """The names that `load` knows for this kind of training."""
    return tuple(sorted(p.stem for p in _folder(kind).glob("*.toml")))


def load(
    kind: type[Config], name: str | os.PathLike[str], changes: Mapping[str, Any] | None = None
) -> Config:
    """The configuration of that name or file (.toml, .yaml), with some fields changed.

    A file may begin from another configuration: base = "cpu", or a path beside it.

    Raises
    ------
    ValueError
        If there is no such configuration, or a field is unknown, lacking, or of the wrong type.
    """
    values = _values(kind, os.fspath(name), Path(), ())
    return build(kind, {**values, **(changes or {})}, source=f"configuration {os.fspath(name)}")


def build(kind: type[Built], values: Mapping[str, Any], *, source: str) -> Built:
    """The dataclass with these fields, checked; `source` is for messages."""
    fields = {f.name: f for f in dataclasses.fields(cast(Any, kind))}
    hints = typing.get_type_hints(kind)
    for name in values:
        if name not in fields:
            close = difflib.get_close_matches(name, fields, n=1)
            hint = f"did you mean {close[0]!r}?" if close else f"known are {', '.join(fields)}."
            raise ValueError(f"{source}: there is no field {name!r}; {hint}")
    for name, field in fields.items():
        required = field.default is field.default_factory is dataclasses.MISSING
        if required and name not in values:
            raise ValueError(f"{source}: the field {name!r} is lacking.")
    try:
        return kind(**{name: _typed(name, v, hints[name]) for name, v in values.items()})
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from None


def parse_change(text: str, kind: type) -> tuple[str, Any]:
    """The field and value of a "field=value", the value as in TOML; quotes around text may be left out."""
    name, equals, value = text.partition("=")
    if not equals:
        raise ValueError(f"{text!r} is no field=value, such as peak_rate=1e-3.")
    name, value = name.strip(), value.strip()
    if typing.get_type_hints(kind).get(name) is str and not value.startswith(('"', "'")):
        return name, value
    try:
        return name, tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return name, value


def read(path: Path) -> dict[str, Any]:
    """The fields in a configuration file, as they stand there.

    Raises
    ------
    ValueError
        If there is no such file, it does not end in .toml, .yaml or .yml, or holds something else.
    """
    if path.suffix not in _READERS:
        raise ValueError(f"{path} is no configuration: it must end in {', '.join(_READERS)}.")
    try:
        values = _READERS[path.suffix](path)
    except FileNotFoundError:
        raise ValueError(f"{path}: there is no such file.") from None
    if not isinstance(values, dict):
        raise ValueError(f"{path} holds no fields, such as steps = 1000.")
    return values


def _values(
    kind: type[RunConfig], name: str, beside: Path, seen: tuple[str, ...]
) -> dict[str, Any]:
    if name in seen:
        raise ValueError(f"configurations begin from each other: {' → '.join((*seen, name))}.")
    if name in names(kind):
        path = _folder(kind) / f"{name}.toml"
    else:
        path = beside / name
        if path.suffix not in _READERS:
            raise ValueError(
                f"config is {name!r}, expected one of {', '.join(names(kind))}, or a file that ends in "
                f"{', '.join(_READERS)}."
            )
    values = read(path)
    base = values.pop("base", None)
    if base is None:
        return values
    return {**_values(kind, str(base), path.parent, (*seen, name)), **values}


def _folder(kind: type[RunConfig]) -> Path:
    for known in (MixerConfig, CombinerConfig):
        if issubclass(kind, known):
            return _FOLDER / known.__name__.removesuffix("Config").lower()
    return _FOLDER / "denoiser"


def _toml(path: Path) -> Any:
    try:
        return tomllib.loads(path.read_text())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is no TOML: {error}") from None


def _yaml(path: Path) -> Any:
    try:
        import yaml
    except ImportError:
        raise ValueError(
            f"{path}: reading YAML needs PyYAML: pip install pyyaml, or write TOML."
        ) from None
    try:
        return yaml.safe_load(path.read_text())
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is no YAML: {' '.join(str(error).split())}") from None


_READERS = {".toml": _toml, ".yaml": _yaml, ".yml": _yaml}


def _typed(name: str, value: Any, hint: Any) -> Any:
    """`value` as the field's type, where that loses nothing."""
    if typing.get_origin(hint) is Literal:
        _checks.choice(name, value, typing.get_args(hint))
        return value
    if typing.get_origin(hint) is types.UnionType:
        (inner,) = (each for each in typing.get_args(hint) if each is not types.NoneType)
        return None if value is None else _typed(name, value, inner)
    if typing.get_origin(hint) is tuple:
        (element, *_) = typing.get_args(hint)
        if not isinstance(value, list | tuple):
            raise ValueError(f"{name} is {value!r}, expected a list of {_WORDS[element]}.")
        return tuple(_typed(f"an element of {name}", v, element) for v in value)
    if typing.get_origin(hint) is not None:
        if not isinstance(value, Mapping):
            raise ValueError(f"{name} is {value!r}, expected a table of settings.")
        return types.MappingProxyType(dict(value))
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if type(value) is not hint:
        raise ValueError(f"{name} is {value!r}, expected {_WORDS[hint]}.")
    return value


_WORDS = {int: "a whole number", float: "a number", str: "text", bool: "true or false"}


def _within(
    config: Any, name: str, low: float, high: float, what: str, *, closed: bool = True
) -> None:
    value = getattr(config, name)
    if not (low <= value <= high if closed else low < value < high):
        raise ValueError(f"{name} is {value}, expected {what}.")


def _check_stages(rates: tuple[float, ...], steps: tuple[int, ...]) -> None:
    rising = all(a < b for a, b in zip((0, *steps), steps, strict=False))
    if len(steps) != max(len(rates) - 1, 0) or not rising:
        raise ValueError(
            f"rate_steps is {steps} and rates is {rates}, expected rising steps, one less than the rates."
        )
    if not all(0 < rate < float("inf") for rate in rates):
        raise ValueError(f"rates is {rates}, expected numbers above 0.")
