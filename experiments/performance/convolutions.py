"""Other ways to a 3×3 convolution on this machine, against XLA's own: AMX, Winograd's, half precision.

    python -m experiments.performance.convolutions [--shapes 512x64x64 512x32x32] [--net 1920x1080]

Programs take turns; times are the least of many, by the clock. Winograd's F(4×4, 3×3) (Lavin and Gray
2016) has a quarter of the products, as 36 matrix products between two linear transforms; its kernels are
transformed beforehand. Then the paper's mixing net against its operations at the speed of convolutions that
are called again and again right before and after it (in `run` they are called once in a round): medians.
"""

import argparse
import functools
import statistics
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from experiments import _common
from experiments.performance.programs import mixing_net
from experiments.performance.run import size_of
from experiments.performance.step import convolution as large_convolution
from experiments.performance.step import seconds
from progden_jax import _amx, mixers
from progden_jax._amx_convolution import convolution
from progden_jax.mixing import FEATURES

INPUT = (
    (4, 0, -5, 0, 1, 0),
    (0, -4, -4, 1, 1, 0),
    (0, 4, -4, -1, 1, 0),
    (0, -2, -1, 2, 1, 0),
    (0, 2, -1, -2, 1, 0),
    (0, 4, 0, -5, 0, 1),
)
KERNEL = np.array(
    (
        (1 / 4, 0, 0),
        (-1 / 6, -1 / 6, -1 / 6),
        (-1 / 6, 1 / 6, -1 / 6),
        (1 / 24, 1 / 12, 1 / 6),
        (1 / 24, -1 / 12, 1 / 6),
        (0, 0, 1),
    ),
    np.float32,
)
OUTPUT = ((1, 1, 1, 1, 1, 0), (0, 1, -1, 2, -2, 0), (0, 1, 1, 4, 4, 0), (0, 1, -1, 8, -8, 1))
"""Of points 0, ±1, ±2 and infinity, for tiles of 6×6 that give 4×4 values."""

SWITCHES = {
    "oneDNN": {"xla_cpu_use_onednn": True},
    "YNNPACK": {
        "xla_cpu_experimental_ynn_fusion_type": "LIBRARY_FUSION_TYPE_INDIVIDUAL_CONVOLUTION"
    },
}
"""Libraries that XLA can be asked to use."""

_AROUND = 4
"""Calls of a convolution before the net, and after it."""


