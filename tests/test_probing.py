"""Structured probes: what they cancel, how they nest, what they cost, when they stop."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import (
    counting_compilations,
    dense_jacobian_diagonal,
    divergence,
    divergence_and_error,
)

import progden_jax as pd
from progden_jax.divergence import _random, evaluate
from progden_jax.divergence.probing import MOST_PROBES, SCALES, colors, deflated, walsh

SIZE = (12, 14, 3)


@pytest.fixture(scope="module")
def x():
    return jnp.asarray(np.random.default_rng(0).gamma(2.0, 0.5, SIZE), jnp.float32)


@pytest.fixture(scope="module")
def variance(x):
    return 0.01 * x**2


@pytest.fixture(scope="module")
def diagonal(x):
    """∂f/∂x of `near`."""
    return dense_jacobian_diagonal(near, np.asarray(x))


def square(frame, row, column, size):
    """Colour and variance of that many pixels."""
    crop = np.s_[row : row + size, column : column + size]
    return pd.Frame(frame.color[crop], frame.variance[crop])


@pytest.fixture(scope="module")
def small(real_frame):
    """32×32 pixels of a render with OIDN's small network, and σ²·∂f/∂x of some values."""
    return known(pd.denoisers.load("oidn-hdr-small"), square(real_frame, 40, 30, 32))


@pytest.fixture(scope="module")
def wild(small):
    """The same with a firefly, σ = 1e6."""
    f, calm, _ = small
    color, variance = np.array(calm.color), np.array(calm.variance)
    color[FIREFLY], variance[FIREFLY] = 1e6, 1e12
    return known(f.denoiser, pd.Frame(color, variance))


def known(network, frame):
    f = network.bind(frame)
    truth = np.asarray(diagonal_at(PLACES, f, frame.color), np.float64)
    return f, frame, truth * frame.variance.ravel()[PLACES]


FIREFLY = 17, 13
INDEX = np.arange(32 * 32 * 3).reshape(32, 32, 3)
PLACES = np.setdiff1d(INDEX[1::4, 1::4], INDEX[FIREFLY])
"""Where the truth, which takes a tangent a value, is known: every fourth row and column."""


@jax.jit
def diagonal_at(places, f, x):
    """∂f/∂x at these flat indices."""
    tangent = jax.linearize(f, x)[1]

    def one(place):
        unit = jnp.zeros(x.size, x.dtype).at[place].set(1)
        return tangent(unit.reshape(x.shape)).ravel()[place]

    return jax.lax.map(one, places)


def near(x):
    """A filter over 3×3 pixels and the three channels, zero outside the image."""
    kernel = np.random.default_rng(1).normal(size=(3, 3, 3, 3)).astype(x.dtype)
    return jax.lax.conv_general_dilated(
        x[None], kernel, (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC")
    )[0]


lattice = jax.jit(colors, static_argnums=(0, 1))


@functools.partial(jax.jit, static_argnums=0)
def patterns(count, color):
    """The first Walsh functions of these colours, on an axis in front."""
    return jax.vmap(walsh, (0, None))(jnp.arange(count), color)


def test_walsh_functions_tell_apart_colors_by_their_lowest_bits():
    """Σ_k h_k(a) h_k(b) over the first 2^n is 2^n where a ≡ b modulo 2^n, else 0; Sylvester's matrix."""
    table = np.asarray(patterns(64, np.arange(64)))
    sylvester = np.ones((1, 1), int)
    for n in range(1, 7):
        sylvester = np.block([[sylvester, sylvester], [sylvester, -sylvester]])
        count = 2**n
        np.testing.assert_array_equal(table[:count, :count], sylvester)
        residue = np.arange(64) % count
        same = residue[:, None] == residue[None, :]
        np.testing.assert_array_equal(table[:count].T @ table[:count], count * same)


@pytest.mark.parametrize(("count", "apart"), [(4, 1), (16, 3), (64, 7), (256, 15), (1024, 19)])
def test_equal_colors_lie_far_apart(count, apart):
    """No two values of a channel within a distance of `apart` share their colour modulo `count`."""
    found = np.asarray(lattice(64, 64)) % count
    centre = found[32, 32]
    y, x = np.mgrid[-32:32, -32:32]
    inside = (x**2 + y**2 <= apart**2) & ((x != 0) | (y != 0))
    for channel in range(3):
        assert not (found[inside][:, channel] == centre[channel]).any()
    assert len(set(centre.tolist())) == 3


def test_colors_belong_to_positions():
    np.testing.assert_array_equal(lattice(40, 50)[:7, :9], lattice(7, 9))
    assert len(np.unique(lattice(64, 64))) == MOST_PROBES


@pytest.mark.parametrize("probes", [1, 7, 100])
@pytest.mark.parametrize("scale", SCALES)
def test_exact_for_pointwise_functions(probes, scale, x, variance):
    found = divergence(lambda x: x**2, x, variance, method=pd.Probing(probes=probes, scale=scale))
    np.testing.assert_allclose(found, 2 * x * variance, rtol=1e-5)


@pytest.mark.parametrize("scale", SCALES)
def test_exact_for_a_local_filter_once_its_footprint_is_covered(scale, x, variance, diagonal):
    truth = np.asarray(variance) * diagonal
    errors = {}
    for count in (8, 16):
        found = divergence(near, x, variance, method=pd.Probing(probes=count, scale=scale))
        errors[count] = np.abs(np.asarray(found) - truth).max() / np.abs(truth).max()
    # The 27 values that a 3×3 filter sees hold no second one of the own colour out of 16.
    assert errors[8] > 1e-2
    assert errors[16] < 1e-5


def test_nested(x, variance):
    """K probes are the first K of one sequence, each with the same field of signs."""
    key = jax.random.key(3)
    sigma = np.sqrt(np.asarray(variance))
    weight = sigma * (np.abs(np.asarray(jax.jit(near)(x))) + sigma / 10)
    b = weight * np.asarray(_random.signs(key, 0, x)) * patterns(11, lattice(*SIZE[:2]))
    contributions = sigma**2 / weight**2 * b * np.asarray(jax.jit(jax.vmap(near))(b))
    for count in (1, 3, 11):
        found = divergence(near, x, variance, method=pd.Probing(probes=count), key=key)
        expected = np.mean(contributions[:count], axis=0)
        np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(contributions[0]).max())


