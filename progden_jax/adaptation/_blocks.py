"""The image cut into blocks, some to fit weights to, some to judge them by."""

import math

import numpy as np
from jaxtyping import Int

Kinds = Int[np.ndarray, "rows columns"]
"""Of every block what it is for: FIT, CHOOSE or TELL."""

KINDS = FIT, CHOOSE, TELL = range(3)

_TOLD, _CHOOSING = 0.15, 0.25
"""Shares of the blocks."""


def kinds(size: tuple[int, int], block: int, host: np.random.Generator) -> Kinds:
    """The kinds of all blocks, at random; blocks shrink until there are 16 or so.

    Raises
    ------
    ValueError
        If there are too few pixels.
    """
    while block > 1 and math.prod(-(-n // block) for n in size) < 16:
        block //= 2
    shape = (-(-size[0] // block), -(-size[1] // block))
    count = math.prod(shape)
    if count < 3:
        raise ValueError(
            f"the frame has {size[0]}×{size[1]} pixels, too few to fit weights to some and judge by others."
        )
    telling, choosing = (max(round(share * count), 1) for share in (_TOLD, _CHOOSING))
    found = np.repeat([FIT, CHOOSE, TELL], [count - choosing - telling, choosing, telling])
    return host.permutation(found).reshape(shape)


def spread(blocks: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """One value per block to one per pixel."""
    (rows, columns), (height, width) = blocks.shape, size
    return blocks[np.arange(height)[:, None] * rows // height, np.arange(width) * columns // width]


def means(values: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """One value per pixel to the mean of each block, as `spread` lays them out."""
    numbers = spread(np.arange(math.prod(shape)).reshape(shape), values.shape).ravel()
    total = np.bincount(numbers, values.ravel(), math.prod(shape))
    return (total / np.bincount(numbers, minlength=len(total))).reshape(shape)


def mean_and_error(values: np.ndarray) -> tuple[float, float]:
    """Of independent values; nothing is known of the error from one."""
    error = values.std(ddof=1) / len(values) ** 0.5 if len(values) > 1 else math.inf
    return float(values.mean()), float(error)
