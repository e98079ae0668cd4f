"""The exact divergence in steps: what is interrupted and resumed gives the same bits."""

import copy
import itertools
import logging

import jax
import numpy as np
import pytest
from code_generation import as_for_users
from conftest import counting_compilations, dense_jacobian_diagonal
from test_exact import Network, network

import progden_jax as pd
from progden_jax import _checkpoint
from progden_jax.denoisers.graph import Conv, Input, MaxPool, Relu, Upsample
from progden_jax.divergence import running


@jax.tree_util.register_pytree_node_class
class Tree(Network):
    """A network whose weights are leaves, as the library's denoisers are."""

    def __init__(self, like):
        self.__dict__.update(like.__dict__)
        self.params = jax.tree.map(lambda p: np.asarray(p, np.float32), like.params)

    def tree_flatten(self):
        return (self.params,), (self.nodes, self.alignment, self.auxiliary)

    @classmethod
    def tree_unflatten(cls, static, children):
        tree = object.__new__(cls)
        (tree.params,) = children
        tree.nodes, tree.alignment, tree.auxiliary = static
        return tree


NETWORK = Tree(
    network((Input(), Conv((0,), "a"), Relu(1), MaxPool(2), Upsample(3), Conv((4, 0), "last")))
)
METHODS = {
    "cone": pd.Exact("cone", chunk=1),
    "coloring": pd.Exact("coloring", chunk=5),
    "basis": pd.Exact("basis", chunk=50),
}
SWEEP = pytest.mark.parametrize("method", METHODS.values(), ids=METHODS.keys())


X = np.random.default_rng(2).random((9, 14, 3), np.float32) + np.float32(0.1)


@pytest.fixture
def x():
    return X.copy()


class Stopped(Exception):
    pass


@pytest.fixture(autouse=True)
def two_cores(monkeypatch):
    """However many there are."""
    monkeypatch.setattr(running, "_steps_at_once", lambda: 2)


def stop_after(steps):
    """A progress callback that ends the run."""
    calls = itertools.count()

    def progress(done, total):
        if next(calls) == steps:
            raise Stopped

    return progress


@pytest.fixture(scope="module")
def value_and_diagonal():
    """f(x) and ∂f/∂x of the network at `x`."""
    return jax.jit(NETWORK)(X), dense_jacobian_diagonal(NETWORK, X)