def direct(image: Float[Array, "h w c"], kernel: Float[Array, "3 3 c k"]) -> Float[Array, "h w k"]:
    """XLA's convolution, zeros around."""
    return lax.conv_general_dilated(
        image[None], kernel, (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC")
    )[0]


def transformed(kernel: Float[Array, "3 3 c k"]) -> Float[Array, "6 6 c k"]:
    """A kernel as `winograd` takes it."""
    return jnp.einsum("ai,bj,ijck->abck", KERNEL, KERNEL, kernel)


def winograd(
    image: Float[Array, "h w c"], kernel: Float[Array, "6 6 c k"]
) -> Float[Array, "h w k"]:
    """As `direct`, of an image whose sides are multiples of 4."""
    height, width, channels = image.shape
    rows, columns = height // 4, width // 4
    cells = jnp.pad(image, ((1, 3), (1, 3), (0, 0)))
    cells = cells.reshape(rows + 1, 4, columns + 1, 4, channels)
    lines = [cells[i // 4 : rows + i // 4, i % 4] for i in range(6)]
    products = []
    for a, down in enumerate(_combined(INPUT, lines)):
        values = [down[:, j // 4 : columns + j // 4, j % 4] for j in range(6)]
        across = _combined(INPUT, values)
        products.append([value @ kernel[a, b] for b, value in enumerate(across)])
    down = [_combined(OUTPUT, line) for line in zip(*products, strict=True)]
    lines = [jnp.stack(_combined(OUTPUT, line), 2) for line in zip(*down, strict=True)]
    return jnp.stack(lines, 1).reshape(height, width, -1)


def _combined(matrix: Sequence[Sequence[float]], values: Sequence[Array]) -> list[Array]:
    """The matrix times a column of images."""
    return [
        functools.reduce(jnp.add, (c * v for c, v in zip(row, values, strict=True) if c))
        for row in matrix
    ]


def by_amx(
    image: Float[Array, "h w c"], kernel: Float[Array, "3 3 c k"], *, planes: int, together: int
) -> Float[Array, "h w k"]:
    """The library's own, of so many bfloat16 a value; every product, or of sums of rows."""
    return convolution(None, None, image[None], kernel, planes=planes, together=together)[0]


def as_product(columns: Float[Array, "n 9c"], kernel: Float[Array, "9c k"]) -> Float[Array, "n k"]:
    """A convolution of pixels whose neighbours are side by side already, summed in float32."""
    return lax.dot(columns, kernel, preferred_element_type=jnp.float32)


def programs(size: int, channels: int, outputs: int) -> dict[str, tuple[Callable[..., Any], Any]]:
    """Name -> the compiled program and its arguments."""
    rng = np.random.default_rng(0)
    image = jnp.asarray(rng.gamma(1, 1, (size, size, channels)), jnp.float32)
    kernel = jnp.asarray(rng.normal(size=(3, 3, channels, outputs)) / channels, jnp.float32)
    half = tuple(a.astype(jnp.bfloat16) for a in (image, kernel))
    columns = jnp.tile(image.reshape(-1, channels), (1, 9))
    flat = kernel.reshape(-1, outputs)
    asked = {
        "direct": (direct, (image, kernel), {}),
        **{f"direct, by {name}": (direct, (image, kernel), o) for name, o in SWITCHES.items()},
        "Winograd": (winograd, (image, transformed(kernel)), {}),
        "direct, bfloat16": (direct, half, {}),
        **{
            f"AMX, {planes} bfloat16 a value{', row by row' * (planes == 3 and together == 1)}": (
                functools.partial(by_amx, planes=planes, together=together),
                (image, kernel),
                {},
            )
            for planes, together in ((3, 1), (3, _amx.ALIGNED), (2, 1), (1, 1))
            if _amx.planes("highest", kernel)
        },
        "product alone": (as_product, (columns, flat), {}),
        "product alone, bfloat16": (
            as_product,
            (columns.astype(jnp.bfloat16), flat.astype(jnp.bfloat16)),
            {},
        ),
    }
    return {
        name: (jax.jit(f, compiler_options=options).lower(*a).compile(), a)
        for name, (f, a, options) in asked.items()
    }


def net_by_operations(height: int, width: int, repeats: int) -> list[tuple[object, ...]]:
    """By each convolution of 96 channels: its speed, and the net's time over its operations' at it."""
    paper = mixers.build("paper")
    params = jax.jit(paper.init)(jax.random.key(0))
    seen = jax.random.gamma(jax.random.key(1), 1.0, (height, width, FEATURES))
    net = jax.jit(mixing_net)
    operations = 2.0 * height * width * sum(a.size for a in jax.tree.leaves(params) if a.ndim == 4)
    ways = (
        {"AMX, rows summed": _amx.ALIGNED, "AMX, row by row": 1} if _amx.available() else {"XLA": 1}
    )
    found = []
    for name, together in ways.items():
        run, images, count = large_convolution(1, 512, 96, by_xla=False, together=together)
        jax.block_until_ready((net(params, seen), run(*images)))
        times, speeds = [], []
        for _ in range(repeats):
            before = [seconds(functools.partial(run, *images)) for _ in range(_AROUND)]
            times.append(seconds(functools.partial(net, params, seen)))
            after = [seconds(functools.partial(run, *images)) for _ in range(_AROUND)]
            speeds.append(count / statistics.mean(before + after))
        ratios = [time * speed / operations for time, speed in zip(times, speeds, strict=True)]
        ms, gflops = 1e3 * statistics.median(times), statistics.median(speeds) / 1e9
        shown = (f"{ms:.1f}", f"{gflops:.0f}", f"{statistics.median(ratios):.2f}")
        found.append((f"{width}x{height}", name, *shown))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    shapes = ["512x64x64", "512x32x32", "256x96x96"]
    parser.add_argument("--shapes", nargs="+", default=shapes, help="SIDExCHANNELSxOUTPUTS")
    parser.add_argument(
        "--net", default="1920x1080", help="WIDTHxHEIGHT that the mixing net is run at"
    )
    parser.add_argument("--repeats", type=int, default=8)
    arguments = parser.parse_args()
    print(_common.machine() + "\n", flush=True)
    rows = []
    for shape in arguments.shapes:
        size, channels, outputs = (int(n) for n in shape.split("x"))
        made = programs(size, channels, outputs)
        answers = {name: np.asarray(run(*a), np.float32) for name, (run, a) in made.items()}
        times: dict[str, list[float]] = {name: [] for name in made}
        for _ in range(arguments.repeats):
            for name, (run, a) in made.items():
                times[name].append(seconds(lambda r=run, a=a: r(*a)))
        truth = answers["direct"]
        count = 18.0 * size**2 * channels * outputs
        for name, found in times.items():
            off = np.sqrt(
                np.mean((answers[name].reshape(truth.shape) - truth) ** 2) / np.mean(truth**2)
            )
            rows.append(
                (
                    *(shape, name, f"{1e3 * min(found):.1f}"),
                    f"{min(found) / min(times['direct']):.2f}",
                    f"{count / min(found) / 1e9:.0f}",
                    "" if "alone" in name else f"{off:.0e}",
                )
            )
    header = ("shape", "program", "ms", "direct = 1", "GFLOP/s of the direct's", "off")
    print(_common.markdown(header, rows) + "\n", flush=True)
    header = ("mixing net at", "convolution", "net, ms", "GFLOP/s", "net / operations")
    print(_common.markdown(header, net_by_operations(*size_of(arguments.net), arguments.repeats)))


if __name__ == "__main__":
    main()
