"""What one step of training a mixer costs against its operations at the speed of a large convolution.

python -m experiments.performance.step [--architectures paper multiscale]

By default batch 12 of 128×128. The operations are three times the forward pass's multiply-adds (forward,
kernels, inputs; the first layer needs no inputs'), two each. In one run, in turn, the least of many times.
"""

import argparse
import tempfile
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

import progden_jax as pd
from experiments import _common
from progden_jax import _amx, mixers
from progden_jax._amx_convolution import convolution as amx_convolution
from progden_jax._devices import cores_as_devices
from progden_jax.training import MixerConfig, MixerTask, config
from progden_jax.training.step import make_start, make_step

TARGET = 1.2


def operations(params: Any, pixels: int) -> float:
    """Of the convolutions with these weights, forward and backward over so many pixels."""
    products = {name: float(np.prod(layer["kernel"].shape)) for name, layer in params.items()}
    return 2 * pixels * (3 * sum(products.values()) - products["conv_in"])


def convolution(
    batch: int, size: int, channels: int, *, by_xla: bool, together: int = _amx.ALIGNED
) -> tuple[Any, tuple[Any, ...], float]:
    """A 3×3 convolution in float32, its arguments and its operations: XLA's own, or the fastest at hand.

    With `together` of 1 it does them all, row by row, where else sums of rows are multiplied.
    Of random values, as a network's are: matrix units run an eighth faster on constants.
    """
    of_image, of_kernel = jax.random.split(jax.random.key(0))
    image = jax.random.normal(of_image, (batch, size, size, channels))
    kernel = 0.01 * jax.random.normal(of_kernel, (3, 3, channels, channels))

    @jax.jit
    def run(image: jax.Array, kernel: jax.Array) -> jax.Array:
        if not by_xla and (planes := _amx.planes("highest", kernel, image)):
            return amx_convolution(None, None, image, kernel, planes=planes, together=together)
        return jax.lax.conv_general_dilated(
            image, kernel, (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC")
        )

    return run, (image, kernel), 2.0 * image.size * 9 * channels


def task_on_some(
    data: Path, architecture: str, scenes: int, folder: Path, *, batch: int, crop: int
) -> MixerTask:
    """Training on a few scenes: a step takes as long on any number of them."""
    for name in _common.scenes(data, scenes):
        for path in data.glob(f"{name}_*spp.exr"):
            link = folder / path.name
            if not link.exists():
                link.symlink_to(path.resolve())
    values: dict[str, Any] = {"data": [str(folder)], "crop": crop, "batch": batch}
    values |= {"architecture": architecture, "denoiser": "oidn-hdr-small"}
    if architecture == "multiscale":
        values |= {"loss": "log-errors", "swap": 0.0}
    return MixerTask(config.load(MixerConfig, "cpu", values), cache_folder=folder / "cache")


def seconds(run: Any) -> float:
    """Of one call."""
    begin = time.perf_counter()
    jax.block_until_ready(run())
    return time.perf_counter() - begin


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--data", type=Path, default=_common.TRAIN, help="folder of training renders"
    )
    parser.add_argument("--scenes", type=int, default=3, help="how many of its scenes to load")
    parser.add_argument("--architectures", nargs="*", default=tuple(mixers.ARCHITECTURES))
    parser.add_argument("--batch", type=int, default=12)
    parser.add_argument("--crop", type=int, default=128)
    parser.add_argument("--repeats", type=int, default=10)
    parser.add_argument("--channels", type=int, default=96, help="of the convolution compared with")
    arguments = parser.parse_args()
    pd.enable_compilation_cache()
    cores_as_devices(arguments.batch)  # as `progden train` does
    print(_common.machine(), flush=True)
    large, images, count = convolution(1, 512, arguments.channels, by_xla=True)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for architecture in arguments.architectures:
            task = task_on_some(
                arguments.data,
                architecture,
                arguments.scenes,
                Path(folder),
                batch=arguments.batch,
                crop=arguments.crop,
            )
            mesh = Mesh(np.asarray(jax.devices()), ("batch",)) if len(jax.devices()) > 1 else None
            everywhere = NamedSharding(mesh, PartitionSpec()) if mesh else None
            state, step = make_start(task)(jax.random.key(0)), make_step(task, mesh)
            state, arrays = jax.device_put((state, dict(task.arrays)), everywhere)
            chosen = jnp.arange(task.config.batch) % len(task.items)

            def once(state: Any = state, step: Any = step, a: Any = arrays, c: Any = chosen) -> Any:
                copied = jax.tree.map(jnp.copy, state)  # a step takes over its state's memory
                return step(copied, a, jax.random.key(0), c)

            peaks, times = [], []
            for _ in range(1 + arguments.repeats):  # the first compiles
                peaks.append(seconds(lambda: large(*images)))
                times.append(seconds(once))
            speed = count / min(peaks)
            total = operations(state.params, task.config.batch * task.config.crop**2)
            limit = total / speed
            rows.append(
                (
                    architecture,
                    f"{total / 1e9:.1f}",
                    f"{speed / 1e9:.0f}",
                    f"{limit * 1e3:.0f}",
                    f"{min(times) * 1e3:.0f}",
                    f"{min(times) / limit:.2f}",
                    TARGET,
                )
            )
    header = (
        "architecture",
        "operations, 1e9",
        f"3×3 convolution of {arguments.channels} channels, GFLOP/s",
        "limit, ms",
        "step, ms",
        "step / limit",
        "target",
    )
    print(_common.markdown(header, rows))


if __name__ == "__main__":
    main()
