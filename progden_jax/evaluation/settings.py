"""What determines a method's results besides the files: its settings, by flat dotted names."""

import dataclasses
import difflib
import functools
from collections.abc import Collection, Mapping
from types import MappingProxyType
from typing import Any, Literal

from progden_jax import _checks
from progden_jax.adaptation import Adaptation, PostCorrection
from progden_jax.denoisers import PRECISIONS
from progden_jax.divergence import FiniteDifference, Method
from progden_jax.mixers import CLOSED_FORM
from progden_jax.mixing import ClosedForm
from progden_jax.training import config
from progden_jax.training.mixer_task import METHODS, WITHOUT_PROBES
from progden_jax.tstatistic import Bound

AUTO = "auto"
"""The denoiser that `denoisers.for_frame` chooses."""

DEFAULT = "default"
"""The mixer that `mixers.default_for` chooses."""

NONE = "none"
"""No estimate of the divergence, so no SURE; no combiner; no adaptation."""


@dataclasses.dataclass(frozen=True)
class Settings:
    """One method; see `names` for how its settings are called."""

    image: Literal["mix", "denoised", "render", "oracle"] = "mix"  # what is compared with the truth
    denoiser: str = (
        AUTO  # a name, a file of weights, FILE.py:FUNCTION, or auto: OIDN's by the buffers
    )
    combiner: str = NONE  # a name or a file of weights of a deep combiner behind it; or none
    precision: str = "highest"  # of the denoiser's products
    adaptation: Literal["none", "sure", "post-correct", "sure-correct"] = "none"  # to the render
    fitting: Adaptation = dataclasses.field(default_factory=Adaptation)
    correction: PostCorrection = dataclasses.field(default_factory=PostCorrection)
    estimator: str = "monte-carlo"  # of the divergence, as `progden denoise --method`; or none
    probes: int = 1  # of that estimator
    epsilon: float = 1e-4  # of finite differences
    seed: int = 0  # of the probes, and of all that an adaptation draws
    mixer: str = DEFAULT  # a name, a file of weights, closed-form, or default: the denoiser's
    closed_form: ClosedForm = dataclasses.field(default_factory=ClosedForm)
    bound: bool = True  # whether α is bounded
    limits: Bound = dataclasses.field(default_factory=Bound)
    risk_probes: int = 0  # for SURE of the mix through the whole chain; 0: with α held constant

    def __post_init__(self) -> None:
        _checks.choice("precision", self.precision, PRECISIONS)
        _checks.choice("estimator", self.estimator, (*METHODS, NONE))
        _checks.positive_int("probes", self.probes)
        if not 0 <= self.seed < 2**32:
            raise ValueError(f"seed is {self.seed}, expected 0 to {2**32 - 1}.")
        if self.risk_probes < 0:
            raise ValueError(
                f"risk_probes is {self.risk_probes}, expected a whole number from 0 up."
            )
        if self.estimator == NONE and self.image == "mix":
            raise ValueError(
                "estimator is 'none' and image is 'mix': mixing needs SURE, and so a divergence; choose an "
                "estimator, or image: denoised."
            )
        self.method()

    def method(self) -> Method | None:
        """The estimator of the divergence."""
        if self.estimator == NONE:
            return None
        made = METHODS[self.estimator](self.probes)
        if isinstance(made, FiniteDifference):
            return dataclasses.replace(made, epsilon=self.epsilon)
        return made

    def estimate(self) -> tuple[Any, ...]:
        """What determines the denoised image and the divergence; methods with equal ones share them."""
        drawn = self.method() is not None or self.adaptation != NONE
        return (*self.program(), self.seed if drawn else 0)

    def program(self) -> tuple[Any, ...]:
        """What determines the compiled program that makes these."""
        return (self.denoiser, self.combiner, self.precision, self.method(), self.fit())

    def fit(self) -> tuple[Adaptation | None, PostCorrection | None]:
        """How the denoiser is adapted: by SURE, by a correction behind it, by SURE of that, or not at all."""
        by_sure = self.adaptation in ("sure", "sure-correct")
        corrected = self.adaptation in ("post-correct", "sure-correct")
        return self.fitting if by_sure else None, self.correction if corrected else None

    def flat(self) -> dict[str, Any]:
        """The settings that matter to this method, by name, the defaults too."""
        used = ["image"]
        if self.image != "render":
            used += ["denoiser", "precision", "estimator"]
            if self.combiner != NONE:
                used.append("combiner")
            # Runs from before there was any stay as they are.
            used += ["adaptation"] if self.adaptation != NONE else []
            probed = self.estimator not in (NONE, *WITHOUT_PROBES)
            used += ["probes"] if probed else []
            used += ["seed"] if probed or self.adaptation != NONE else []
            if self.estimator == "finite-difference":
                used.append("epsilon")
        if self.image == "mix":
            used += ["mixer", "bound"]
        values: dict[str, Any] = {name: getattr(self, name) for name in used}
        mixed, shown = self.image == "mix", self.image != "render"
        fitting, correction = self.fit()
        relevant = {
            "adaptation": shown and fitting is not None,
            "correction": shown and correction is not None,
            "mixer": mixed and self.mixer == CLOSED_FORM,
            "bound": mixed and self.bound,
        }
        for prefix in relevant:
            if relevant[prefix]:
                values |= _inner(prefix, self)
        if mixed and self.risk_probes:
            values["risk_probes"] = self.risk_probes
        return values

    def label(self, without: Collection[str] = ()) -> str:
        """A name for people: what is not as by default, but for some settings.

        Files go by the last two parts of their paths.
        """
        values = {name: value for name, value in self.flat().items() if name not in without}
        usual = names()
        parts = [self.image]
        parts += [
            _short(v) for n in ("denoiser", "mixer") if (v := values.get(n, usual[n])) != usual[n]
        ]
        if any(values.get(n, usual[n]) != usual[n] for n in ("estimator", "probes")):
            probes = f"({self.probes})" if "probes" in values else ""
            parts.append(f"{values.get('estimator', '')}{probes}")
        if not values.get("bound", True):
            parts.append("unbounded")
        said = ("image", "denoiser", "mixer", "estimator", "probes", "bound")
        parts += [f"{n}={_word(v)}" for n, v in values.items() if n not in said and v != usual[n]]
        return " ".join(parts)


