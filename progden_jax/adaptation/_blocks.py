"""The image cut into blocks, some to fit weights to, some to judge them by."""

import math

import numpy as np
from jaxtyping import Int

Kinds = Int[np.ndarray, "rows columns"]
"""Of every block what it is for: FIT, CHOOSE or TELL."""

FIT, CHOOSE, TELL = range(3)

_TOLD = 0.15
"""Share that tells the gain, of an image in one fold."""

_CHOOSING = 0.3
"""Share that chooses, of the blocks that do not tell."""


def folds(size: tuple[int, int], block: int, count: int, host: np.random.Generator) -> list[Kinds]:
    """The kinds of all blocks, for each fold; every block tells in one, or few blocks where there is one.

    Blocks shrink until there are 16 or so.

    Raises
    ------
    ValueError
        If there are too few pixels.
    """
    while block > 1 and math.prod(-(-n // block) for n in size) < 16:
        block //= 2
    shape = (-(-size[0] // block), -(-size[1] // block))
    total = math.prod(shape)
    if total < 3 * count:
        raise ValueError(
            f"the frame has {size[0]}×{size[1]} pixels, too few to fit weights to some and judge by others."
        )
    order = host.permutation(total)
    told = np.array_split(order, count) if count > 1 else [order[: max(round(_TOLD * total), 1)]]
    found = []
    for numbers in told:
        others = host.permutation(np.setdiff1d(order, numbers))
        kinds = np.full(total, FIT)
        kinds[numbers] = TELL
        kinds[others[: max(round(_CHOOSING * len(others)), 1)]] = CHOOSE
        found.append(kinds.reshape(shape))
    return found


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
