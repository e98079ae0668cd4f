"""What `run` times: every part and the whole, by this project, OIDN's library and PyTorch."""

import functools
import importlib.util
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import progden_jax as pd
from experiments import _common
from experiments.performance import native
from progden_jax import mixers
from progden_jax._canvas import canvas_size
from progden_jax.denoisers import graph
from progden_jax.mixers import multiscale
from progden_jax.mixing import level_of
from progden_jax.survey import crop

OURS, NATIVE, TORCH = "progden_jax", "native OIDN", "PyTorch"
FORWARD, DIVERGENCE, BOUND = "forward pass", "divergence", "t-bound"
FEATURES, NET, WHOLE = "mixer features", "mixing net", "whole"
SHIPPED = ", shipped mixer"
KEY = jax.random.key(0)


class Program(NamedTuple):
    part: str
    probes: int | None
    name: str
    run: Callable[[], Any]
    operations: float | None = None
    """Of the convolutions of this part."""
    off: float | None = None
    """Relative RMSE to this project's answer."""
    temporaries: float | None = None
    """Bytes, by XLA."""


class Scene:
    """What the programs of one size work on."""

    def __init__(self, frame: pd.Frame, denoiser: Any) -> None:
        assert frame.variance is not None
        self.frame, self.denoiser = frame, denoiser
        self.pixels = frame.size[0] * frame.size[1]
        self.x, self.variance = frame.color, frame.variance
        self.f = denoiser.bind(frame)
        evaluate = jax.jit(lambda f, x, v: pd.MonteCarlo(probes=1).evaluate(f, x, v, KEY)[:2])
        self.y, self.divergence = evaluate(self.f, self.x, self.variance)
        self.risk = pd.sure(self.x, self.y, self.variance, self.divergence)
        self.alpha = jnp.full_like(self.x, 0.7)
        paper = mixers.build("paper")
        self.paper = mixers.NetworkMixer(jax.jit(paper.init)(KEY), paper)
        self.shipped = mixers.default_for(denoiser)
        self.operations = 2 * self.pixels * graph.multiply_adds(*self.f.layers, plain=True)

    def operations_of(self, mixer: Any) -> float:
        """Of a mixing network's convolutions."""
        layers = getattr(mixer, "params", {}).values()
        return 2 * self.pixels * sum(float(np.size(layer["kernel"])) for layer in layers)

    @property
    def buffers(self) -> dict[str, np.ndarray]:
        """What the denoiser takes, and the variance."""
        names = ("color", "variance", *self.denoiser.inputs)
        return {name: np.array(getattr(self.frame, name)) for name in names}


def load_frame(
    data: Path, names: Sequence[str], spp: int, size: tuple[int, int]
) -> tuple[pd.Frame, np.ndarray]:
    """A mosaic of four scenes, mirrored at its borders to (height, width), and its reference."""
    roles = ("color", "variance", "albedo", "normal")
    frame = pd.Frame(*(jnp.asarray(mosaic(data, names, spp, role, size)) for role in roles))
    return frame, mosaic(data, names, _common.REFERENCE_SPP, "color", size)


def mosaic(
    data: Path, names: Sequence[str], spp: int, buffer: str, size: tuple[int, int]
) -> np.ndarray:
    """One buffer of that frame."""
    frames = [pd.read_exr(data / f"{n}_{spp:06}spp.exr") for n in (list(names) * 4)[:4]]
    tiles = [np.asarray(getattr(frame, buffer)) for frame in frames]
    rows = [np.concatenate(tiles[i : i + 2], axis=1) for i in (0, 2)]
    whole = np.concatenate(rows, axis=0)
    border = [(0, max(n - m, 0)) for n, m in zip((*size, 3), whole.shape, strict=True)]
    return np.pad(whole, border, mode="symmetric")[: size[0], : size[1]]


def has_torch() -> bool:
    return importlib.util.find_spec("torch") is not None