def for_each(keys, x, variance, method):
    """Divergences of `near` for many keys, in float64."""

    @jax.jit
    def run(keys):
        return jax.vmap(lambda key: pd.divergence(near, x, variance, method=method, key=key))(keys)

    return np.asarray(run(keys), np.float64)


def test_unbiased_at_every_number_of_probes(x, variance, diagonal):
    truth = np.asarray(variance) * diagonal
    keys = jax.random.split(jax.random.key(4), 600)
    for count, scale in ((1, "radiance"), (3, "sigma"), (3, "unit"), (11, "radiance")):
        found = for_each(keys, x, variance, pd.Probing(probes=count, scale=scale))
        error = found.std(0, ddof=1) / np.sqrt(len(keys))
        assert (np.abs(found.mean(0) - truth) < 5 * error + 1e-5 * np.abs(truth).max()).all()


def test_variance_is_the_closed_form(x, variance):
    """(σ_i²/w_i)² Σ_{j≠i} (J_ij w_j c_ij)² with c_ij the mean of h_k(i) h_k(j)."""
    n = x.size
    jacobian = np.asarray(jax.jit(jax.jacfwd(near))(x)).reshape(n, n)
    value, sigma2 = np.asarray(jax.jit(near)(x)).ravel(), np.asarray(variance).ravel()
    weight = np.sqrt(sigma2) * (np.abs(value) + np.sqrt(sigma2) / 10)
    keys = jax.random.split(jax.random.key(5), 2000)
    for count in (5, 8):
        table = np.asarray(patterns(count, lattice(*SIZE[:2]))).reshape(count, n)
        mixing = table.T @ table / count
        terms = jacobian * mixing * weight[None]
        np.fill_diagonal(terms, 0)
        expected = (sigma2 / weight) ** 2 * (terms**2).sum(1)
        found = for_each(keys, x, variance, pd.Probing(probes=count))
        measured = found.reshape(len(keys), n).var(0, ddof=1)
        np.testing.assert_allclose(measured.sum(), expected.sum(), rtol=0.1)
        np.testing.assert_allclose(measured, expected, rtol=0.5, atol=1e-4 * expected.max())


@pytest.fixture
def loud(variance):
    """The variance with three values that hold nearly all of it, and which these are."""
    where = np.zeros(SIZE, bool)
    where[4, 5, 0] = where[4, 5, 2] = where[10, 2, 1] = True
    return np.where(where, np.float32(1e4) * variance, variance), where


set_apart = jax.jit(deflated, static_argnums=1)


def test_outliers_get_probes_of_their_own(x, loud, diagonal):
    variance, where = loud
    for probes, expected in ((3, 0), (16, 3)):
        index, number = set_apart(variance, probes)
        assert len(index) == probes // 4
        assert number == expected
    assert set(np.asarray(index)[:3]) == set(np.flatnonzero(where))
    found = divergence(near, x, variance, method=pd.Probing(probes=16))
    truth = np.asarray(variance) * diagonal
    found = np.asarray(found)
    np.testing.assert_allclose(found[where], truth[where], rtol=1e-5)
    quiet = np.where(where, 0, variance)
    alone = np.asarray(divergence(near, x, quiet, method=pd.Probing(probes=13)))
    np.testing.assert_allclose(found[~where], alone[~where], rtol=1e-4, atol=1e-7)


