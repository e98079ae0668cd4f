"""Structured probes: what they cancel, how they nest, what they cost, when they stop."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import counting_compilations, dense_jacobian_diagonal, divergence

import progden_jax as pd
from progden_jax.divergence import _random, evaluate
from progden_jax.divergence.probing import MOST_PROBES, SCALES, colors, deflated, walsh

SIZE = (12, 14, 3)


@pytest.fixture
def x():
    return jnp.asarray(np.random.default_rng(0).gamma(2.0, 0.5, SIZE), jnp.float32)


@pytest.fixture
def variance(x):
    return 0.01 * x**2


@pytest.fixture(scope="module")
def small(real_frame):
    """A 32×32 crop of a render with OIDN's small network, and the exact σ²·∂f/∂x."""
    crop = (slice(40, 72), slice(30, 62))
    return with_truth(pd.Frame(real_frame.color[crop], real_frame.variance[crop]))


@pytest.fixture(scope="module")
def wild(small):
    """The same with a firefly in one pixel."""
    _, frame, _ = small
    color, variance = (
        jnp.asarray(a).at[17, 13].set(v) for a, v in ((frame.color, 1e6), (frame.variance, 1e12))
    )
    return with_truth(pd.Frame(color, variance))


def with_truth(frame):
    f = pd.denoisers.load("oidn-hdr-small").bind(frame)
    truth = pd.divergence(f, frame.color, frame.variance, method=pd.Exact("cone"))
    return f, frame, np.asarray(truth)


def near(x):
    """A filter over 3×3 pixels and the three channels, zero outside the image."""
    kernel = np.random.default_rng(1).normal(size=(3, 3, 3, 3)).astype(x.dtype)
    return jax.lax.conv_general_dilated(
        x[None], kernel, (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC")
    )[0]


def test_walsh_functions_tell_apart_colors_by_their_lowest_bits():
    """Σ_k h_k(a) h_k(b) over the first 2^n is 2^n where a ≡ b modulo 2^n, else 0; Sylvester's matrix."""
    color = jnp.arange(64)[:, None, None]
    table = np.stack([np.asarray(walsh(k, color)).ravel() for k in range(64)])
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
    found = np.asarray(colors(64, 64)) % count
    centre = found[32, 32]
    y, x = np.mgrid[-32:32, -32:32]
    inside = (x**2 + y**2 <= apart**2) & ((x != 0) | (y != 0))
    for channel in range(3):
        assert not (found[inside][:, channel] == centre[channel]).any()
    assert len(set(centre.tolist())) == 3


def test_colors_belong_to_positions():
    np.testing.assert_array_equal(colors(40, 50)[:7, :9], colors(7, 9))
    assert len(np.unique(colors(64, 64))) == MOST_PROBES


@pytest.mark.parametrize("probes", [1, 2, 3, 7, 16, 100])
@pytest.mark.parametrize("scale", SCALES)
def test_exact_for_pointwise_functions(probes, scale, x, variance):
    found = divergence(lambda x: x**2, x, variance, method=pd.Probing(probes=probes, scale=scale))
    np.testing.assert_allclose(found, 2 * x * variance, rtol=1e-5)


@pytest.mark.parametrize("scale", SCALES)
def test_exact_for_a_local_filter_once_its_footprint_is_covered(scale, x, variance):
    truth = np.asarray(variance) * dense_jacobian_diagonal(near, np.asarray(x))
    errors = {}
    for count in (8, 16, 64):
        found = divergence(near, x, variance, method=pd.Probing(probes=count, scale=scale))
        errors[count] = np.abs(np.asarray(found) - truth).max() / np.abs(truth).max()
    # The 27 values that a 3×3 filter sees hold no second one of the own colour out of 16.
    assert errors[8] > 1e-2
    assert errors[16] < 1e-5
    assert errors[64] < 1e-5


def test_nested(x, variance):
    """K probes are the first K of one sequence, each with the same field of signs."""
    key = jax.random.key(3)
    sigma = np.sqrt(np.asarray(variance))
    weight = sigma * (np.abs(np.asarray(near(x))) + sigma / 10)
    signs = np.asarray(_random.signs(key, 0, x))
    contributions = []
    for k in range(11):
        b = weight * signs * np.asarray(walsh(k, colors(*SIZE[:2])))
        contributions.append(sigma**2 / weight**2 * b * np.asarray(near(jnp.asarray(b))))
    for count in (1, 2, 3, 4, 8, 11):
        found = divergence(near, x, variance, method=pd.Probing(probes=count), key=key)
        expected = np.mean(contributions[:count], axis=0)
        np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(contributions[0]).max())


