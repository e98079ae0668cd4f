"""Denoisers for `--denoiser FILE.py:NAME`: linear, and compiled at once."""

import jax.numpy as jnp


def blur(x):
    """The mean over a pixel and those above and below it, zero outside."""
    # Padded by the edge, XLA would take minutes to compile what follows.
    padded = jnp.pad(x, ((1, 1), (0, 0), (0, 0)))
    return (padded[:-2] + x + padded[2:]) / 3


def dim(x):
    return 0.5 * x


constant = 3
