"""What a tangent pass costs against a forward pass: K probes as `pd.divergence` runs them.

    python -m experiments.divergence.tangent [--size 256 512] [--native-level 8]

One run measures all programs in turn, again and again, and takes each one's least time. Processor time,
summed over threads, hardly depends on who else uses the machine; the clock does. "per tangent" is what a
probe adds beyond the first.
"""

import argparse
import importlib.util
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import progden_jax as pd
from experiments import _common
from progden_jax.divergence import _random

KEY = jax.random.key(0)
METHODS: dict[str, tuple[pd.Method, int]] = {
    "MonteCarlo(1)": (pd.MonteCarlo(probes=1), 1),
    "MonteCarlo(4)": (pd.MonteCarlo(probes=4), 4),
    "MonteCarlo(4, chunk=4)": (pd.MonteCarlo(probes=4, chunk=4), 4),
    "MonteCarlo(16)": (pd.MonteCarlo(probes=16), 16),
    "Probing(16)": (pd.Probing(probes=16), 16),
    "FiniteDifference(4)": (pd.FiniteDifference(probes=4), 4),
}
TARGET = 1.15


def check(f: Any, x: jax.Array, variance: jax.Array) -> None:
    """One probe equals σ s · J σ s by `jax.jvp`, in value and derivative."""
    b = jnp.sqrt(variance) * _random.signs(KEY, 0, x)
    value, tangent = jax.jit(lambda f, x, b: jax.jvp(f, (x,), (b,)))(f, x, b)
    found = pd.divergence_and_error(f, x, variance, method=pd.MonteCarlo(probes=1), key=KEY)
    scale = float(jnp.abs(b * tangent).max())
    np.testing.assert_allclose(found.divergence, b * tangent, rtol=1e-4, atol=1e-5 * scale)
    np.testing.assert_allclose(f(x), value, rtol=1e-4, atol=1e-5)


def native_filter(color: np.ndarray, level: int | None) -> tuple[Callable[[], Any], np.ndarray]:
    """OIDN's own filter, at a level of instructions by ISPC's number or at that which it chooses."""
    import pyoidn

    if level is not None:
        path = Path(__file__).resolve().parents[2] / "tests" / "native_oidn.py"
        spec = importlib.util.spec_from_file_location("native_oidn", path)
        assert spec is not None
        assert spec.loader is not None
        module: Any = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        module._SSE4 = level
        module._force_float32()
    output = np.zeros_like(color)
    device: Any = pyoidn.Device()
    device.commit()
    chain: Any = pyoidn.Filter(device, pyoidn.OIDN_FILTER_TYPE_RT)
    chain.set_image("color", color, pyoidn.OIDN_FORMAT_FLOAT3)
    chain.set_image("output", output, pyoidn.OIDN_FORMAT_FLOAT3)
    chain.set_bool("hdr", True)
    chain.set_quality(pyoidn.OIDN_QUALITY_BALANCED)
    chain.commit()
    return chain.execute, output


class Seconds(NamedTuple):
    """Least time of a program by the clock and summed over its threads."""

    clock: float
    processor: float


def least_seconds(
    programs: dict[str, Callable[[], Any]], rounds: int, budget: float
) -> dict[str, Seconds]:
    """Each program's least time over rounds in which all take turns, until the seconds are spent."""
    least = dict.fromkeys(programs, Seconds(float("inf"), float("inf")))
    end = time.perf_counter() + budget
    for done in range(rounds):
        if done and time.perf_counter() > end:
            break
        for name, run in programs.items():
            clock, processor = time.perf_counter(), time.process_time()
            jax.block_until_ready(run())
            taken = Seconds(time.perf_counter() - clock, time.process_time() - processor)
            least[name] = Seconds(*map(min, least[name], taken))
    return least


def measure(denoiser: Any, size: int, rounds: int, budget: float, level: int | None) -> list[tuple]:
    rng = np.random.default_rng(0)
    x = jnp.asarray(rng.gamma(1, 1, (size, size, 3)), jnp.float32)
    variance = 0.01 * x**2
    f = denoiser.bind(pd.Frame(x, variance))
    check(f, x, variance)

    forward = jax.jit(lambda f, x: f(x)).lower(f, x).compile()
    analysis: Any = forward.cost_analysis()
    compiled = {"forward": forward}
    programs: dict[str, Callable[[], Any]] = {"forward": lambda: forward(f, x)}
    for name, (method, _) in METHODS.items():
        program = jax.jit(lambda f, x, v, m=method: m.evaluate(f, x, v, KEY))
        compiled[name] = ready = program.lower(f, x, variance).compile()
        programs[name] = lambda ready=ready: ready(f, x, variance)
    programs["native OIDN"], native = native_filter(np.asarray(x), level)
    least_seconds(programs, 1, 0)
    off = np.sqrt(np.mean((native - np.asarray(f(x))) ** 2) / np.mean(native**2))
    least = least_seconds(programs, rounds, budget)

    rows = []
    once, one = least["forward"], least["MonteCarlo(1)"]
    for name, seconds in least.items():
        _, probes = METHODS.get(name, (None, 0))
        memory: Any = compiled[name].memory_analysis() if name in compiled else None
        more = (seconds.processor - one.processor) / once.processor
        notes = {
            "forward": f"{analysis['flops'] / once.clock / 1e9:.0f} GFLOP/s",
            "native OIDN": f"relative RMSE to ours {off:.1e}",
        }
        rows.append(
            (
                f"{size}×{size}",
                name,
                1e3 * seconds.clock,
                seconds.clock / once.clock,
                seconds.processor / once.processor,
                1 + TARGET * probes if probes else "",
                more / (probes - 1) if probes > 1 else "",
                memory.temp_size_in_bytes / 1e6 if memory else "",
                notes.get(name, ""),
            )
        )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--size", type=int, nargs="*", default=[256, 512], help="edges in pixels")
    parser.add_argument("--denoiser", default="oidn-hdr")
    parser.add_argument("--rounds", type=int, default=8)
    parser.add_argument("--budget", type=float, default=120, help="seconds of timing per size")
    parser.add_argument(
        "--native-level", type=int, help="ISPC's number: 8 is AVX-512 in float32; default: OIDN's"
    )
    arguments = parser.parse_args()
    pd.enable_compilation_cache()
    print(_common.machine())
    denoiser = pd.denoisers.load(arguments.denoiser)
    rows = []
    for size in arguments.size:
        rows += measure(denoiser, size, arguments.rounds, arguments.budget, arguments.native_level)
    columns = (
        *("size", "program", "ms", "forwards by the clock", "by processor time", "target"),
        *("per tangent", "temporaries, MB", ""),
    )
    print(f"\n{arguments.denoiser}\n")
    print(_common.markdown(columns, rows))


if __name__ == "__main__":
    main()
