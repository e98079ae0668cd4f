"""Dual buffers: two independent renders of one view, as one frame and the difference between them."""

import dataclasses
from typing import Any, NamedTuple, cast

import jax
from jaxtyping import Array, Float

from progden_jax import _checks
from progden_jax._numeric import safe_sqrt
from progden_jax.denoisers._base import Bound
from progden_jax.divergence import _random
from progden_jax.frame import Frame, repaired, share
from progden_jax.subaverages import SubAverages, averaged


class Halves(NamedTuple):
    """Two independent renders a and b of equal samples per pixel.

    Attributes
    ----------
    frame : their mean, buffer by buffer.
    difference : (a − b)/2 by buffer: a is the frame plus it, b the frame minus it. Buffers not named are
        shared. Noise in it and in the frame is uncorrelated, for both halves have one variance.
    """

    frame: Frame
    difference: dict[str, Array]

    def both(self) -> tuple[Frame, Frame]:
        """a and b."""
        return separate(self.frame, self.difference)


def halves(a: Frame, b: Frame) -> Halves:
    """From two frames: half buffers of one render, or renders with two seeds; bad pixels are repaired.

    The variance of the mean is (σ_a² + σ_b²)/4 where both frames have one, else the dual buffers' own,
    ((a − b)/2)², which is unbiased and off by about 140 % at every pixel.

    Raises
    ------
    ValueError
        If a frame is no single image, or the sizes or samples per pixel differ.
    """
    return paired(averaged((a, b), names=("a", "b")))


def paired(found: SubAverages) -> Halves:
    """Two sub-averages as halves.

    Raises
    ------
    ValueError
        If they are not two, or their shares differ.
    """
    if len(found.shares) != 2:
        raise ValueError(f"there are {len(found.shares)} sub-averages, expected two halves.")
    if found.shares[0] != found.shares[1]:
        first, second = (f"{float(found.frame.spp * share):g}" for share in found.shares)
        raise ValueError(
            f"the halves have {first} and {second} samples per pixel, expected equal ones."
        )
    return Halves(found.frame, {name: d[0] for name, d in found.differences.items()})


def split(frame: Frame, key: jax.Array) -> Halves:
    """Halves of a single render: x ± σ·g, g standard normal; bad pixels are repaired.

    Their noise is uncorrelated and of twice the variance, as that of true halves: what it adds to the sum of
    the two cancels. It is independent where the render's noise is normal. Albedo, normal and
    depth are shared.

    Raises
    ------
    ValueError
        If the frame is no single image, or has no variance.

    Notes
    -----
    Pang et al. 2021, "Recorrupted-to-Recorrupted", with equal shares.
    """
    _checks.image("frame.color", frame.color)
    if frame.variance is None:
        raise ValueError(
            "the frame has no variance, and its halves are made with it: give one, or two renders to "
            "`halves(a, b)`."
        )
    frame = repaired(frame)
    noise = safe_sqrt(cast(Array, frame.variance)) * _random.normal(key, 0, frame.color)
    return Halves(frame, {"color": noise})


class Around:
    """What denoisers around another, tied to one frame, have in common; `bind` is their own."""

    denoiser: Any

    @property
    def name(self) -> str | None:
        """The denoiser's, by which its mixer is found."""
        return getattr(self.denoiser, "name", None)

    def __call__(self, frame: Frame) -> Float[Array, "h w 3"]:
        """The image that it makes, (H, W, 3) linear radiance."""
        return self.bind(frame)(frame.color)

    def bind(self, frame: Frame) -> Bound:
        raise NotImplementedError


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class WithHalves(Around):
    """A denoiser that makes use of two independent halves, such as `progden_jax.denoisers.NFOR`.

    Parameters
    ----------
    denoiser : its ``bind(frame, halves=...)`` takes their colours.
    difference : (H, W, 3), (a − b)/2, see `Halves`; a constant in derivatives.
    """

    denoiser: Any
    difference: Float[Array, "h w 3"]

    def bind(self, frame: Frame) -> Bound:
        """f with y = f(x) for the frame that the halves make up."""
        a, b = separate(frame, {"color": self.difference})
        return self.denoiser.bind(frame, halves=(a.color, b.color))


def separate(frame: Frame, difference: dict[str, Array]) -> tuple[Frame, Frame]:
    """The frame plus and minus the difference, each with twice the variance and half of the samples."""
    for name, part in difference.items():
        found = getattr(frame, name)
        if found is None or found.shape != part.shape:
            raise ValueError(
                f"the halves differ in {name} by an array of shape {part.shape}, and this frame has "
                f"{'none' if found is None else found.shape}: halves belong to the frame that they make up."
            )
    part = share(frame, 2)

    def half(sign: int) -> Frame:
        changed = {name: getattr(frame, name) + sign * d for name, d in difference.items()}
        return part.replace(**changed)

    return half(1), half(-1)