def test_without_outliers_no_probe_is_spent_on_one_value(variance):
    for each in (variance, np.zeros_like(variance), np.ones_like(variance)):
        assert set_apart(each, 64)[1] == 0


def test_unbiased_beside_outliers(x, loud, diagonal):
    variance, where = loud
    truth = np.asarray(variance) * diagonal
    keys = jax.random.split(jax.random.key(4), 600)
    found = for_each(keys, x, variance, pd.Probing(probes=12))
    error = found.std(0, ddof=1) / np.sqrt(len(keys))
    assert (np.abs(found.mean(0) - truth) < 5 * error + 1e-5 * np.abs(truth)).all()
    assert (error[where] < 1e-6 * np.abs(truth[where])).all()


def median_error(method, f, frame, truth):
    """The relative RMSE where the truth is known, the median of three keys'."""
    found = [
        pd.divergence(f, frame.color, frame.variance, method=method, key=jax.random.key(seed))
        for seed in (6, 7, 8)
    ]
    found = [np.asarray(each, np.float64).ravel()[PLACES] for each in found]
    return np.median([np.sqrt(((each - truth) ** 2).mean() / (truth**2).mean()) for each in found])


@pytest.mark.parametrize(("probes", "share"), [(4, 0.8), (16, 0.4)])
def test_less_error_than_random_probes_on_a_network(probes, share, small):
    structured = median_error(pd.Probing(probes=probes), *small)
    assert structured < share * median_error(pd.MonteCarlo(probes=probes), *small)


@pytest.mark.parametrize("probes", [4, 16])
def test_a_firefly_does_not_drown_the_other_pixels(probes, small, wild):
    """The relative error elsewhere is at most three times that without it."""
    method = pd.Probing(probes=probes)
    assert median_error(method, *wild) < 3 * median_error(method, *small)


def test_one_replicate_does_not_claim_an_error(x, variance):
    found = divergence_and_error(near, x, variance, method=pd.Probing(probes=8))
    assert np.isinf(found.standard_error).all()
    found = divergence_and_error(near, x, variance, method=pd.Probing(probes=8, replicates=2))
    assert np.isfinite(found.standard_error).all()


def test_error_of_a_tile_is_bounded_and_not_loosely(real_frame, near_sighted):
    """Over keys, the variance of an image's mean is at most twice the mean of the variances / n."""
    frame = square(real_frame, 48, 38, 16)
    f = near_sighted.bind(frame)
    method = pd.Probing(probes=8, replicates=2)
    found = [
        pd.divergence_and_error(f, frame.color, frame.variance, method=method, key=key)
        for key in jax.random.split(jax.random.key(7), 100)
    ]
    means = np.asarray([np.mean(d.divergence) for d in found], np.float64)
    bounds = np.asarray([2 * np.mean(np.square(d.standard_error)) for d in found])
    bounds /= frame.color.size
    # 100 keys know the variance of the means to 14 %, three standard errors of it are allowed for.
    assert means.var(ddof=1) < 1.45 * bounds.mean()
    assert means.var(ddof=1) > 0.2 * bounds.mean()


TILES = [np.s_[row : row + 8, column : column + 8] for row in (0, 8) for column in (0, 8)]
"""Of 16×16 pixels, with `tile=8`; one after the other."""


@pytest.fixture(scope="module")
def stopped(real_frame, near_sighted):
    """What probing gives for a short-sighted network where one tile has a hundredth of the noise."""
    frame = square(real_frame, 48, 38, 16)
    quiet = np.array(frame.variance)
    quiet[TILES[0]] *= 1e-4
    run = functools.partial(evaluate, near_sighted.bind(frame), frame.color, quiet)
    return run, run(method=pd.Probing(tolerance=0.05, probes=128, tile=8))


def test_tolerance_stops_tile_by_tile(stopped):
    run, found = stopped
    assert found.probes.shape == (2, 2)
    spent = np.asarray(found.probes).ravel()
    assert spent[0] == 2
    assert 2 < np.sort(spent)[2] < 128
    for count in np.unique(spent):
        plain = run(method=pd.Probing(probes=int(count), replicates=2))
        for tile in (tile for tile, own in zip(TILES, spent, strict=True) if own == count):
            assert_same_estimate(found, plain, tile)


