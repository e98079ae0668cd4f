"""How mixers compare on scenes held out of training, beside what they must beat and cannot reach."""

import functools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from progden_jax import _checks, _windows, metrics
from progden_jax.mixing import ClosedForm, Mixer
from progden_jax.sure import sure
from progden_jax.training.index import Item
from progden_jax.tstatistic import t_bound

BASELINES = ("render", "denoised", "closed-form", "oracle")


class Scores(NamedTuple):
    """`score` (less is better) decides which weights are kept; `table` is image -> metric -> spp -> mean."""

    score: float
    table: dict[str, dict[str, dict[int, float]]]

    def flat(self) -> dict[str, float]:
        """Names such as mix/rmse/32spp -> value, for curves."""
        return {
            f"{image}/{metric}/{spp}spp": value
            for image, by_metric in self.table.items()
            for metric, by_spp in by_metric.items()
            for spp, value in by_spp.items()
        }


def oracle_alpha(
    x: Float[Array, "h w 3"],
    y: Float[Array, "h w 3"],
    reference: Float[Array, "h w 3"],
    *,
    window: int = 7,
) -> Float[Array, "h w 3"]:
    """α of least squares against the reference over a window per channel: a bound on what mixing can gain.

    clip(Σ(μ − x)(y − x) / Σ(y − x)², 0, 1), the sums over window × window pixels (odd); 0 where y equals x.
    """
    _checks.image("x", x)
    for name, value in (("y", y), ("reference", reference)):
        _checks.same_shape(name, value, "x", x)
    _checks.odd_int("window", window)
    total = _windows.box_sum((y - x) ** 2, window)
    product = _windows.box_sum((reference - x) * (y - x), window)
    usable = total > 0
    return jnp.where(usable, jnp.clip(product / jnp.where(usable, total, 1), 0, 1), 0)


class HeldOut:
    """The held-out examples, and the errors of images that need no training.

    Parameters
    ----------
    items, arrays : see `data.Examples`; of several divergences the first is taken.
    """

    def __init__(self, items: Sequence[Item], arrays: Mapping[str, np.ndarray]) -> None:
        self.items = tuple(items)
        names = ("color", "denoised", "variance", "divergence", "reference")
        self._arrays = {name: jnp.asarray(arrays[name]) for name in names}
        self._arrays["divergence"] = self._arrays["divergence"][:, 0]

    @functools.cached_property
    def _baselines(self) -> dict[str, np.ndarray]:
        return {name: np.asarray(v) for name, v in _baseline_errors(self._arrays).items()}

    def scores(self, mixer: Mixer, score: str = "balanced") -> Scores:
        """Means over scenes per spp. The score is of ratios to the denoiser's errors, per render.

        "balanced" is the mean of the ratios of SMAPE and RMSE, "smape" and "rmse" one of them.
        """
        mixed = np.asarray(_mixed_errors(self._arrays, mixer))
        found = {**self._baselines, "mix": mixed}
        floor = np.finfo(np.float32).tiny
        ratios = mixed / np.maximum(self._baselines["denoised"], floor)
        columns = {"rmse": [0], "smape": [1], "balanced": [0, 1]}[score]
        return Scores(float(ratios[:, columns].mean()), tabulate(self.items, found))


def tabulate(
    items: Sequence[Item],
    errors: Mapping[str, Float[np.ndarray, "n m"]],
    names: Sequence[str] = ("rmse", "smape"),
) -> dict[str, dict[str, dict[int, float]]]:
    """Image -> metric -> spp -> mean over scenes, of errors as `errors` gives them, or of these names."""
    spp = np.asarray([item.spp for item in items])
    return {
        image: {
            metric: {int(n): float(values[spp == n, column].mean()) for n in np.unique(spp)}
            for column, metric in enumerate(names)
        }
        for image, values in errors.items()
    }


def errors(image: Float[Array, "h w 3"], reference: Float[Array, "h w 3"]) -> Float[Array, "2"]:
    """RMSE and SMAPE."""
    return jnp.stack([metrics.rmse(image, reference), metrics.smape(image, reference)])


@jax.jit
def _baseline_errors(arrays: Mapping[str, Array]) -> dict[str, Array]:
    def one(example: Mapping[str, Array]) -> dict[str, Array]:
        x, y, reference = example["color"], example["denoised"], example["reference"]
        best = oracle_alpha(x, y, reference)
        images = {
            "render": x,
            "denoised": y,
            "closed-form": _mix(example, ClosedForm()),
            "oracle": x + best * (y - x),
        }
        return {name: errors(image, reference) for name, image in images.items()}

    return jax.lax.map(one, arrays)


@jax.jit
def _mixed_errors(arrays: Mapping[str, Array], mixer: Mixer) -> Array:
    return jax.lax.map(lambda e: errors(_mix(e, mixer), e["reference"]), arrays)


def _mix(example: Mapping[str, Array], mixer: Mixer) -> Array:
    x, y, variance = example["color"], example["denoised"], example["variance"]
    risk = sure(x, y, variance, example["divergence"])
    alpha = mixer(x, y, variance, example["divergence"], risk)
    return x + t_bound(alpha, x, y, variance) * (y - x)
