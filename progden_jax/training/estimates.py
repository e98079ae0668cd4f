"""Denoised images and divergences, computed once and kept on disk.

They depend on render, denoiser, method and seed alone, and cost far more than a step of training.
"""

import functools
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, cast

import jax
import numpy as np
from jaxtyping import Array, Float
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from progden_jax._files import replacing
from progden_jax._fingerprint import fingerprint
from progden_jax._numeric import safe_sqrt
from progden_jax.combiner.buffers import bound_parts
from progden_jax.compilation import cache_folder
from progden_jax.denoisers import Denoiser
from progden_jax.divergence import Method
from progden_jax.frame import Frame

_VERSION = 3
"""Part of every key: raise it when the arithmetic changes, so that old entries are left alone."""


class Estimate(NamedTuple):
    """y = f(x), and the divergence σ²·∂f/∂x as estimated, (H, W, 3) each; None without a method.

    `probe` and `tangent`, where asked for, are σ·s of other random signs s, and J·(σ·s).
    """

    denoised: Float[np.ndarray, "h w 3"]
    divergence: Float[np.ndarray, "h w 3"] | None = None
    probe: Float[np.ndarray, "h w 3"] | None = None
    tangent: Float[np.ndarray, "h w 3"] | None = None


def default_folder() -> Path:
    """Where estimates are kept unless said otherwise: a subfolder of the compilation cache."""
    return cache_folder() / "estimates"


class EstimateCache:
    """Estimates of one denoiser by one method, from disk where they are there.

    Parameters
    ----------
    denoiser, method : what estimates; no method: denoised images alone.
    folder : where to keep them, made if missing; by default `default_folder()`. Entries that are damaged
        are computed again. It may be deleted at any time. Nothing is kept for a denoiser that is a Python
        function, which cannot be told from another in the next process.
    tangents : also a probe and the denoiser's derivative along it, a third of the cost more.
    """

    def __init__(
        self,
        denoiser: Denoiser,
        method: Method | None,
        folder: str | os.PathLike[str] | None = None,
        *,
        tangents: bool = False,
    ) -> None:
        self.folder = default_folder() if folder is None else Path(folder)
        self.hits = self.misses = 0
        self._denoiser = denoiser
        self._method = method
        self._fields = Estimate._fields[: 1 if method is None else 4 if tangents else 2]
        kind, structure = type(denoiser).__qualname__, str(jax.tree.structure(denoiser))
        self.stores = " at 0x" not in structure
        self._settings = fingerprint(
            _VERSION, kind, structure, repr(method), self._fields, denoiser
        )

    def key(self, frame: Frame, seed: int) -> str:
        """Equal for equal buffers, denoiser (its weights included), method and seed; else different."""
        buffers = (frame.color, frame.variance, frame.albedo, frame.normal, frame.depth)
        return fingerprint(self._settings, seed, buffers)

    def get(self, frame: Frame, seed: int = 0) -> Estimate:
        """The estimate for a repaired frame; `seed` is of the random probes."""
        key, tangents = jax.random.key(seed), len(self._fields) > 2

        def make() -> tuple[Array, ...]:
            return _estimate(frame, self._denoiser, key, method=self._method, tangents=tangents)

        return Estimate(**self._kept(self.key(frame, seed), self._fields, frame.color.shape, make))

    def parts(
        self,
        frame: Frame,
        differences: Float[Array, "b h w 3"],
        shares: Float[Array, " b"],
    ) -> Float[np.ndarray, "b h w 3"]:
        """The denoised sub-averages of a repaired frame, see `progden_jax.combiner.of_buffers`."""
        key = fingerprint(self.key(frame, 0), differences, shares)

        def make() -> tuple[Array]:
            return (_denoised_parts(frame, self._denoiser, differences, shares),)

        return self._kept(key, ("denoised",), differences.shape, make)["denoised"]

    def _kept(
        self,
        key: str,
        fields: tuple[str, ...],
        shape: tuple[int, ...],
        make: Callable[[], tuple[Array, ...]],
    ) -> dict[str, np.ndarray]:
        """From disk where it is there and whole, else made, and kept where the denoiser allows it."""
        path = self.folder / f"{key}.safetensors"
        found = _read(path, fields, shape) if self.stores else None
        if found is not None:
            self.hits += 1
            return found
        self.misses += 1
        arrays = {name: np.asarray(a) for name, a in zip(fields, make(), strict=True)}
        if self.stores:
            self.folder.mkdir(parents=True, exist_ok=True)
            with replacing(path) as temporary:
                temporary.write_bytes(save(arrays, {"digest": fingerprint(*arrays.values())}))
        return arrays


class EstimateCaches:
    """Estimates of several denoisers at once: each array has an axis of them in front, (D, H, W, 3)."""

    def __init__(self, caches: Sequence[EstimateCache]) -> None:
        self.caches = tuple(caches)

    @property
    def hits(self) -> int:
        """How many estimates were on disk."""
        return sum(cache.hits for cache in self.caches)

    @property
    def misses(self) -> int:
        """How many were computed."""
        return sum(cache.misses for cache in self.caches)

    def get(self, frame: Frame, seed: int = 0) -> Estimate:
        """As `EstimateCache.get`."""
        found = [cache.get(frame, seed) for cache in self.caches]
        stacked = (None if a[0] is None else np.stack(a) for a in zip(*found, strict=True))
        return Estimate(*cast(Any, stacked))


def _read(
    path: Path, fields: tuple[str, ...], shape: tuple[int, ...]
) -> dict[str, np.ndarray] | None:
    try:
        with safe_open(path, "numpy") as file:
            digest = (file.metadata() or {})["digest"]
            arrays = {name: file.get_tensor(name) for name in fields}
    except (OSError, KeyError, SafetensorError):
        return None
    whole = all(a.shape == shape for a in arrays.values())
    return arrays if whole and fingerprint(*arrays.values()) == digest else None


@jax.jit
def _denoised_parts(frame: Frame, denoiser: Denoiser, differences: Array, shares: Array) -> Array:
    return bound_parts(denoiser, frame, differences, shares)(frame.color)


@functools.partial(jax.jit, static_argnames=("method", "tangents"))
def _estimate(
    frame: Frame, denoiser: Denoiser, key: jax.Array, *, method: Any, tangents: bool
) -> tuple[Array, ...]:
    f = denoiser.bind(frame)
    if method is None:
        return (f(frame.color),)
    assert frame.variance is not None
    y, divergence, *_ = method.evaluate(f, frame.color, frame.variance, key)
    if not tangents:
        return y, divergence
    signs = jax.random.rademacher(jax.random.fold_in(key, 2**31), y.shape, y.dtype)
    probe = safe_sqrt(frame.variance) * signs
    return y, divergence, probe, jax.jvp(f, (frame.color,), (probe,))[1]