def parts(scene: Scene, against: Sequence[str]) -> Iterator[Program]:
    """Everything that does not depend on the number of probes."""
    images = (scene.x, scene.y, scene.variance)
    seen = pd.mixing_features(*images, scene.risk)
    ours = (
        (FORWARD, scene.operations, lambda f, x: f(x), (scene.f, scene.x)),
        (FEATURES, None, pd.mixing_features, (*images, scene.risk)),
        (NET, scene.operations_of(scene.paper), mixing_net, (scene.paper.params, seen)),
        (BOUND, None, pd.t_bound, (scene.alpha, *images)),
        *_shipped_parts(scene),
    )
    answers = {}
    for part, operations, function, arguments in ours:
        run, temporaries = _compiled(function, arguments)
        answers[part] = run()
        yield Program(part, None, OURS, run, operations, temporaries=temporaries)
    if NATIVE in against:
        run = native.Filter(scene.buffers).execute
        yield Program(FORWARD, None, NATIVE, run, off=_off(run(), answers[FORWARD]))
    if TORCH in against:
        yield from _Torch(scene).parts(answers)


def mixing_net(params: Any, seen: Any) -> Any:
    """As the pipeline runs it: large images in bands of rows."""
    net = pd.MixingNet()

    def applied(some: Any) -> Any:
        return net.apply({"params": params}, some)

    return mixers.banded(applied, (seen,), mixers.build("paper").receptive_radius)


def _shipped_features(mixer: mixers.NetworkMixer, *images: Any) -> Any:
    """As the pipeline runs them, and of them a few sums: 54 channels of all of it are never there."""
    inside = images[-1]
    level = level_of(images[0], inside)
    kernel = jnp.ones((multiscale.CHANNELS, 4))

    def applied(*some: Any) -> Any:
        *known, there = some
        return multiscale.features(*known, inside=there, level=level)[0] @ kernel

    return mixers.banded(applied, images, mixer.receptive_radius)


def _shipped_parts(scene: Scene) -> Iterator[tuple[str, float | None, Callable[..., Any], tuple]]:
    """On the canvas, where the pipeline has them."""
    mixer = scene.shipped
    if not isinstance(mixer, mixers.NetworkMixer):
        return
    height, width = size = scene.x.shape[:2]
    canvas = canvas_size(height), canvas_size(width)
    known = (scene.x, scene.y, scene.variance, scene.divergence, scene.risk)
    *images, risk, inside = (
        jnp.asarray(crop(image, (0, 0), canvas)) for image in (*known, np.ones((*size, 1), bool))
    )
    yield FEATURES + SHIPPED, None, _shipped_features, (mixer, *images, inside)

    def alpha(mixer: mixers.NetworkMixer, *images: Any) -> Any:
        *known, there = images
        return mixer(*known, inside=there)

    operations = scene.operations_of(mixer)
    yield f"features and net{SHIPPED}", operations, alpha, (mixer, *images, risk, inside)


def wholes(scene: Scene, probes: int, against: Sequence[str]) -> Iterator[Program]:
    """The divergence and the whole pipeline."""
    method = pd.MonteCarlo(probes=probes)
    operations = (1 + probes) * scene.operations
    run, temporaries = _compiled(
        lambda f, x, v: method.evaluate(f, x, v, KEY)[:2], (scene.f, scene.x, scene.variance)
    )
    yield Program(DIVERGENCE, probes, OURS, run, operations, temporaries=temporaries)
    answers = {}

    def whole(frame: pd.Frame, denoiser: Any, mixer: Any) -> pd.Result:
        return pd.progressive_denoise(frame, denoiser, mixer=mixer, method=method)

    named = {WHOLE: scene.paper, WHOLE + SHIPPED: scene.shipped}
    for part, mixer in named.items():
        if not isinstance(mixer, mixers.NetworkMixer):
            continue
        arguments = (scene.frame, scene.denoiser, mixer)
        _, temporaries = _compiled(whole, arguments)
        answers[part] = whole(*arguments)
        total = operations + scene.operations_of(mixer)
        run = functools.partial(whole, *arguments)
        yield Program(part, probes, OURS, run, total, temporaries=temporaries)
    if TORCH in against:
        yield from _Torch(scene).wholes(probes, answers[WHOLE])