@SWEEP
def test_it_is_the_exact_divergence_and_reports_progress(method, x, value_and_diagonal):
    variance = 0.1 * x
    seen = []
    found = pd.exact_divergence(
        NETWORK, x, variance, method=method, progress=lambda *now: seen.append(now)
    )
    value, diagonal = value_and_diagonal
    np.testing.assert_allclose(found.divergence, variance * diagonal, rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(found.value, value, rtol=1e-5, atol=1e-6)
    assert not np.asarray(found.standard_error).any()
    done, totals = zip(*seen, strict=True)
    assert done[0] == 0
    assert done[-1] == totals[0] == totals[-1]
    assert list(done) == sorted(set(done))
    assert len(done) > 3


@SWEEP
def test_resumed_is_uninterrupted_bit_for_bit(method, x, tmp_path):
    """Broken off twice; the second time and the last it starts where the one before stopped."""
    path = tmp_path / "part.npz"
    whole = pd.exact_divergence(NETWORK, x, x, method=method)
    starts = []

    def run(steps):
        stop = stop_after(steps)

        def progress(done, total):
            if len(starts) < started:
                starts.append(done)
            stop(done, total)

        started = len(starts) + 1
        return pd.exact_divergence(NETWORK, x, x, method=method, checkpoint=path, progress=progress)

    for steps in (2, 1):
        with pytest.raises(Stopped):
            run(steps)
    resumed = run(1000)
    assert starts[0] == 0 < starts[1] < starts[2]
    np.testing.assert_array_equal(resumed.divergence, whole.divergence)
    np.testing.assert_array_equal(resumed.value, whole.value)
    # What is finished stays until the caller removes it, and costs nothing then.
    np.testing.assert_array_equal(run(1).divergence, whole.divergence)
    assert starts[3] == running.ExactRun(NETWORK, x, x, method=method).total
    assert [p.name for p in tmp_path.iterdir()] == ["part.npz"]


@pytest.mark.parametrize(
    ("algorithm", "chunks", "step", "static"),
    [
        ("coloring", (5, 1, 16), "_colors_step", ("chunk", "dtype")),
        ("cone", (5, 8, 16), "_cone_step", ("nodes", "size", "number", "chunk")),
    ],
)
def test_chunks_change_no_bits(algorithm, chunks, step, static, x, monkeypatch):
    """Of cones from 5 windows at a time on, see `Exact`."""
    compiled = jax.jit(
        getattr(running, step).__wrapped__,
        static_argnames=static,
        compiler_options=as_for_users(),
    )
    monkeypatch.setattr(running, step, compiled)
    found = [
        pd.exact_divergence(NETWORK, x, x, method=pd.Exact(algorithm, chunk=chunk)).divergence
        for chunk in chunks
    ]
    np.testing.assert_array_equal(found[1], found[0])
    np.testing.assert_array_equal(found[2], found[0])


def test_one_compilation_per_size(x):
    def run(network, x):
        for algorithm in ("cone", "coloring"):
            pd.exact_divergence(network, x, x, method=METHODS[algorithm])

    run(NETWORK, x)
    other = copy.copy(NETWORK)
    other.params = jax.tree.map(lambda p: 2 * p, NETWORK.params)
    with counting_compilations() as compiled:
        run(other, 2 * x)
    assert compiled == []


@pytest.mark.parametrize("algorithm", ["cone", "coloring"])
def test_the_key_is_what_the_answer_depends_on(algorithm, x):
    def key(network=NETWORK, x=x, variance=None, **settings):
        method = pd.Exact(algorithm, **settings)
        variance = x if variance is None else variance
        return running.ExactRun(network, x, variance, method=method).key

    assert key() == key(variance=2 * x) == key(chunk=3)
    changed = x.copy()
    changed[3, 4, 1] += 1e-6
    weights = copy.copy(NETWORK)
    weights.params = jax.tree.map(lambda p: p.astype(np.float32) * 1.0001, NETWORK.params)
    assert len({key(), key(x=changed), key(network=weights), key(x=x[:8])}) == 4
    if algorithm == "coloring":
        assert key(reach=(8, 2)) != key()


def test_checkpoints_that_do_not_fit(x, tmp_path, caplog):
    path, method = tmp_path / "a.npz", pd.Exact("coloring", chunk=5)
    whole = pd.exact_divergence(NETWORK, x, x, method=method, checkpoint=path)
    with pytest.raises(ValueError, match="a.npz is the checkpoint of another run"):
        pd.exact_divergence(NETWORK, 2 * x, x, method=method, checkpoint=path)
    stored = path.read_bytes()
    for broken in (stored[: len(stored) // 2], b"", b"no checkpoint"):
        path.write_bytes(broken)
        with caplog.at_level(logging.WARNING):
            again = pd.exact_divergence(NETWORK, x, x, method=method, checkpoint=path)
        assert "a.npz is no whole checkpoint" in caplog.text
        caplog.clear()
        np.testing.assert_array_equal(again.divergence, whole.divergence)
        assert path.read_bytes()[:4] == stored[:4]


def test_it_is_written_on_the_way_and_a_full_disk_ends_nothing(x, tmp_path, monkeypatch, caplog):
    path, method = tmp_path / "a.npz", pd.Exact("coloring", chunk=5)
    monkeypatch.setattr(running, "SAVE_SECONDS", 0.0)
    there = []
    pd.exact_divergence(
        NETWORK,
        x,
        x,
        method=method,
        checkpoint=path,
        progress=lambda *_: there.append(path.exists()),
    )
    assert there[:2] == [False, True]
    path.unlink()

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(_checkpoint, "save", full)
    with caplog.at_level(logging.WARNING):
        pd.exact_divergence(NETWORK, x, x, method=method, checkpoint=path)
    assert "cannot write the checkpoint" in caplog.text


def test_messages(x, tmp_path):
    with pytest.raises(ValueError, match="runs on the host step by step"):
        jax.jit(lambda x: pd.exact_divergence(NETWORK, x, x).divergence)(x)
    with pytest.raises(ValueError, match="expected an Exact: other methods take no steps"):
        pd.exact_divergence(NETWORK, x, x, method=pd.MonteCarlo())  # pyright: ignore
    with pytest.raises(ValueError, match="nowhere does not exist: make it first"):
        pd.exact_divergence(NETWORK, x, x, checkpoint=tmp_path / "nowhere" / "a.npz")
    with pytest.raises(ValueError, match="variance has shape"):
        pd.exact_divergence(NETWORK, x, x[:3])
    with pytest.raises(ValueError, match="f, a function, does not show its layers"):
        pd.exact_divergence(lambda x: x, x, x, method=pd.Exact("cone"))