def test_a_tolerance_that_is_never_reached_spends_all_probes(stopped):
    run, _ = stopped
    strict = run(method=pd.Probing(tolerance=1e-9, probes=32, tile=8))
    np.testing.assert_array_equal(strict.probes, 32)
    assert_same_estimate(strict, run(method=pd.Probing(probes=32, replicates=2)), np.s_[:])


def assert_same_estimate(found, expected, where):
    for rtol, name in ((1e-3, "divergence"), (1e-2, "standard_error")):
        value, wanted = (np.asarray(getattr(each, name)) for each in (found, expected))
        atol = 1e-6 * np.abs(expected.divergence).max()
        np.testing.assert_allclose(value[where], wanted[where], rtol=rtol, atol=atol)


def test_tolerance_is_kept(real_frame, small):
    """The mean SURE of each tile lies within a few tolerances of what the exact divergence gives."""
    frame, tolerance = square(real_frame, 48, 38, 16), 0.08
    f, method = small[0].denoiser.bind(frame), pd.Probing(tolerance=tolerance, probes=128, tile=8)
    truth = np.asarray(pd.divergence(f, frame.color, frame.variance, method=pd.Exact("basis")))
    frame = jax.tree.map(np.asarray, frame)
    shares = []
    for key in jax.random.split(jax.random.key(8), 4):
        found = evaluate(f, frame.color, frame.variance, method=method, key=key)
        sure = (np.asarray(found.value) - frame.color) ** 2 - frame.variance
        for tile, spent in zip(TILES, np.asarray(found.probes).ravel(), strict=True):
            # A tile whose mean SURE is close to 0 runs out of probes first.
            if spent < 128:
                exact = (sure + 2 * truth)[tile].mean()
                shares.append((sure + 2 * np.asarray(found.divergence))[tile].mean() / exact - 1)
    assert len(shares) >= 12
    assert np.sqrt(np.mean(np.square(shares))) < tolerance
    assert np.abs(shares).max() < 4 * tolerance


def test_a_tile_without_variance_costs_two_probes(x):
    f = jax.tree_util.Partial(near)
    found = evaluate(f, x, np.zeros_like(x), method=pd.Probing(tolerance=0.01))
    assert not np.asarray(found.divergence).any()
    assert np.asarray(found.probes).tolist() == [[2]]


def test_padding_changes_nothing(real_frame, near_sighted):
    """On the pipeline's canvas the probes are the same: what differs is rounding."""
    frame = pd.Frame(real_frame.color[:20, :25], real_frame.variance[:20, :25])
    method = pd.Probing(probes=4)
    padded = pd.progressive_denoise(frame, near_sighted, method=method, outputs=["divergence"])
    padded = padded.divergence
    plain = pd.divergence(near_sighted.bind(frame), frame.color, frame.variance, method=method)
    np.testing.assert_allclose(padded, plain, rtol=1e-3, atol=1e-5 * np.abs(plain).max())


def test_does_not_depend_on_the_scale_of_radiance(x, variance):
    def f(x):  # homogeneous of degree 1
        return jnp.sqrt(near(x) ** 2 + x**2)

    method = pd.Probing(probes=8)
    expected = divergence(f, x, variance, method=method)
    for scale in (1e-6, 1e6):
        scaled = np.asarray(divergence(f, scale * x, scale**2 * variance, method=method))
        np.testing.assert_allclose(
            scaled / scale**2, expected, rtol=1e-3, atol=1e-5 * np.abs(expected).max()
        )


def test_every_number_of_probes_is_taken_and_compiles_once(x, variance):
    for count in range(1, MOST_PROBES + 1):
        assert pd.Probing(probes=count).probes == count
    f = jax.tree_util.Partial(near)
    method = pd.Probing(probes=MOST_PROBES)
    first = pd.divergence(f, x, variance, method=method)
    with counting_compilations() as compiled:
        pd.divergence(f, 2 * x, variance, method=method)
    assert compiled == []
    assert np.isfinite(first).all()


def test_messages():
    for count in (0, 1025, -3, True):
        with pytest.raises(
            ValueError, match="expected a whole number of at least 1 and at most 1024"
        ):
            pd.Probing(probes=count)
    with pytest.raises(
        ValueError, match="probes is 9, expected a multiple of replicates, which is 2: 10"
    ):
        pd.Probing(probes=9, replicates=2)
    with pytest.raises(ValueError, match="tolerance is 0, expected a number above 0"):
        pd.Probing(tolerance=0)
    with pytest.raises(ValueError, match="replicates is 1, and one field of signs cannot tell"):
        pd.Probing(tolerance=0.1, replicates=1)
    with pytest.raises(ValueError, match="expected one of 'radiance', 'sigma', 'unit'"):
        pd.Probing(scale="variance")
    with pytest.raises(ValueError, match="tile is 0"):
        pd.Probing(tile=0)
