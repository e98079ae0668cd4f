"""Several devices, and several processes: the results of one."""

import os
import socket
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import Mesh

import progden_jax as pd
from progden_jax import _amx, _devices
from progden_jax.training.config import RunConfig
from progden_jax.training.step import make_start, make_step


def job(shape=(150, 90)):
    """A frame with bad pixels, partly right, and what to do with it."""
    rng = np.random.default_rng(0)
    color = rng.gamma(1.0, 1.0, (*shape, 3)).astype(np.float32)
    variance = (0.1 * color).astype(np.float32)
    variance[: 2 * shape[0] // 3] = 0
    color[100:102, 7] = np.nan
    network = pd.denoisers.KPCN.init(jax.random.key(0), layers=1, width=4)
    how = {"mixer": pd.ClosedForm(window=7), "key": jax.random.key(3)}
    return pd.Frame(color, variance), network, how


def run(function, count, flag="", **environment):
    """A function of this module in processes of their own, for devices are fixed when JAX starts."""
    environment = {
        **os.environ,
        "JAX_PLATFORMS": "cpu",
        "PYTHONPATH": os.pathsep.join(sys.path),
        "XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} {flag}",
        **environment,
    }
    command = [sys.executable, "-c", f"import sys, test_devices as t; t.{function}(sys.argv[1])"]
    started = [
        subprocess.Popen([*command, str(i)], env=environment, cwd=Path(__file__).parent)
        for i in range(count)
    ]
    try:
        assert [process.wait(timeout=300) for process in started] == [0] * count
    finally:
        for process in started:
            process.kill()


def assert_same(found, expected):
    for name in ("image", "alpha", "denoised", "sure"):
        image = getattr(found, name)
        if image is not None:
            np.testing.assert_allclose(image, getattr(expected, name), rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(found.mean_alpha, expected.mean_alpha, rtol=1e-4, atol=1e-7)
    assert list(map(int, found.repairs)) == list(map(int, expected.repairs))


def test_simulated_devices():
    run("on_three_devices", 1, flag="--xla_force_host_platform_device_count=3")


def on_three_devices(_):
    training_on_two_is_training_on_one()
    devices = jax.devices()
    assert len(devices) == 3
    frame, network, how = job()
    whole = pd.progressive_denoise(frame, network, **how)
    how["outputs"] = ("image", "alpha")
    over = pd.progressive_denoise(frame, network, **how, devices=devices, skip=False)
    assert_same(over, whole)
    assert 150 * 90 < over.skipped.computed < 1.6 * 150 * 90
    some = pd.progressive_denoise(frame, network, **how, devices=devices)
    assert some.skipped.pixels > 0
    np.testing.assert_allclose(some.image, whole.image, rtol=1e-5, atol=1e-5)

    frames = [frame, job((145, 93))[0], frame, job((147, 90))[0]]
    frames[2] = pd.Frame(np.nan_to_num(frame.color), np.zeros_like(frame.color))
    batch = list(pd.denoise_batch(frames, network, **how))
    how["outputs"] = None
    for found, given in zip(batch, frames, strict=True):
        assert_same(found, pd.progressive_denoise(given, network, **how))
    assert [result.skipped.computed > 0 for result in batch] == [True, True, False, True]


def test_the_program_for_gpus():
    run("for_gpus", 1)


def for_gpus(_):
    """As far as it goes without one: the whole lowers, and its convolutions are as precise as asked for."""
    jax.default_backend = lambda: "gpu"
    frame, _, how = job((48, 64))
    for precision, said in (
        ("highest", "HIGHEST>"),
        ("tensorfloat32", "HIGH>"),
        ("bfloat16", "xbf16>"),
    ):
        network = pd.denoisers.load("oidn-hdr-small", precision=precision)
        export = jax.export.export(jax.jit(pd.progressive_denoise), platforms=["cuda"])
        text = export(frame, network, **how).mlir_module()
        found = [line for line in text.splitlines() if "stablehlo.convolution" in line]
        assert len(found) >= 2 * len(network.params)
        assert all(said in line for line in found), found[0]
        assert _amx.TARGET not in text


class Line:
    """A line to fit to noisy points of a line."""

    kind, items = "line", range(0)
    config = RunConfig(steps=5, batch=4, log_every=5, evaluate_every=9)
    arrays: ClassVar = {"x": np.linspace(0, 1, 8, dtype=np.float32)}

    def init(self, key):
        return {"slope": jnp.zeros(()), "offset": jnp.zeros(())}

    def example(self, arrays, index, key):
        x = arrays["x"][index]
        return {"x": x, "y": 3 * x + 0.1 * jax.random.normal(key)}

    def loss(self, params, batch):
        error = params["slope"] * batch["x"] + params["offset"] - batch["y"]
        return (error**2).mean(), {}


def training_on_two_is_training_on_one():
    """The same examples, the same weights but for rounding."""
    states = []
    for count in (1, 2):
        devices = jax.devices()[:count]
        assert len(devices) == count
        step = make_step(Line(), Mesh(np.asarray(devices), ("batch",)) if count > 1 else None)
        state = make_start(Line())(jax.random.key(0))
        for _ in range(5):
            state, scalars = step(state, Line.arrays, jax.random.key(1), jnp.asarray([0, 3, 5, 7]))
        states.append((state.params, scalars))
    one, two = (jax.tree.map(np.asarray, s) for s in states)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5), one, two)
    assert one[0]["slope"] > 0


def test_processes_on_loopback():
    """Every process has the frame and gets the whole result."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    run("in_two_processes", 2, PROGDEN_TEST_PORT=str(port))


def in_two_processes(index):
    port = os.environ["PROGDEN_TEST_PORT"]
    jax.distributed.initialize(f"localhost:{port}", 2, int(index))
    assert len(jax.devices()) == 2
    assert len(jax.local_devices()) == 1
    frame, network, how = job()
    over = pd.progressive_denoise(frame, network, **how, devices=jax.devices())
    assert_same(over, pd.progressive_denoise(frame, network, **how))
    jax.distributed.shutdown()


def test_devices_are_checked():
    frame, network, how = job()
    with pytest.raises(ValueError, match="devices is empty"):
        pd.progressive_denoise(frame, network, **how, devices=[])
    halved = pd.FunctionDenoiser(lambda x: 0.5 * x)
    with pytest.raises(ValueError, match="cannot work on tiles"):
        pd.progressive_denoise(frame, halved, **how, devices=jax.devices())


@pytest.mark.parametrize(
    ("cores", "batch", "flags", "expected"),
    [
        (4, 6, "", 3),
        (2, 12, "", 2),
        (64, 12, "", 6),
        (1, 5, "", 1),
        (2, 12, "--xla_force_host_platform_device_count=5", None),
    ],
)
def test_cores_as_devices(monkeypatch, cores, batch, flags, expected):
    """As many as share a batch, unless the user has said something; JAX that has begun stays as it is."""
    asked = {}
    monkeypatch.setattr(_devices, "cores", lambda: list(range(cores)))
    monkeypatch.setenv("XLA_FLAGS", flags)
    with monkeypatch.context() as patched:
        patched.setattr(_devices.jax, "config", SimpleNamespace(update=asked.__setitem__))
        _devices.cores_as_devices(batch)
    assert asked.get("jax_num_cpu_devices") == expected
    before = len(jax.devices())
    _devices.cores_as_devices(batch)
    assert len(jax.devices()) == before