def _compiled(function: Callable[..., Any], arguments: tuple) -> tuple[Callable[[], Any], float]:
    """The program on these arguments, and the bytes of its temporaries."""
    program = jax.jit(function).lower(*arguments).compile()
    analysis: Any = program.memory_analysis()
    return lambda: program(*arguments), float(analysis.temp_size_in_bytes)


class _Torch:
    """The PyTorch program on one scene."""

    def __init__(self, scene: Scene) -> None:
        from experiments.performance import torch_baseline as baseline

        self.baseline, self.scene = baseline, scene
        self.net = baseline.MixingNet(scene.paper.params)
        self.denoiser = baseline.OIDN(scene.denoiser.params)
        self.x, self.variance = map(baseline.tensor, (scene.x, scene.variance))
        auxiliary = {r: baseline.tensor(getattr(scene.frame, r)) for r in scene.denoiser.inputs}
        self.auxiliary = [auxiliary.get(role) for role in ("albedo", "normal")]
        self.f = self.denoiser.bind(self.x, *self.auxiliary)

    def parts(self, answers: dict[str, Any]) -> Iterator[Program]:
        baseline, x, variance = self.baseline, self.x, self.variance
        y, risk, alpha = map(baseline.tensor, (self.scene.y, self.scene.risk, self.scene.alpha))
        seen = baseline.features(x, y, variance, risk)
        programs = {
            FORWARD: lambda: self.f(x),
            FEATURES: lambda: baseline.features(x, y, variance, risk),
            NET: lambda: self.net(seen),
            BOUND: lambda: baseline.t_bound(alpha, x, y, variance),
        }
        for part, program in programs.items():
            run = self._quiet(program)
            found = _off(baseline.image(run()), answers[part])
            yield Program(part, None, TORCH, run, off=found)

    def wholes(self, probes: int, ours: pd.Result) -> Iterator[Program]:
        """Their probes differ, so what is compared is the image and α from our divergence."""
        baseline = self.baseline
        y, found = map(baseline.tensor, (ours.denoised, ours.divergence))
        mixed = self._quiet(lambda: baseline.mix(self.net, self.x, y, self.variance, found))()
        worst = max(
            _off(baseline.image(theirs), mine)
            for theirs, mine in zip(mixed, (ours.image, ours.alpha), strict=True)
        )

        def divergence() -> Any:
            return baseline.divergence(self.f, self.x, self.variance, probes)

        def whole() -> Any:
            given = (self.x, self.variance, *self.auxiliary)
            return baseline.progressive_denoise(self.denoiser, self.net, *given, probes=probes)

        yield Program(DIVERGENCE, probes, TORCH, self._quiet(divergence))
        yield Program(WHOLE, probes, TORCH, self._quiet(whole), off=worst)

    def _quiet(self, run: Callable[[], Any]) -> Callable[[], Any]:
        def quiet() -> Any:
            with self.baseline.torch.no_grad():
                return run()

        return quiet


def torch_divergence(scene: Scene, probes: int) -> Callable[[], np.ndarray]:
    """The divergence alone, as an image."""
    program = _Torch(scene)
    baseline = program.baseline
    run = program._quiet(
        lambda: baseline.divergence(program.f, program.x, program.variance, probes)[1]
    )
    return lambda: baseline.image(run())


def _off(found: Any, expected: Any) -> float:
    """Relative RMSE."""
    found, expected = np.asarray(found, np.float64), np.asarray(expected, np.float64)
    return float(np.sqrt(np.mean((found - expected) ** 2) / np.mean(expected**2)))
