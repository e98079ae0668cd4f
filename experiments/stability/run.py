"""Where each way to the divergence breaks in float32, TF32 and bfloat16.

    python -m experiments.stability.run

Every method is compared with float64 on the very same probes, so that only numbers, not chance, are seen:
"numerical" is the RMSE over pixels relative to the RMS of the float64 estimate; "elsewhere" leaves out the
pixels that were tampered with. "total" is against the exact divergence in float64 at sampled pixels that
were not tampered with, by unit vectors: there chance is included.
"""

import csv
import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import progden_jax as pd
from experiments import _common
from experiments.stability import _figures, rounding
from progden_jax.divergence import _random
from progden_jax.frame import centre

HERE = Path(__file__).parent
EPSILONS = tuple(float(f"{10**e:.2g}") for e in np.arange(-6, -0.9, 0.5))
SCALES = tuple(10.0**e for e in range(-6, 7, 2))
NETWORKS = ("float32", "TF32", "bfloat16")
SPP = (8, 128)
PROBES = 4
SAMPLED = 32
FIREFLY = 1e6
INPUTS = ("as rendered", "zero variances", "fireflies", "repaired infinities")
HEADER = (
    *("study", "setting", "exposure", "scene", "spp", "network", "method"),
    *("numerical", "elsewhere", "total", "finite"),
)
KEY = jax.random.key(1)


class Case(NamedTuple):
    """One input: what was done to a frame, with what exposure, and which pixels were left alone."""

    study: str
    setting: str
    exposure: str
    frame: pd.Frame
    f: Any
    untouched: np.ndarray


