"""One program in a process of its own, for what only a fresh process shows: start, compilations, memory.

`run` starts it; it prints JSON. Nothing heavy is imported before it is known to be needed.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from progden_jax.memory import parse_size

FRAME, DENOISER, MIXER = "frame.npz", "denoiser.npz", "mixer.npz"
MIXER_FILE = "mixer.safetensors"


def save_params(path: Path, params: Any) -> None:
    """Layers of kernel and bias."""
    arrays = {f"{name}/{kind}": a for name, layer in params.items() for kind, a in layer.items()}
    np.savez(path, **arrays)  # pyright: ignore[reportArgumentType]


def load_params(path: Path) -> dict[str, dict[str, np.ndarray]]:
    params: dict[str, dict[str, np.ndarray]] = {}
    with np.load(path) as arrays:
        for name in arrays.files:
            layer, kind = name.split("/")
            params.setdefault(layer, {})[kind] = arrays[name]
    return params


def memory(kind: str) -> float:
    """MB of this process: VmRSS now, VmHWM at most (ru_maxrss would count the parent's before exec)."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(kind):
            return int(line.split()[1]) / 1e3
    return float("nan")


def forget_peak() -> None:
    """VmHWM starts anew from VmRSS."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        print("the peak includes loading: /proc/self/clear_refs cannot be written", file=sys.stderr)


Run = Callable[[dict[str, np.ndarray]], Any]


def ours(folder: Path, denoiser: str, probes: int, max_memory: int | None = None) -> Run:
    import jax

    import progden_jax as pd

    pd.enable_compilation_cache()
    network, mixer = pd.denoisers.load(denoiser), pd.load_mixer(folder / MIXER_FILE)
    method = pd.MonteCarlo(probes=probes)

    def run(buffers: dict[str, np.ndarray]) -> Any:
        frame = pd.Frame(**buffers)
        result = pd.progressive_denoise(
            frame, network, mixer=mixer, method=method, max_memory=max_memory
        )
        return np.asarray(jax.block_until_ready(result.image))

    return run


def native(folder: Path, denoiser: str, probes: int) -> Run:
    del folder, denoiser, probes
    from experiments.performance import native

    return lambda buffers: native.Filter(buffers).execute()


def pytorch(folder: Path, denoiser: str, probes: int) -> Run:
    del denoiser
    from experiments.performance import torch_baseline as baseline

    network = baseline.OIDN(load_params(folder / DENOISER))
    net = baseline.MixingNet(load_params(folder / MIXER))

    def run(buffers: dict[str, np.ndarray]) -> Any:
        with baseline.torch.no_grad():
            order = [buffers.get(n) for n in ("color", "variance", "albedo", "normal")]
            x, variance, *rest = (None if b is None else baseline.tensor(b) for b in order)
            found, _ = baseline.progressive_denoise(network, net, x, variance, *rest, probes=probes)
            return baseline.image(found)

    return run


PROGRAMS: dict[str, Callable[..., Run]] = {
    "progden_jax": ours,
    "native OIDN": native,
    "PyTorch": pytorch,
}


class Compilations:
    """How many programs XLA was asked for, and how many of them came from the cache."""

    def __init__(self) -> None:
        self.asked = self.cached = 0
        if "jax" in sys.modules:
            import jax

            jax.monitoring.register_event_duration_secs_listener(self._duration)
            jax.monitoring.register_event_listener(self._event)

    def _duration(self, event: str, *_: Any, **__: Any) -> None:
        self.asked += event == "/jax/core/compile/backend_compile_duration"

    def _event(self, event: str, *_: Any, **__: Any) -> None:
        self.cached += event == "/jax/compilation_cache/cache_hits"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("program", choices=PROGRAMS)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--denoiser", default="oidn-hdr")
    parser.add_argument("--probes", type=int, default=4)
    parser.add_argument("--max-memory", help="progden_jax's, such as 2GiB")
    parser.add_argument("--began", type=float, help="time.time() when it was started")
    arguments = parser.parse_args()
    with np.load(arguments.folder / FRAME) as arrays:
        buffers = {name: arrays[name] for name in arrays.files}
    smaller = {name: np.ascontiguousarray(b[:-8, :-8]) for name, b in buffers.items()}
    bound = {"max_memory": parse_size(arguments.max_memory)} if arguments.max_memory else {}
    run = PROGRAMS[arguments.program](
        arguments.folder, arguments.denoiser, arguments.probes, **bound
    )
    compilations = Compilations()
    ready = time.time() - arguments.began
    forget_peak()
    level = memory("VmRSS")
    run(buffers)
    first, asked = time.time() - arguments.began, compilations.asked
    compiled = asked - compilations.cached
    begin = time.perf_counter()
    run(buffers)
    second, again = time.perf_counter() - begin, compilations.asked - asked
    peak = memory("VmHWM") - level
    run(smaller)
    found = {
        "ready_s": ready,
        "first_result_s": first,
        "second_s": second,
        "programs": asked,
        "compiled": compiled,
        "again": again,
        "smaller_size": compilations.asked - asked - again,
        "peak_mb": peak,
    }
    print(json.dumps(found))


if __name__ == "__main__":
    main()
