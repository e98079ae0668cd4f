"""What the exact divergence by cones costs: operations by XLA's count, run time, compile time, memory.

python -m experiments.divergence.cone [--size 256] [--denoiser oidn-hdr]
"""

import argparse
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import progden_jax as pd
from experiments import _common
from progden_jax.denoisers import graph
from progden_jax.divergence import cone, windows

PHASES = 8
"""Phases timed of all; each does the same work."""


def least_seconds(run: Callable[[], Any], repeats: int) -> float:
    taken = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(run())
        taken.append(time.perf_counter() - start)
    return min(taken)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--size", type=int, default=256, help="edge in pixels, a multiple of 16")
    parser.add_argument("--denoiser", default="oidn-hdr")
    parser.add_argument("--chunk", type=int, default=16)
    arguments = parser.parse_args()
    print(_common.machine())
    size = (arguments.size, arguments.size)
    rng = np.random.default_rng(0)
    color = jnp.asarray(rng.gamma(1, 1, (*size, 3)), jnp.float32)
    normal = jnp.asarray(rng.random((*size, 3)), jnp.float32)
    f: Any = pd.denoisers.load(arguments.denoiser).bind(pd.Frame(color, color, normal, normal))
    nodes, params = f.layers
    plan = windows.plan(nodes, params)
    cells = cone.cells_per_phase(plan, size)

    def primal(f: Any, x: jax.Array) -> Any:
        shown = f.layered(x)
        output, kept = graph.evaluate(shown.nodes, shown.params, shown.inputs)
        return output, cone.prepare(plan, shown.params, kept)

    def phase(params: Any, kept: Any, index: jax.Array, *, chunk: int) -> jax.Array:
        exactly = jax.lax.Precision.HIGHEST
        return cone.some_cells(
            plan, params, kept, size, index, 0, cells, chunk=chunk, precision=exactly
        )

    program = jax.jit(phase, static_argnames="chunk")

    forward = jax.jit(lambda f, x: f(x)).lower(f, color).compile()
    _, kept = jax.jit(primal)(f, color)
    start = time.perf_counter()
    tangents = program.lower(params, kept, jnp.int32(0), chunk=arguments.chunk).compile()
    compile_time = time.perf_counter() - start

    # XLA counts a loop's body once: operations are counted on one chunk that holds all cells of a phase.
    counted = program.lower(params, kept, jnp.int32(0), chunk=cells)
    flops: Any = counted.cost_analysis()
    forward_flops: Any = forward.cost_analysis()
    operations = flops["flops"] * plan.period**2
    written = 2 * graph.multiply_adds(nodes, params, plain=True) * arguments.size**2

    once = least_seconds(lambda: forward(f, color), 7)
    per_phase = [
        least_seconds(lambda i=i: tangents(params, kept, jnp.int32(i)), 1)
        for i in np.linspace(0, plan.period**2 - 1, PHASES).astype(int)
    ]
    whole = float(np.median(per_phase)) * plan.period**2
    method = pd.Exact("cone", chunk=arguments.chunk)
    pd.exact_divergence(f, color, color, method=method)
    stepwise = least_seconds(
        lambda: pd.exact_divergence(f, color, color, method=method).divergence, 1
    )
    memory: Any = tangents.memory_analysis()
    rows = [
        ("multiply-adds by plan, forward passes", pd.Exact().cost(f, color)["cone"]),
        ("operations by XLA, forward passes as they run", operations / forward_flops["flops"]),
        ("operations by XLA, of the network as it is written", operations / written),
        ("one forward pass, ms", 1e3 * once),
        ("in one program, s (from 8 phases)", whole),
        ("in one program, forward passes", whole / once),
        ("exact_divergence, s", stepwise),
        ("exact_divergence, forward passes", stepwise / once),
        ("compile, s", compile_time),
        ("XLA temporaries, MB", memory.temp_size_in_bytes / 1e6),
    ]
    print(f"\n{arguments.denoiser}, {size[0]}×{size[1]}, chunk {arguments.chunk}\n")
    print(_common.markdown(("", "value"), rows))


if __name__ == "__main__":
    main()
