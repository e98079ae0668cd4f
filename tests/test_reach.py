"""How far functions reach, as found from their jaxprs: never too little, and tight where it is followed."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen
from jax import lax

import progden_jax as pd
from progden_jax.divergence import _reach

SHAPE = (24, 20, 3)


def conv(x, height=3, width=3, out=3, **settings):
    kernel = jnp.ones((height, width, x.shape[-1], out))
    strides = settings.pop("strides", (1, 1))
    numbers = ("NHWC", "HWIO", "NHWC")
    return lax.conv_general_dilated(
        x[None], kernel, strides, "SAME", dimension_numbers=numbers, **settings
    )[0]


def neighbours(x, rows, columns, mode):
    h, w, _ = x.shape
    padded = jnp.pad(x, ((rows, rows), (columns, columns), (0, 0)), mode=mode)
    return [
        padded[i : i + h, j : j + w] for i in range(2 * rows + 1) for j in range(2 * columns + 1)
    ]


def up(x):
    return jnp.repeat(jnp.repeat(x, 2, 0), 2, 1)


def reshaped_pool(x):
    h, w, c = x.shape
    return x.reshape(h // 2, 2, w // 2, 2, c).max((1, 3))


def kernel_predicting(x):
    kernels = jax.nn.softmax(conv(jax.nn.relu(conv(x)), out=25))
    near = neighbours(x, 2, 2, "constant")
    return sum(kernels[..., i, None] * near[i] for i in range(25))


def pixel_shuffled(x):
    h, w, _ = x.shape
    down = conv(x, out=12, strides=(2, 2)).reshape(h // 2, w // 2, 2, 2, 3)
    return conv(down.transpose(0, 2, 1, 3, 4).reshape(h, w, 3))


def transposed(x):
    small = conv(x, strides=(2, 2))
    return lax.conv_transpose(small[None], jnp.ones((4, 4, 3, 3)), (2, 2), "SAME")[0]


def branching(x):
    return lax.cond(x.sum() > 0, lambda x: conv(x), lambda x: conv(x, 1, 5), x)


def mirrored(x):
    return conv(x[::-1])[::-1] + jnp.flip(conv(jnp.flip(x, 1), 1, 5), 1)


def pool_of_flax(x):
    return up(linen.max_pool(x[None], (2, 2), (2, 2))[0]) + up(
        linen.avg_pool(x[None], (2, 2), (2, 2))[0]
    )


FAR = (SHAPE[0] - 1, SHAPE[1] - 1)
REACHES = {
    "pointwise": (lambda x: jnp.log1p(x) * x[..., ::-1], (0, 0)),
    "constant": (lambda x: jnp.ones_like(x), (0, 0)),
    "convolutions": (lambda x: conv(jax.nn.relu(conv(x, 3, 5))), (2, 3)),
    "dilated": (lambda x: conv(x, rhs_dilation=(3, 2)), (3, 2)),
    "pooled": (lambda x: conv(up(conv(linen.max_pool(conv(x), (2, 2), (2, 2))))), (5, 5)),
    "pooled by reshape": (lambda x: up(reshaped_pool(x)), (1, 1)),
    "flax's pools": (pool_of_flax, (1, 1)),
    "kernel-predicting": (kernel_predicting, (2, 2)),
    "pixel-shuffled": (pixel_shuffled, (3, 3)),
    "transposed convolution": (transposed, (3, 3)),
    "reflected borders": (lambda x: sum(neighbours(x, 3, 2, "reflect")), (3, 2)),
    "median": (lambda x: jnp.median(jnp.stack(neighbours(x, 1, 1, "constant")), 0), (1, 1)),
    "wrapped around": (lambda x: x + jnp.roll(x, 1, 0), (FAR[0], 0)),
    "split": (lambda x: jnp.concatenate(jnp.split(conv(x), 3, -1)[::-1], -1), (1, 1)),
    "checkpointed": (jax.checkpoint(lambda x: conv(jax.nn.relu(conv(x)))), (2, 2)),
    "branches": (branching, (1, 2)),
    "mirrored and back": (mirrored, (1, 2)),
    "of the mean": (lambda x: x / x.mean(), FAR),
    "a constant mean": (lambda x: conv(x / lax.stop_gradient(x.mean())), (1, 1)),
    "matrix": (lambda x: jnp.einsum("ij,jkc->ikc", jnp.eye(SHAPE[0]), conv(x)), (FAR[0], 1)),
    "Fourier": (lambda x: jnp.fft.ifft(jnp.fft.fft(x, axis=1), axis=1).real, (0, FAR[1])),
    "flattened": (lambda x: jnp.tanh(x.reshape(-1)).reshape(x.shape), (0, FAR[1])),
    "jitted": (jax.jit(lambda x: conv(jax.jit(conv)(x))), (2, 2)),
}


@pytest.mark.parametrize("name", REACHES)
def test_radii(name):
    f, expected = REACHES[name]
    assert _reach.radii(f, jnp.zeros(SHAPE)) == expected


@pytest.mark.parametrize("name", ["pooled", "pixel-shuffled", "transposed convolution", "median"])
def test_no_pixel_further_away_matters_and_one_as_far_does(name):
    f, (radius, _) = REACHES[name]
    x = jnp.asarray(np.random.default_rng(0).random((12, 6, 3)), jnp.float32)
    jacobian = np.abs(jax.jit(jax.jacfwd(f))(x)).max((1, 2, 4, 5))
    distance = np.abs(np.arange(12)[:, None] - np.arange(12))
    assert distance[jacobian > 0].max() == radius


def test_oidn_reaches_as_far_as_it_says():
    frame = pd.Frame(*[jnp.ones((256, 224, 3))] * 4)
    for name in ("oidn-hdr-alb-nrm-small", "oidn-hdr-calb-cnrm-large"):
        f = pd.denoisers.load(name).bind(frame)
        # On CPUs a convolution of upsampled pixels is one of 2×2 coarse ones, of which each fine pixel takes
        # its share: the analysis sees no shares, and counts a coarse pixel more at each of four levels.
        for radius in _reach.radii(f, frame.color):
            assert radius in (f.receptive_radius, f.receptive_radius + 1 + 2 + 4 + 8)


def test_what_is_not_followed_is_named():
    loop = functools.partial(lax.fori_loop, 0, 2, lambda _, x: conv(x))
    for f, name in ((loop, "'scan'"), (lambda x: x.at[0].multiply(x[1]), "'scatter")):
        with pytest.raises(_reach.UnknownReachError, match=f"uses the primitive {name}"):
            _reach.radii(f, jnp.zeros(SHAPE))
    # Of no consequence where it is not differentiated.
    assert _reach.radii(lambda x: x * lax.stop_gradient(loop(x)), jnp.zeros(SHAPE)) == (0, 0)


def test_works_on_traced_weights_and_under_vmap():
    def of(weight, x):
        return jnp.asarray(_reach.radii(lambda y: conv(weight * y), x))

    found = jax.jit(jax.vmap(of))(jnp.ones(2), jnp.zeros((2, *SHAPE)))
    np.testing.assert_array_equal(found, [[1, 1], [1, 1]])