def test_unbiased_at_every_number_of_probes(x, variance):
    truth = np.asarray(variance) * dense_jacobian_diagonal(near, np.asarray(x))
    keys = jax.random.split(jax.random.key(4), 600)
    for count in (1, 3, 11):
        for scale in SCALES:
            method = pd.Probing(probes=count, scale=scale)
            found = jax.jit(
                jax.vmap(
                    lambda key, method=method: divergence(near, x, variance, method=method, key=key)
                )
            )(keys)
            found = np.asarray(found, np.float64)
            error = found.std(0, ddof=1) / np.sqrt(len(keys))
            assert (np.abs(found.mean(0) - truth) < 5 * error + 1e-5 * np.abs(truth).max()).all()


def test_variance_is_the_closed_form(x, variance):
    """(σ_i²/w_i)² Σ_{j≠i} (J_ij w_j c_ij)² with c_ij the mean of h_k(i) h_k(j)."""
    n = x.size
    jacobian = np.asarray(jax.jacfwd(near)(x)).reshape(n, n)
    value, sigma2 = np.asarray(near(x)).ravel(), np.asarray(variance).ravel()
    weight = np.sqrt(sigma2) * (np.abs(value) + np.sqrt(sigma2) / 10)
    color = colors(*SIZE[:2])
    keys = jax.random.split(jax.random.key(5), 2000)
    for count in (2, 5, 8):
        table = np.stack([np.asarray(walsh(k, color)).ravel() for k in range(count)])
        mixing = table.T @ table / count
        terms = jacobian * mixing * weight[None]
        np.fill_diagonal(terms, 0)
        expected = (sigma2 / weight) ** 2 * (terms**2).sum(1)
        method = pd.Probing(probes=count)
        found = jax.jit(
            jax.vmap(
                lambda key, method=method: divergence(near, x, variance, method=method, key=key)
            )
        )(keys)
        measured = np.asarray(found, np.float64).reshape(len(keys), n).var(0, ddof=1)
        np.testing.assert_allclose(measured.sum(), expected.sum(), rtol=0.1)
        np.testing.assert_allclose(measured, expected, rtol=0.5, atol=1e-4 * expected.max())


@pytest.fixture
def loud(variance):
    """The variance with three values that hold nearly all of it, and which these are."""
    where = np.zeros(SIZE, bool)
    where[4, 5, 0] = where[4, 5, 2] = where[10, 2, 1] = True
    return jnp.where(where, 1e4 * variance, variance), where


def test_outliers_get_probes_of_their_own(x, loud):
    variance, where = loud
    for probes, expected in ((3, 0), (16, 3)):
        index, number = deflated(variance, probes)
        assert len(index) == probes // 4
        assert number == expected
    assert set(np.asarray(deflated(variance, 16)[0][:3])) == set(np.flatnonzero(where))
    found = divergence(near, x, variance, method=pd.Probing(probes=16))
    truth = np.asarray(variance) * dense_jacobian_diagonal(near, np.asarray(x))
    np.testing.assert_allclose(found[where], truth[where], rtol=1e-5)
    quiet = jnp.where(where, 0, variance)
    alone = divergence(near, x, quiet, method=pd.Probing(probes=13))
    np.testing.assert_allclose(found[~where], alone[~where], rtol=1e-4, atol=1e-7)


def test_without_outliers_no_probe_is_spent_on_one_value(variance):
    for each in (variance, jnp.zeros_like(variance), jnp.ones_like(variance)):
        assert deflated(each, 64)[1] == 0


