"""Where each way to the divergence breaks in float32, TF32 and bfloat16.

    python -m experiments.stability.run

Every method is compared with float64 on the very same probes, so that only numbers, not chance, are seen:
"numerical" is the RMSE over pixels relative to the RMS of the float64 estimate; "elsewhere" leaves out the
pixels that were tampered with. "total" is against the exact divergence in float64 at sampled pixels that
were not tampered with, by unit vectors: there chance is included.
"""

import argparse
import csv
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

HERE = Path(__file__).parent
EPSILONS = tuple(float(f"{10**e:.2g}") for e in np.arange(-6, -0.9, 0.5))
SCALES = tuple(10.0**e for e in range(-6, 7, 2))
SPP = (8, 128)
PROBES = 4
SAMPLED = 64
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


def crop(frame: pd.Frame, size: int) -> pd.Frame:
    """The middle of a frame: colour and variance."""
    assert frame.variance is not None
    top, left = ((n - size) // 2 for n in frame.size)
    window = np.s_[top : top + size, left : left + size]
    return pd.Frame(frame.color[window], frame.variance[window])


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


def cases(frame: pd.Frame, load: Any, scales: tuple[float, ...]) -> Iterator[Case]:
    """Every input made of one crop; the first is the crop itself."""
    assert frame.variance is not None
    automatic, everything = load(), np.ones(frame.size, bool)
    for how in INPUTS:
        changed, untouched = tampered(frame, how)
        yield Case("inputs", how, "automatic", changed, automatic.bind(changed), untouched)
    fixed = load(exposure=float(automatic.bind(frame).exposure))
    for scale in scales:
        scaled = pd.Frame(frame.color * scale, frame.variance * scale**2)
        for name, denoiser in (("automatic", automatic), ("fixed", fixed)):
            yield Case("scale", f"{scale:g}", name, scaled, denoiser.bind(scaled), everything)


def float64_truths(case: Case) -> dict[str, np.ndarray]:
    """The same estimates in float64 by the name of their probes, and "exact" at `sampled` values."""
    frame = case.frame
    assert frame.variance is not None
    sigma = np.sqrt(np.asarray(frame.variance, np.float64))
    drawn = [np.asarray(_random.normal(KEY, k, frame.color)) for k in range(PROBES)]
    index = sampled(case)
    with jax.enable_x64(True):
        f, x, variance = jax.tree.map(
            lambda a: jnp.asarray(np.asarray(a), jnp.float64), (case.f, frame.color, frame.variance)
        )
        products = _tangents(f, x, jnp.asarray([sigma * b for b in drawn]))
        truths = {
            "gaussian": np.mean([sigma * b * p for b, p in zip(drawn, products, strict=True)], 0)
        }
        for name, method in methods().items():
            if not isinstance(method, pd.FiniteDifference) and name != "MonteCarlo, gaussian":
                estimate = pd.divergence(f, x, variance, method=method, key=KEY)
                truths[name] = np.asarray(estimate)
        truths["image"] = np.asarray(f(x))
        truths["exact"] = np.asarray(_diagonal(f, x, jnp.asarray(index)) * variance.ravel()[index])
    return truths


@jax.jit
def _tangents(f: Any, x: jax.Array, vectors: jax.Array) -> jax.Array:
    _, tangent = jax.linearize(f, x)
    return jax.lax.map(tangent, vectors)


@jax.jit
def _diagonal(f: Any, x: jax.Array, index: jax.Array) -> jax.Array:
    _, tangent = jax.linearize(f, x)

    def one(i: jax.Array) -> jax.Array:
        return tangent(jnp.zeros(x.size, x.dtype).at[i].set(1).reshape(x.shape)).ravel()[i]

    return jax.lax.map(one, index)


def sampled(case: Case) -> np.ndarray:
    """Flat indices of untouched values: a quarter those of the largest variance, the rest by chance."""
    values = np.flatnonzero(np.repeat(case.untouched[..., None], 3, -1))
    variance = np.asarray(case.frame.variance).ravel()[values]
    order = values[np.argsort(-variance)]
    largest = order[: SAMPLED // 4]
    rest = np.random.default_rng(1).permutation(order[SAMPLED // 4 :])
    return np.concatenate((largest, rest[: SAMPLED - len(largest)]))


def methods(epsilon: float = 1e-4) -> dict[str, pd.Method]:
    """The estimators compared, by name."""
    return {
        "FiniteDifference": pd.FiniteDifference(probes=PROBES, epsilon=epsilon),
        "MonteCarlo, gaussian": pd.MonteCarlo(probes=PROBES, distribution="gaussian"),
        "MonteCarlo": pd.MonteCarlo(probes=PROBES),
        "Probing": pd.Probing(probes=PROBES),
        "Probing, sigma": pd.Probing(probes=PROBES, scale="sigma"),
        "Probing, unit": pd.Probing(probes=PROBES, scale="unit"),
    }


def relative(estimate: np.ndarray, truth: np.ndarray) -> float:
    """RMSE over the RMS of the truth, 0 where both are 0."""
    scale = np.abs(truth).max(initial=0)
    if scale == 0:
        return float(np.abs(estimate).max(initial=0) > 0)
    square = ((np.asarray(estimate, np.float64) - truth) / scale) ** 2
    return float(np.sqrt(square.mean() / ((truth / scale) ** 2).mean()))


def compare(
    case: Case, network: str, name: str, method: pd.Method, truths: dict[str, np.ndarray]
) -> tuple:
    """The last six columns of one row: one method in one precision on one input."""
    frame = case.frame
    assert frame.variance is not None
    f = rounding.tf32(case.f) if network == "TF32" else case.f
    estimate = pd.divergence(f, frame.color, frame.variance, method=method, key=KEY)
    estimate = np.asarray(estimate)
    sample = estimate.ravel()[sampled(case)]
    total = relative(sample, truths["exact"])
    gaussian = isinstance(method, pd.FiniteDifference) or name == "MonteCarlo, gaussian"
    if isinstance(method, pd.Exact):
        numerical = elsewhere = total
    else:
        truth = truths["gaussian" if gaussian else name]
        numerical = relative(estimate, truth)
        elsewhere = relative(estimate[case.untouched], truth[case.untouched])
    return network, name, numerical, elsewhere, total, bool(np.isfinite(estimate).all())


def measure(
    frame: pd.Frame, name: str, epsilons: tuple[float, ...], scales: tuple[float, ...], exact: bool
) -> Iterator[tuple]:
    """Rows without scene and spp."""
    coarse = pd.denoisers.load(name, precision="bfloat16")
    for case in cases(frame, lambda **k: pd.denoisers.load(name, **k), scales):
        truths = float64_truths(case)
        label = (case.study, case.setting, case.exposure)
        found = methods() | ({"Exact": pd.Exact("cone")} if exact else {})
        for method_name, method in found.items():
            yield *label, *compare(case, "float32", method_name, method, truths)
        if case.setting != INPUTS[0]:
            continue
        exposed = type(coarse)(
            coarse.params, exposure=float(case.f.exposure), precision="bfloat16"
        ).bind(frame)
        for network in ("float32", "TF32", "bfloat16"):
            used = case._replace(f=exposed) if network == "bfloat16" else case
            for method_name, method in list(methods().items())[1:]:
                row = compare(used, network, method_name, method, truths)
                yield "precision", network, case.exposure, *row
            image = np.asarray(
                (rounding.tf32(used.f) if network == "TF32" else used.f)(frame.color)
            )
            error = relative(image, truths["image"])
            yield (
                *("precision", network, case.exposure, network, "the image itself"),
                *(error, error, error, bool(np.isfinite(image).all())),
            )
            for epsilon in epsilons:
                difference = methods(epsilon)["FiniteDifference"]
                row = compare(used, network, "FiniteDifference", difference, truths)
                yield "epsilon", f"{epsilon:g}", case.exposure, *row


def main() -> None:
    parser = _common.parser(__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("--spp", type=int, nargs="*", default=SPP)
    parser.add_argument("--size", type=int, default=64, help="edge of the crop in pixels")
    parser.add_argument("--denoiser", default="oidn-hdr")
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
            small = crop(frame, arguments.size)
            exact = number < arguments.exact
            for row in measure(
                small,
                arguments.denoiser,
                tuple(arguments.epsilons),
                tuple(arguments.scales),
                exact,
            ):
                rows.append((*row[:3], scene, spp, *row[3:]))
                writer.writerow(rows[-1])
            file.flush()
            print(scene, spp, len(rows), "rows", flush=True)
    table = f"{_common.machine()}\n\n{_figures.summary(HEADER, rows)}\n"
    arguments.output.with_suffix(".md").write_text(table)
    _figures.plot(HEADER, rows, arguments.output.with_suffix(".png"))
    print(table)


if __name__ == "__main__":
    main()