_GROUPS: dict[str, tuple[str, type]] = {
    "adaptation": ("fitting", Adaptation),
    "correction": ("correction", PostCorrection),
    "mixer": ("closed_form", ClosedForm),
    "bound": ("limits", Bound),
}
"""Prefixes of dotted names -> the field that has them, and its type."""


def _inner(prefix: str, settings: Settings) -> dict[str, Any]:
    """The settings below that prefix, by full name, as JSON has them."""
    values = dataclasses.asdict(getattr(settings, _GROUPS[prefix][0]))
    return {
        f"{prefix}.{name}": list(value) if isinstance(value, tuple) else value
        for name, value in values.items()
    }


@functools.cache
def names() -> Mapping[str, Any]:
    """The names of all settings, with their defaults."""
    inner = {field for field, _ in _GROUPS.values()}
    usual = Settings()
    found = {
        f.name: getattr(usual, f.name) for f in dataclasses.fields(Settings) if f.name not in inner
    }
    for prefix in _GROUPS:
        found |= _inner(prefix, usual)
    return MappingProxyType(found)


def flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """{"bound": {"c": 3}} as {"bound.c": 3}."""
    found = {}
    for name, value in values.items():
        full = f"{prefix}{name}"
        found |= flatten(value, f"{full}.") if isinstance(value, Mapping) else {full: value}
    return found


def parse(values: Mapping[str, Any], *, source: str) -> Settings:
    """The settings with these dotted names, the others by default; `source` is for messages.

    Raises
    ------
    ValueError
        If a name is unknown, or a value of the wrong type or out of range.
    """
    known = names()
    for name in values:
        if name not in known:
            close = difflib.get_close_matches(str(name), known, n=1)
            hint = f"did you mean {close[0]!r}?" if close else f"known are {', '.join(known)}."
            raise ValueError(f"{source}: there is no setting {name!r}; {hint}")
    plain = {name: value for name, value in values.items() if "." not in name}
    made = config.build(Settings, plain, source=source)
    for prefix, (field, kind) in _GROUPS.items():
        inner = {
            name.removeprefix(f"{prefix}."): value
            for name, value in values.items()
            if name.startswith(f"{prefix}.")
        }
        part = config.build(kind, inner, source=f"{source}: {prefix}")
        made = dataclasses.replace(made, **{field: part})
    return made


def _short(value: str) -> str:
    """A path as its last two parts, without what it ends in."""
    if "/" not in value:
        return value
    return "/".join(value.removesuffix(".safetensors").removesuffix(".tza").split("/")[-2:])


def _word(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:g}" if isinstance(value, float) else _short(str(value))