def test_unbiased_beside_outliers(x, loud):
    variance, where = loud
    truth = np.asarray(variance) * dense_jacobian_diagonal(near, np.asarray(x))
    keys = jax.random.split(jax.random.key(4), 600)
    method = pd.Probing(probes=12)
    run = jax.jit(jax.vmap(lambda key: pd.divergence(near, x, variance, method=method, key=key)))
    found = np.asarray(run(keys), np.float64)
    error = found.std(0, ddof=1) / np.sqrt(len(keys))
    assert (np.abs(found.mean(0) - truth) < 5 * error + 1e-5 * np.abs(truth)).all()
    assert (error[where] < 1e-6 * np.abs(truth[where])).all()


@pytest.mark.parametrize("probes", [4, 16])
def test_a_firefly_does_not_drown_the_other_pixels(probes, small, wild):
    """σ = 1e6 in one pixel: the relative error elsewhere is at most three times that without it."""
    elsewhere = np.ones((32, 32), bool)
    elsewhere[17, 13] = False
    method, errors = pd.Probing(probes=probes), []
    for f, each, truth in (small, wild):
        found = [
            pd.divergence(f, each.color, each.variance, method=method, key=key)[elsewhere]
            for key in jax.random.split(jax.random.key(9), 5)
        ]
        errors.append(np.median([relative_rmse(d, truth[elsewhere]) for d in found]))
    assert errors[1] < 3 * errors[0]


def relative_rmse(found, truth):
    return float(np.sqrt(((np.asarray(found, np.float64) - truth) ** 2).mean() / (truth**2).mean()))


@pytest.mark.parametrize(("probes", "share"), [(4, 0.8), (16, 0.5), (64, 0.4)])
def test_less_error_than_random_probes_on_a_network(probes, share, small):
    f, frame, truth = small
    errors = [
        np.median(
            [
                relative_rmse(
                    pd.divergence(f, frame.color, frame.variance, method=method, key=key), truth
                )
                for key in jax.random.split(jax.random.key(6), 5)
            ]
        )
        for method in (pd.Probing(probes=probes), pd.MonteCarlo(probes=probes))
    ]
    assert errors[0] < share * errors[1]


def test_one_replicate_does_not_claim_an_error(x, variance):
    found = pd.divergence_and_error(near, x, variance, method=pd.Probing(probes=8))
    assert np.isinf(found.standard_error).all()
    found = pd.divergence_and_error(near, x, variance, method=pd.Probing(probes=8, replicates=2))
    assert np.isfinite(found.standard_error).all()


def test_error_of_a_tile_is_bounded_and_not_loosely(small):
    """Over keys, the variance of an image's mean is at most twice the mean of the variances / n."""
    frame = jax.tree.map(lambda a: a[8:24, 8:24], small[1])
    f = pd.denoisers.load("oidn-hdr-small").bind(frame)
    method = pd.Probing(probes=8, replicates=2)
    found = [
        pd.divergence_and_error(f, frame.color, frame.variance, method=method, key=key)
        for key in jax.random.split(jax.random.key(7), 100)
    ]
    means = np.asarray([float(d.divergence.mean()) for d in found])
    bounds = np.asarray([2 * float((d.standard_error**2).mean()) / frame.color.size for d in found])
    # 100 keys know the variance of the means to 14 %, three standard errors of it are allowed for.
    assert means.var(ddof=1) < 1.45 * bounds.mean()
    assert means.var(ddof=1) > 0.2 * bounds.mean()


