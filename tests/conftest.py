"""What many tests share: real frames, small random images, and counts of compilations."""

import functools
import gc
import os
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import code_generation
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import progden_jax as pd
from progden_jax.compilation import counting_compilations as counting_compilations
from progden_jax.denoisers import unet

with pytest.MonkeyPatch.context() as without:
    # Both import PyTorch where there is one: seconds in every process, for nothing that is tested.
    without.setitem(sys.modules, "torch", None)
    import pyoidn  # noqa: F401
    import tensorboardX  # noqa: F401

DEMO = Path(pd.__file__).parent / "data" / "demo"

# `metrics.flip` sets it too, but too late where a test imports FLIP first: its threads spin for 0.1 s a call.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

# Next to nothing of what is imported for the tests is garbage, and little of what JAX traces: looking takes
# seconds, so it is done rarely.
gc.disable()


def pytest_collection_finish():
    gc.freeze()
    gc.set_threshold(10_000)
    gc.enable()


# XLA reads its flags when it first compiles; workers have them from the process that started them.
if "PYTEST_XDIST_WORKER" not in os.environ:
    code_generation.choose()


@pytest.fixture(scope="session")
def real_frame() -> pd.Frame:
    """A 128×128 render at 8 samples per pixel, all buffers in NumPy: parts of them are no programs of JAX."""
    return jax.tree.map(np.asarray, pd.read_exr(sorted(DEMO.glob("*_000008spp.exr"))[0]))


@pytest.fixture(scope="session")
def near_sighted() -> pd.Denoiser:
    """A denoiser small enough to look only a few pixels far."""
    return pd.denoisers.KPCN.init(jax.random.key(0), layers=2, width=8)


@pytest.fixture
def images() -> SimpleNamespace:
    """A random noisy image x (13×18), a smoother y, a variance with zeros, a divergence, float32."""
    rng = np.random.default_rng(7)
    x = rng.gamma(1.0, 1.0, (13, 18, 3)).astype(np.float32)
    variance = (0.1 * x**2 * rng.random(x.shape)).astype(np.float32)
    variance[rng.random(x.shape[:2]) < 0.2] = 0
    y = (0.6 * x + 0.4 * x.mean((0, 1))).astype(np.float32)
    divergence = (variance * rng.normal(0.3, 0.2, x.shape)).astype(np.float32)
    return SimpleNamespace(x=x, y=y, variance=variance, divergence=divergence)


divergence = jax.jit(pd.divergence, static_argnames=("f", "method"))
divergence_and_error = jax.jit(pd.divergence_and_error, static_argnames=("f", "method"))
"""Compiled whole, for functions that are no pytrees: run eagerly, each operation becomes a program."""


def drawn(form: Any, seed: int = 0) -> Any:
    """Weights of these shapes, kernels normal with variance 1 / fan-in, biases zero.

    By NumPy: programs of `jax.random` for many layers take longest of all to compile.
    """
    rng = np.random.default_rng(seed)

    def one(like: jax.ShapeDtypeStruct) -> np.ndarray:
        scale = np.prod(like.shape[:-1]) ** -0.5 if len(like.shape) > 1 else 0.0
        return (scale * rng.normal(size=like.shape)).astype(like.dtype)

    return jax.tree.map(one, form)


def narrow_oidn(
    inputs: tuple[str, ...] = (), *, size: str = "small", width: int = 6
) -> pd.denoisers.OIDN:
    """OIDN's layers, few channels wide and random: as far-sighted as its networks, and quick."""
    *hidden, last = unet.shapes(size)
    shapes = dict.fromkeys(hidden, (3, width)) | {last: (3, 3)}
    he = functools.partial(
        pd.denoisers.UNet.he_params, inputs=inputs, nodes=unet.graph(shapes), shapes=shapes
    )
    params = drawn(jax.eval_shape(he, jax.random.key(0)))
    for layer in params.values():
        layer["kernel"] *= np.float32(2**0.5)
    params[last]["bias"] += np.float32(0.3)  # a ReLU follows
    return pd.denoisers.OIDN(params, inputs)


def dense_jacobian_diagonal(f, x: np.ndarray) -> np.ndarray:
    """∂f_pc/∂x_pc in float64 from the whole Jacobian."""
    with jax.enable_x64(True):
        # The unit vectors are an argument: as constants XLA would fold them through the whole of f.
        @jax.jit
        def diagonal(x, units):
            return jax.lax.map(lambda unit: jnp.vdot(jax.jvp(f, (x,), (unit,))[1], unit), units)

        units = np.eye(x.size).reshape(x.size, *x.shape)
        return np.asarray(diagonal(np.asarray(x, np.float64), units)).reshape(x.shape)
