"""Denoised images and divergences, computed once and kept on disk.

They depend on the render, the denoiser, the method and its seed alone, and cost far more than a training step.
"""

import functools
import hashlib
import os
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from progden_jax._files import replacing
from progden_jax.compilation import cache_folder
from progden_jax.denoisers import Denoiser
from progden_jax.divergence import Method
from progden_jax.frame import Frame

_VERSION = 1
"""Part of every key: raise it when the arithmetic changes, so that old entries are left alone."""


class Estimate(NamedTuple):
    """y = f(x), and the divergence σ²·∂f/∂x as estimated, (H, W, 3) each.

    `probe` and `tangent` are one more σ·s of random signs s, and J·(σ·s): what a derivative along it needs.
    """

    denoised: Float[np.ndarray, "h w 3"]
    divergence: Float[np.ndarray, "h w 3"]
    probe: Float[np.ndarray, "h w 3"]
    tangent: Float[np.ndarray, "h w 3"]


def default_folder() -> Path:
    """Where estimates are kept unless said otherwise: a subfolder of the compilation cache."""
    return cache_folder() / "estimates"


class EstimateCache:
    """Estimates of one denoiser by one method, from disk where they are there.

    Parameters
    ----------
    denoiser, method : what estimates.
    folder : where to keep them, made if missing; by default `default_folder()`. Entries that are damaged
        are computed again. It may be deleted at any time.
    """

    def __init__(
        self,
        denoiser: Denoiser,
        method: Method,
        folder: str | os.PathLike[str] | None = None,
    ) -> None:
        self.folder = default_folder() if folder is None else Path(folder)
        self.hits = self.misses = 0
        self._denoiser = denoiser
        self._method = method
        self._settings = _digest(
            _VERSION, type(denoiser).__qualname__, str(jax.tree.structure(denoiser)), repr(method)
        )
        for leaf in jax.tree.leaves(denoiser):
            self._settings = _digest(self._settings, np.asarray(leaf))

    def key(self, frame: Frame, seed: int) -> str:
        """Equal for equal buffers, denoiser (its weights included), method and seed; else different."""
        buffers = (frame.color, frame.variance, frame.albedo, frame.normal, frame.depth)
        return _digest(self._settings, seed, *buffers)

    def get(self, frame: Frame, seed: int = 0) -> Estimate:
        """The estimate for a repaired frame; `seed` is of the random probes."""
        path = self.folder / f"{self.key(frame, seed)}.safetensors"
        shape = frame.color.shape
        found = _read(path, shape)
        if found is not None:
            self.hits += 1
            return found
        self.misses += 1
        made = _estimate(frame, self._denoiser, jax.random.key(seed), method=self._method)
        made = Estimate(*(np.asarray(a, np.float32) for a in made))
        self.folder.mkdir(parents=True, exist_ok=True)
        tensors = made._asdict()
        with replacing(path) as temporary:
            temporary.write_bytes(save(tensors, {"digest": _digest(*made)}))
        return made


@functools.partial(jax.jit, static_argnames="method")
def _estimate(
    frame: Frame, denoiser: Denoiser, key: jax.Array, *, method: Any
) -> tuple[Array, ...]:
    from progden_jax._numeric import safe_sqrt

    f = denoiser.bind(frame)
    assert frame.variance is not None
    y, divergence, *_ = method.evaluate(f, frame.color, frame.variance, key)
    signs = jax.random.rademacher(jax.random.fold_in(key, 2**31), y.shape, y.dtype)
    probe = safe_sqrt(frame.variance) * signs
    return y, divergence, probe, jax.jvp(f, (frame.color,), (probe,))[1]


def _read(path: Path, shape: tuple[int, ...]) -> Estimate | None:
    try:
        with safe_open(path, "numpy") as file:
            digest = (file.metadata() or {})["digest"]
            found = Estimate(*(file.get_tensor(name) for name in Estimate._fields))
    except (OSError, KeyError, SafetensorError):
        return None
    whole = all(a.shape == shape and a.dtype == np.float32 for a in found)
    return found if whole and _digest(*found) == digest else None


def _digest(*parts: Any) -> str:
    hashed = hashlib.blake2b(digest_size=20)
    for part in parts:
        if hasattr(part, "dtype"):
            array = np.ascontiguousarray(part)
            hashed.update(f"{array.dtype}{array.shape};".encode())
            hashed.update(array.data)
        else:
            hashed.update(f"{part!r};".encode())
    return hashed.hexdigest()