def test_tolerance_stops_tile_by_tile(small):
    f, frame, truth = small
    # One tile has a hundredth of the noise.
    quiet = jnp.asarray(frame.variance).at[:16, :16].multiply(1e-4)
    loose = pd.Probing(tolerance=0.2, probes=128, tile=16)
    run = jax.jit(lambda method: evaluate(f, frame.color, quiet, method=method))
    found, strict = run(loose), run(dataclasses.replace(loose, tolerance=1e-9))
    assert found.probes.shape == (2, 2)
    spent = np.asarray(found.probes)
    assert spent[0, 0] == 2
    assert 2 < np.sort(spent.ravel())[2] < 128
    np.testing.assert_array_equal(strict.probes, 128)
    plain = evaluate(f, frame.color, quiet, method=pd.Probing(probes=128, replicates=2))
    np.testing.assert_allclose(
        strict.divergence, plain.divergence, rtol=1e-3, atol=1e-6 * np.abs(truth).max()
    )
    np.testing.assert_allclose(
        strict.standard_error, plain.standard_error, rtol=1e-2, atol=1e-6 * np.abs(truth).max()
    )


def test_a_stopped_tile_keeps_what_its_probes_gave(small):
    f, frame, truth = small
    method = pd.Probing(tolerance=0.05, probes=64, tile=16)
    found = evaluate(f, frame.color, frame.variance, method=method)
    spent = np.asarray(found.probes)
    for count in np.unique(spent):
        plain = pd.divergence(
            f, frame.color, frame.variance, method=pd.Probing(probes=int(count), replicates=2)
        )
        for row, column in np.argwhere(spent == count):
            tile = (slice(16 * row, 16 * row + 16), slice(16 * column, 16 * column + 16))
            np.testing.assert_allclose(
                found.divergence[tile], plain[tile], rtol=1e-3, atol=1e-6 * np.abs(truth).max()
            )


def test_tolerance_is_kept(small):
    """The mean SURE of each tile lies within a few tolerances of what the exact divergence gives."""
    f, frame, truth = small
    tolerance = 0.08
    method = pd.Probing(tolerance=tolerance, probes=128, tile=16)
    y = f(frame.color)
    exact = np.asarray(pd.sure(frame.color, y, frame.variance, jnp.asarray(truth, jnp.float32)))
    run = jax.jit(lambda key: evaluate(f, frame.color, frame.variance, method=method, key=key)[1:])
    shares = []
    for key in jax.random.split(jax.random.key(8), 8):
        divergence, _, spent = run(key)
        found = np.asarray(pd.sure(frame.color, y, frame.variance, divergence))
        for row, column in np.ndindex(2, 2):
            # One tile's mean SURE is close to 0, so its probes run out first.
            if spent[row, column] < 128:
                tile = (slice(16 * row, 16 * row + 16), slice(16 * column, 16 * column + 16))
                shares.append(found[tile].mean() / exact[tile].mean() - 1)
    assert len(shares) >= 24
    assert np.sqrt(np.mean(np.square(shares))) < tolerance
    assert np.abs(shares).max() < 4 * tolerance


def test_a_tile_without_variance_costs_two_probes(x):
    found = evaluate(near, x, jnp.zeros_like(x), method=pd.Probing(tolerance=0.01))
    assert not np.asarray(found.divergence).any()
    assert np.asarray(found.probes).tolist() == [[2]]


def test_padding_changes_nothing(real_frame):
    """On the pipeline's canvas the probes are the same: what differs is rounding."""
    frame = pd.Frame(real_frame.color[:40, :50], real_frame.variance[:40, :50])
    denoiser = pd.denoisers.load("oidn-hdr-small")
    method = pd.Probing(probes=4)
    padded = pd.progressive_denoise(frame, denoiser, method=method, outputs=["divergence"])
    padded = padded.divergence
    plain = pd.divergence(denoiser.bind(frame), frame.color, frame.variance, method=method)
    np.testing.assert_allclose(padded, plain, rtol=1e-3, atol=1e-5 * float(jnp.abs(plain).max()))


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_does_not_depend_on_the_scale_of_radiance(scale, x, variance):
    def f(x):  # homogeneous of degree 1
        return jnp.sqrt(near(x) ** 2 + x**2)

    method = pd.Probing(probes=8)
    expected = pd.divergence(f, x, variance, method=method)
    scaled = pd.divergence(f, scale * x, scale**2 * variance, method=method)
    np.testing.assert_allclose(
        scaled / scale**2, expected, rtol=1e-3, atol=1e-5 * float(jnp.abs(expected).max())
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