def tampered(frame: pd.Frame, how: str) -> tuple[pd.Frame, np.ndarray]:
    """The frame with hard inputs, and (H, W) which pixels are as they were."""
    assert frame.variance is not None
    color, variance = np.array(frame.color), np.array(frame.variance)
    chance = np.random.default_rng(0).permutation(color.shape[0] * color.shape[1])
    order = chance.reshape(frame.size)
    few = order < max(4, order.size // 1000)
    if how == "zero variances":
        touched = order < 0.3 * order.size
        variance[touched] = 0
        return pd.Frame(color, variance), np.ones_like(touched)
    if how == "fireflies":
        color[few], variance[few] = FIREFLY, FIREFLY**2
        return pd.Frame(color, variance), ~few
    if how == "repaired infinities":
        color[few], variance[few] = np.inf, np.inf
        return pd.repair(pd.Frame(color, variance))[0], ~few
    return frame, np.ones_like(few)


def cases(frame: pd.Frame, denoiser: Any, scales: tuple[float, ...]) -> Iterator[Case]:
    """Every input made of one crop; the first is the crop itself."""
    assert frame.variance is not None
    everything = np.ones(frame.size, bool)
    for how in INPUTS:
        changed, untouched = tampered(frame, how)
        yield Case("inputs", how, "automatic", changed, denoiser.bind(changed), untouched)
    fixed = denoiser.bind(frame).exposure
    for scale in scales:
        scaled = pd.Frame(frame.color * scale, frame.variance * scale**2)
        f = denoiser.bind(scaled)
        yield Case("scale", f"{scale:g}", "automatic", scaled, f, everything)
        f = dataclasses.replace(f, exposure=fixed)
        yield Case("scale", f"{scale:g}", "fixed", scaled, f, everything)


def float64_truths(case: Case, found: dict[str, pd.Method]) -> dict[str, np.ndarray]:
    """The same estimates in float64, by method; "image" is f(x), "exact" the truth at `sampled` values."""
    frame = case.frame
    assert frame.variance is not None
    sigma = np.sqrt(np.asarray(frame.variance, np.float64))
    probes = sigma * [np.asarray(_random.normal(KEY, k, frame.color)) for k in range(PROBES)]
    index = sampled(case)
    with jax.enable_x64(True):
        f, x, variance = jax.tree.map(
            lambda a: jnp.asarray(np.asarray(a), jnp.float64), (case.f, frame.color, frame.variance)
        )
        image, products, diagonal = _linearized(f, x, jnp.asarray(probes), jnp.asarray(index))
        truths = {
            "image": np.asarray(image),
            "gaussian": np.mean(probes * np.asarray(products), 0),
            "exact": np.asarray(diagonal * variance.ravel()[index]),
        }
        for name, method in found.items():
            if not (is_gaussian(name) or isinstance(method, pd.Exact)):
                estimate = pd.divergence(f, x, variance, method=method, key=KEY)
                truths[name] = np.asarray(estimate)
    return truths


@jax.jit
def _linearized(
    f: Any, x: jax.Array, vectors: jax.Array, index: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """f(x), J v for each vector, and the Jacobian's diagonal at flat indices."""
    value, tangent = jax.linearize(f, x)

    def one(i: jax.Array) -> jax.Array:
        return tangent(jnp.zeros(x.size, x.dtype).at[i].set(1).reshape(x.shape)).ravel()[i]

    return value, jax.lax.map(tangent, vectors), jax.lax.map(one, index)


def sampled(case: Case) -> np.ndarray:
    """Flat indices of untouched values: a quarter those of the largest variance, the rest by chance."""
    values = np.flatnonzero(np.repeat(case.untouched[..., None], 3, -1))
    variance = np.asarray(case.frame.variance).ravel()[values]
    order = values[np.argsort(-variance)]
    largest = order[: SAMPLED // 4]
    rest = np.random.default_rng(1).permutation(order[SAMPLED // 4 :])
    return np.concatenate((largest, rest[: SAMPLED - len(largest)]))


def methods() -> dict[str, pd.Method]:
    """The estimators compared, by name."""
    return {
        "FiniteDifference": pd.FiniteDifference(probes=PROBES),
        "MonteCarlo, gaussian": pd.MonteCarlo(probes=PROBES, distribution="gaussian"),
        "MonteCarlo": pd.MonteCarlo(probes=PROBES),
        "Probing": pd.Probing(probes=PROBES),
        "Probing, sigma": pd.Probing(probes=PROBES, scale="sigma"),
        "Probing, unit": pd.Probing(probes=PROBES, scale="unit"),
        "Exact": pd.Exact("cone"),
    }


def is_gaussian(name: str) -> bool:
    """Whether the method's probes are the Gaussian vectors, which float64 would draw anew."""
    return name in ("FiniteDifference", "MonteCarlo, gaussian")


def relative(estimate: np.ndarray, truth: np.ndarray) -> float:
    """RMSE over the RMS of the truth, 0 where both are 0."""
    scale = np.abs(truth).max(initial=0)
    if scale == 0:
        return float(np.abs(estimate).max(initial=0) > 0)
    square = ((np.asarray(estimate, np.float64) - truth) / scale) ** 2
    return float(np.sqrt(square.mean() / ((truth / scale) ** 2).mean()))


@jax.jit
def differences(f: Any, x: jax.Array, variance: jax.Array, epsilon: jax.Array) -> jax.Array:
    """`pd.FiniteDifference` with a step that is traced, so that all steps share one program."""
    method = pd.FiniteDifference(probes=PROBES)
    object.__setattr__(method, "epsilon", epsilon)
    return method.evaluate(f, x, variance, KEY).divergence


def compare(
    case: Case,
    network: str,
    name: str,
    method: pd.Method | float,
    truths: dict[str, np.ndarray],
) -> tuple:
    """The last six columns of one row: a method, or a step of differences, in one precision on one input."""
    frame = case.frame
    assert frame.variance is not None
    f = rounding.tf32(case.f) if network == "TF32" else case.f
    if isinstance(method, int | float):
        estimate = differences(f, frame.color, frame.variance, jnp.float32(method))
    else:
        estimate = pd.divergence(f, frame.color, frame.variance, method=method, key=KEY)
    estimate = np.asarray(estimate)
    sample = estimate.ravel()[sampled(case)]
    total = relative(sample, truths["exact"])
    if isinstance(method, pd.Exact):
        numerical = elsewhere = total
    else:
        truth = truths["gaussian" if is_gaussian(name) else name]
        numerical = relative(estimate, truth)
        elsewhere = relative(estimate[case.untouched], truth[case.untouched])
    return network, name, numerical, elsewhere, total, bool(np.isfinite(estimate).all())


def measure(
    frame: pd.Frame,
    name: str,
    chosen: dict[str, pd.Method],
    *,
    networks: tuple[str, ...],
    epsilons: tuple[float, ...],
    scales: tuple[float, ...],
) -> Iterator[tuple]:
    """Rows without scene and spp."""
    coarse = pd.denoisers.load(name, precision="bfloat16")
    for case in cases(frame, pd.denoisers.load(name), scales):
        truths = float64_truths(case, chosen)
        label = (case.study, case.setting, case.exposure)
        for method_name, method in chosen.items():
            yield *label, *compare(case, "float32", method_name, method, truths)
        if case.setting != INPUTS[0]:
            continue
        for network in networks:
            used = case._replace(f=coarse.bind(frame)) if network == "bfloat16" else case
            for method_name, method in chosen.items():
                if method_name not in ("FiniteDifference", "Exact"):
                    row = compare(used, network, method_name, method, truths)
                    yield "precision", network, case.exposure, *row
            for epsilon in epsilons:
                row = compare(used, network, "FiniteDifference", epsilon, truths)
                yield "epsilon", f"{epsilon:g}", case.exposure, *row
            f = rounding.tf32(used.f) if network == "TF32" else used.f
            image = np.asarray(f(frame.color))
            error = relative(image, truths["image"])
            yield (
                *("precision", network, case.exposure, network, "the image itself"),
                *(error, error, error, bool(np.isfinite(image).all())),
            )


def main() -> None:
    parser = _common.parser(__doc__)
    parser.add_argument("--spp", type=int, nargs="*", default=SPP)
    parser.add_argument("--size", type=int, default=48, help="edge of the crop in pixels")
    parser.add_argument("--denoiser", default="oidn-hdr")
    parser.add_argument("--networks", nargs="*", choices=NETWORKS, default=NETWORKS)
    parser.add_argument("--methods", nargs="*", choices=methods(), default=tuple(methods()))
    parser.add_argument("--epsilons", type=float, nargs="*", default=EPSILONS)
    parser.add_argument("--scales", type=float, nargs="*", default=SCALES)
    parser.add_argument("--exact", type=int, default=2, help="frames on which Exact is run as well")
    parser.add_argument("--output", type=Path, default=HERE / "stability.csv")
    arguments = parser.parse_args()
    pd.enable_compilation_cache()
    names = _common.scenes(arguments.data, arguments.scenes)
    rows: list[tuple] = []
    with arguments.output.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(HEADER)
        frames = _common.series(arguments.data, names, arguments.spp)
        for number, (scene, spp, frame, _) in enumerate(frames):
            small = centre(pd.Frame(frame.color, frame.variance), arguments.size)
            for row in measure(
                small,
                arguments.denoiser,
                {
                    name: method
                    for name, method in methods().items()
                    if name in arguments.methods and (name != "Exact" or number < arguments.exact)
                },
                networks=tuple(arguments.networks),
                epsilons=tuple(arguments.epsilons),
                scales=tuple(arguments.scales),
            ):
                rows.append((*row[:3], scene, spp, *row[3:]))
                writer.writerow(rows[-1])
            file.flush()
            print(scene, spp, len(rows), "rows", flush=True)
    table = f"{_common.machine()}\n\n{_figures.summary(HEADER, rows)}\n"
    _common.write_text(arguments.output.with_suffix(".md"), table)
    _figures.plot(HEADER, rows, arguments.output.with_suffix(".png"))
    print(table)


if __name__ == "__main__":
    main()
