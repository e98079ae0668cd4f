"""The denoisers and mixers that settings name: loaded once per process, and told apart by what is in them."""

import functools
import importlib.util
import json
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp

from progden_jax import adaptation, combiner, denoisers, mixers
from progden_jax._fingerprint import fingerprint
from progden_jax.combiner import DeepCombiner
from progden_jax.denoisers import Denoiser, FunctionDenoiser
from progden_jax.denoisers._base import passable
from progden_jax.evaluation.settings import AUTO, DEFAULT, NONE, Settings
from progden_jax.frame import Frame
from progden_jax.mixing import Mixer

_AUTO = ("oidn-hdr", "oidn-hdr-alb", "oidn-hdr-alb-nrm")
"""What `denoisers.for_frame` chooses from."""


def denoiser_for(frame: Frame, settings: Settings) -> Denoiser:
    """The denoiser that the settings name, or that the frame's buffers call for."""
    name = settings.denoiser
    if name == AUTO:
        name = denoisers.for_frame(frame).name
    return _named(name, settings)


def _named(name: str, settings: Settings) -> Denoiser:
    denoiser = load_denoiser(name, settings.precision)
    if settings.combiner == NONE:
        return denoiser
    weights = _read_combiner(settings.combiner)
    return DeepCombiner(weights.params, passable(denoiser), weights.network)


def sub_averages(settings: Settings) -> int:
    """How many of a render the combiner takes; 1 without one."""
    if settings.image == "render" or settings.combiner == NONE:
        return 1
    count = _read_combiner(settings.combiner).network.buffers
    if count > 1 and settings.adaptation != NONE:
        raise ValueError(
            f"combiner is {settings.combiner}, which combines {count} sub-averages, and adaptation is "
            f"{settings.adaptation!r}, which fits to one image: set one of them to none."
        )
    return count


def adapted(frame: Frame, denoiser: Denoiser, settings: Settings) -> Denoiser:
    """The denoiser adapted to the render as the settings say, or as it is."""
    # Other numbers than the probes of the divergence.
    key = jax.random.fold_in(jax.random.key(settings.seed), 1)
    fitting, correction = settings.fit()
    if fitting is not None and correction is not None:
        return adaptation.correct_by_sure(
            frame, denoiser, correction=correction, adaptation=fitting, key=key
        ).adapted
    if fitting is not None:
        return adaptation.adapt(frame, denoiser, adaptation=fitting, key=key).adapted
    if correction is not None:
        halves_key, fit_key = jax.random.split(key)
        halves = adaptation.split(frame, halves_key)
        return adaptation.post_correct(
            halves, denoiser, correction=correction, key=fit_key
        ).denoiser
    return denoiser


def mixer_for(denoiser: Denoiser, settings: Settings) -> Mixer:
    """The mixer that the settings name, or that there is for the denoiser."""
    if settings.mixer == DEFAULT:
        return mixers.default_for(denoiser)
    if settings.mixer == mixers.CLOSED_FORM:
        return settings.closed_form
    return _load_mixer(settings.mixer)


@functools.lru_cache(maxsize=8)
def load_denoiser(name: str, precision: str) -> Denoiser:
    """A network by name or file of weights, or FILE.py:NAME, an object in a Python file.

    That object is a `Denoiser`, or a JAX function of the colour.

    Raises
    ------
    ValueError
        If there is no such name, file or object.
    """
    path, colon, attribute = name.rpartition(":")
    if not colon or not path.endswith(".py"):
        return denoisers.load(name, precision=precision)
    found: Any = getattr(_module(Path(path)), attribute, None)
    if not callable(found):
        raise ValueError(f"{name}: {path} has no function or denoiser {attribute!r}.")
    return found if isinstance(found, Denoiser) else FunctionDenoiser(cast(Any, found))


def content(settings: Settings) -> str:
    """A hash of the networks' weights and structure: what their names do not tell."""
    if settings.image == "render":
        return ""
    parts = [_denoiser_content(settings.denoiser, settings.precision)]
    if settings.combiner != NONE:
        weights = _read_combiner(settings.combiner)
        parts.append(fingerprint(weights.params, repr(weights.network)))
    if settings.image == "mix" and settings.mixer != mixers.CLOSED_FORM:
        chosen = _AUTO if settings.denoiser == AUTO else (settings.denoiser,)
        found = [mixer_for(_named(n, settings), settings) for n in chosen]
        parts += [fingerprint(_described(mixer)) for mixer in found]
    return fingerprint(parts)


def trained_as(settings: Settings) -> dict[str, Any]:
    """How the named mixing network was trained, by dotted name: the estimator and its probes."""
    if settings.image != "mix" or settings.mixer in (DEFAULT, mixers.CLOSED_FORM):
        return {}
    metadata = getattr(_load_mixer(settings.mixer), "metadata", {})
    try:
        trained = json.loads(metadata["config"])
    except (KeyError, ValueError):
        return {}
    return {f"mixer.trained.{n}": trained[n] for n in ("method", "probes", "seed") if n in trained}


_read_combiner = functools.lru_cache(maxsize=8)(combiner.read)

_load_mixer = functools.lru_cache(maxsize=8)(mixers.load)


@functools.lru_cache(maxsize=32)
def _denoiser_content(name: str, precision: str) -> str:
    if name == AUTO:
        return fingerprint([_denoiser_content(n, precision) for n in _AUTO])
    denoiser = load_denoiser(name, precision)
    if not isinstance(denoiser, denoisers.Network):
        # A function cannot be told from another by its name; what it computes can.
        buffers = [jax.ShapeDtypeStruct((64, 64, 3), jnp.float32)] * 4
        return fingerprint(jax.make_jaxpr(lambda *given: denoiser(Frame(*given)))(*buffers))
    return fingerprint(_described(denoiser))


def _described(network: Any) -> tuple[Any, ...]:
    return type(network).__qualname__, str(jax.tree.structure(network)), network


def _module(path: Path) -> Any:
    spec = importlib.util.spec_from_file_location(f"_progden_{path.stem}", path)
    if spec is None or spec.loader is None or not path.is_file():
        raise ValueError(f"{path}: there is no such Python file.")
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise ValueError(f"{path} cannot be imported: {type(error).__name__}: {error}") from error
    return module
