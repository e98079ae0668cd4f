"""The project's own denoisers: what they see, what they give, their derivatives, and their files."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import progden_jax as pd
from progden_jax import _safetensors
from progden_jax.denoisers import INPUT_SETS, KPCN, UNet, files, graph
from progden_jax.denoisers.tza import read_tza

EVERYTHING = INPUT_SETS["hdr-alb-nrm-var"]
SIZE = (9, 13)


def tiny_kpcn(inputs=(), **settings) -> KPCN:
    net = KPCN.init(jax.random.key(1), inputs, layers=1, width=8, layer_size=3, **settings)
    # Kernels far from a box, so that their derivatives matter.
    last = {name: 20 * value for name, value in net.params["kernel"].items()}
    return KPCN({**net.params, "kernel": last}, inputs)


@functools.cache
def network(kind: str) -> pd.Denoiser:
    """That takes every input."""
    if kind == "kpcn":
        return tiny_kpcn(EVERYTHING)
    return UNet.init(jax.random.key(0), EVERYTHING, size="small")


@pytest.fixture(scope="module")
def frame(real_frame):
    return jax.tree.map(
        lambda a: a[50 : 50 + SIZE[0], 60 : 60 + SIZE[1]], real_frame.replace(spp=None)
    )


@pytest.fixture(params=["unet", "kpcn"])
def denoiser(request):
    return network(request.param)


def cut(frame, height, width):
    return jax.tree.map(lambda a: a[:height, :width], frame)


@pytest.mark.parametrize("kind", list(INPUT_SETS))
@pytest.mark.parametrize("architecture", [UNet, KPCN])
def test_every_input_set(frame, architecture, kind):
    """Full-size networks of every set take frames that hold what they ask for, and no others."""
    inputs = INPUT_SETS[kind]
    net = jax.eval_shape(lambda: architecture.init(jax.random.key(0), inputs, name=kind))
    assert isinstance(net, pd.Denoiser)
    assert repr(net) == f"{architecture.__name__}({kind!r}, inputs={inputs})"
    assert jax.eval_shape(net, frame).shape == frame.color.shape
    for role in inputs:
        with pytest.raises(ValueError, match=f"this frame has no {role}: choose a network"):
            net.bind(frame.replace(**{role: None}))


def test_what_the_networks_see(frame):
    """log(1 + v) / log(65505) of radiance and albedo, unit normals, arctan of variance; no exposure."""
    color = np.array(frame.color)
    color[0, 0], color[0, 1, 0], color[0, 2] = np.nan, -2.0, 1e6
    frame = frame.replace(color=color)
    shown = network("unet").bind(frame).layered(frame.color)
    sane = np.nan_to_num(np.maximum(color, 0)).astype(np.float64)
    expected = [
        np.log1p(sane) / np.log(65505),
        np.log1p(np.asarray(frame.albedo, np.float64)) / np.log(65505),
        np.asarray(frame.normal) / 2 + 0.5,
        np.arctan(np.asarray(frame.variance)),
    ]
    assert shown.inputs.shape == (16, 16, 12)
    inputs = np.asarray(shown.inputs)
    np.testing.assert_allclose(
        inputs[: SIZE[0], : SIZE[1]], np.concatenate(expected, -1), rtol=1e-5, atol=1e-7
    )
    assert not inputs[SIZE[0] :].any()
    assert not inputs[:, SIZE[1] :].any()
    np.testing.assert_allclose(
        shown.decode(shown.inputs[0, :, :3]), np.pad(sane, ((0, 0), (0, 3), (0, 0)))[0], rtol=2e-5
    )


def test_any_size_and_canvas(frame, denoiser):
    """Sizes that share a canvas share a program; padded with a traced true size is as without."""
    plain = denoiser(cut(frame, 5, 11))
    padded = pd.denoise(cut(frame, 5, 11), denoiser).image
    np.testing.assert_allclose(padded, plain, rtol=1e-5, atol=1e-6)
    for size in ((1, 1), (1, 13), (9, 1)):
        small = pd.denoise(cut(frame, *size), denoiser).image
        assert small.shape == (*size, 3)
        assert np.isfinite(small).all()
        assert (small >= 0).all()


def test_pipeline_eager_is_jitted(frame):
    frame, denoiser = cut(frame, 5, 11), network("kpcn")
    eager = pd.progressive_denoise(frame, denoiser)
    jitted = jax.jit(pd.progressive_denoise)(frame, denoiser)
    for name in ("image", "alpha", "denoised", "divergence"):
        a, b = np.asarray(getattr(eager, name)), np.asarray(getattr(jitted, name))
        np.testing.assert_allclose(a, b, atol=2e-4 * np.abs(b).max() + 1e-9, err_msg=name)
    assert np.asarray(eager.divergence).any()


def test_every_weight_of_a_fresh_network_learns(frame, denoiser):
    frame = cut(frame, 5, 11)
    gradient = jax.jit(jax.grad(lambda d: (d.bind(frame)(frame.color) ** 2).mean()))(denoiser)
    found = jax.tree_util.tree_leaves_with_path(gradient)
    assert len(found) == len(jax.tree.leaves(denoiser))
    for path, leaf in found:
        assert np.isfinite(leaf).all(), path
        assert np.asarray(leaf).any(), path


def test_every_divergence_method_on_kpcn(frame):
    """The exact ones agree in float64, the others on average."""
    with jax.enable_x64(True):
        wide, denoiser = jax.tree.map(
            lambda a: jnp.asarray(np.asarray(a), jnp.float64),
            (cut(frame, 5, 7), tiny_kpcn(("variance",), kernel_size=3)),
        )
        f = denoiser.bind(wide)
        assert (f.receptive_radius, f.alignment) == (2, 1)
        assert set(pd.Exact().cost(f, wide.color)) == {"basis", "coloring", "cone"}
        methods = {
            "basis": pd.Exact("basis"),
            "coloring": pd.Exact("coloring"),
            "cone": pd.Exact("cone"),
            "differences": pd.FiniteDifference(64, epsilon=1e-6),
            "probing": pd.Probing(64),
        }

        @jax.jit
        def run(f, x, variance):
            return {
                name: pd.divergence_and_error(f, x, variance, method=m, key=jax.random.key(2))
                for name, m in methods.items()
            }

        results = run(f, wide.color, wide.variance)
        expected = np.asarray(results["basis"].divergence)
        for name, found in results.items():
            error = np.asarray(found.divergence) - expected
            if isinstance(methods[name], pd.Exact):
                np.testing.assert_allclose(error, 0, atol=1e-11 * np.abs(expected).max())
            else:
                share = np.abs(error) / (np.asarray(found.standard_error) + 1e-12)
                assert np.median(share) < 1.2, name


def test_what_the_divergence_of_a_unet_looks_into():
    """Its layers are OIDN's, whose cones are tested."""
    ours, theirs = network("unet"), pd.denoisers.load("oidn-hdr-small")
    assert ours.nodes == theirs.nodes
    assert ours.receptive_radius == theirs.receptive_radius == 94
    assert graph.alignment(ours.nodes) == 16


def test_the_variance_is_an_input(frame):
    frame, net = cut(frame, 5, 11), network("kpcn")
    other = frame.replace(variance=100 * frame.variance + 1)
    assert np.abs(net(frame) - net(other)).max() > 1e-4


def test_kpcn_filters_linear_radiance_inside_the_image(frame):
    """Against a loop in float64, the kernel being the same everywhere."""
    logits = np.random.default_rng(3).normal(size=25)
    net = tiny_kpcn()
    flat = {
        "kernel": np.zeros_like(net.params["kernel"]["kernel"]),
        "bias": logits.astype(np.float32),
    }
    found = KPCN({**net.params, "kernel": flat})(frame)
    x, weights = np.asarray(frame.color, np.float64), np.exp(logits).reshape(5, 5)
    height, width = SIZE
    expected = np.zeros_like(x)
    for i in range(height):
        for j in range(width):
            rows = range(max(i - 2, 0), min(i + 3, height))
            columns = range(max(j - 2, 0), min(j + 3, width))
            share = weights[np.ix_([r - i + 2 for r in rows], [c - j + 2 for c in columns])]
            near = x[np.ix_(rows, columns)]
            expected[i, j] = (share[..., None] * near).sum((0, 1)) / share.sum()
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_files_round_trip(tmp_path, frame, monkeypatch):
    net = network("kpcn")
    pd.denoisers.save(tmp_path / "a.safetensors", net, dtype="float32", metadata={"seed": "1"})
    again = pd.denoisers.load(tmp_path / "a.safetensors")
    assert isinstance(again, KPCN)
    assert (again.name, again.inputs) == ("a", EVERYTHING)
    jax.tree.map(np.testing.assert_array_equal, again.params, dict(net.params))
    assert _safetensors.read(tmp_path / "a.safetensors")[1] == {
        "format": "progden_jax",
        "dtype": "float32",
        "architecture": "kpcn",
        "seed": "1",
        "inputs": "albedo,normal,variance",
    }
    monkeypatch.setattr(files, "FOLDER", tmp_path)
    pd.denoisers.save(
        tmp_path / "unet-hdr-var.safetensors",
        UNet.init(jax.random.key(2), ("variance",), size="small"),
    )
    assert pd.denoisers.names()[-1] == "unet-hdr-var"
    assert "a" not in pd.denoisers.names()
    shipped = pd.denoisers.load("unet-hdr-var")
    assert (shipped.name, shipped.inputs) == ("unet-hdr-var", ("variance",))
    halves = jax.tree.map(lambda a: np.asarray(a, np.float16), network("unet").params)
    pd.denoisers.save(tmp_path / "b.safetensors", network("unet"))
    read = pd.denoisers.load(tmp_path / "b.safetensors").params
    jax.tree.map(np.testing.assert_array_equal, read, halves)
    assert jax.tree.leaves(read)[0].dtype == np.float32
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "a.safetensors",
        "b.safetensors",
        "unet-hdr-var.safetensors",
    ]


def test_weights_as_an_archive(tmp_path):
    net = UNet.init(jax.random.key(0), ("albedo", "normal"), size="small")
    pd.denoisers.save_tza(tmp_path / "u.tza", net, dtype="float32")
    kernel = read_tza(tmp_path / "u.tza")["enc_conv0.weight"]
    np.testing.assert_array_equal(kernel.transpose(2, 3, 1, 0), net.params["enc_conv0"]["kernel"])
    assert pd.denoisers.load(tmp_path / "u.tza").inputs == ("albedo", "normal")
    with pytest.raises(ValueError, match="takes albedo and normal and variance besides the colour"):
        pd.denoisers.save_tza(tmp_path / "v.tza", network("unet"))
    with pytest.raises(ValueError, match="the denoiser is a KPCN; a .tza file holds OIDN's U-Net"):
        pd.denoisers.save_tza(tmp_path / "k.tza", network("kpcn"))
    assert [p.name for p in tmp_path.iterdir()] == ["u.tza"]


def test_files_that_are_no_denoisers(tmp_path):
    load, whole = pd.denoisers.load, tmp_path / "whole.safetensors"
    net = tiny_kpcn()
    pd.denoisers.save(whole, net)
    data = whole.read_bytes()
    (tmp_path / "cut.safetensors").write_bytes(data[: len(data) // 2])
    (tmp_path / "text.safetensors").write_bytes(b"nonsense")
    for name in ("cut", "text"):
        with pytest.raises(
            ValueError, match=f"{name}.safetensors is no safetensors file, or is cut"
        ):
            load(tmp_path / f"{name}.safetensors")
    with pytest.raises(
        ValueError, match="cannot read the weights .*none.safetensors: No such file"
    ):
        load(tmp_path / "none.safetensors")
    foreign = tmp_path / "foreign.safetensors"
    foreign.write_bytes(_safetensors.save({"a": np.ones(2)}))
    with pytest.raises(ValueError, match="was not written by progden_jax"):
        load(foreign)
    _safetensors.write(foreign, net.params, {"architecture": "mixer"}, dtype="float32")
    with pytest.raises(
        ValueError, match="holds the weights of 'mixer', expected a denoiser: unet or"
    ):
        load(foreign)
    _safetensors.write(foreign, net.params, {"architecture": "unet"}, dtype="float32")
    with pytest.raises(ValueError, match="foreign.safetensors: the weights hold the layers conv1,"):
        load(foreign)
    odd = {"architecture": "kpcn", "inputs": "variance"}
    _safetensors.write(foreign, net.params, odd, dtype="float32")
    with pytest.raises(ValueError, match="take 3 input channels; radiance with variance makes 6"):
        load(foreign)
    with pytest.raises(ValueError, match="exposure is 2.0, and .* is no OIDN network"):
        load(whole, exposure=2.0)
    with pytest.raises(ValueError, match="inputs is .*; only .tza files do not tell"):
        load(whole, inputs=("albedo",))
    with pytest.raises(ValueError, match="or a path that ends in .tza or .safetensors"):
        load("unet-none")


def test_weights_that_do_not_fit(tmp_path):
    net = tiny_kpcn()
    path = tmp_path / "w.safetensors"

    def changed(layer, **parts):
        return {**net.params, layer: {**net.params[layer], **parts}}

    with pytest.raises(ValueError, match="layer kernel has a kernel of shape .* takes 8 channels"):
        KPCN(changed("kernel", kernel=np.zeros((3, 3, 7, 25))))
    with pytest.raises(ValueError, match="the layer kernel predicts 24 logits per pixel"):
        KPCN(changed("kernel", kernel=np.zeros((3, 3, 8, 24))))
    with pytest.raises(ValueError, match="expected those of a KPCN: conv1, conv2, ... and kernel"):
        KPCN({"kernel": net.params["kernel"]})
    with pytest.raises(ValueError, match="inputs is 'depth', expected one of 'albedo'"):
        KPCN.init(jax.random.key(0), ("depth",))
    with pytest.raises(
        ValueError, match="size is 'huge', expected one of 'small', 'base', 'large'"
    ):
        UNet.init(jax.random.key(0), size="huge")
    with pytest.raises(ValueError, match="kernel_size is 4, expected an odd"):
        KPCN.init(jax.random.key(0), kernel_size=4)
    with pytest.raises(ValueError, match="conv1.bias are not all finite in float16"):
        pd.denoisers.save(path, KPCN(changed("conv1", bias=np.full(8, 1e6))))
    with pytest.raises(ValueError, match="a KPCN or a ResidualNet: OIDN's weights go to a .tza"):
        pd.denoisers.save(path, pd.denoisers.load("oidn-hdr-small"))  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="metadata has inputs, which the file itself tells"):
        pd.denoisers.save(path, net, metadata={"inputs": "albedo"})
    with pytest.raises(ValueError, match="w.pt, expected a name in .safetensors"):
        pd.denoisers.save(tmp_path / "w.pt", net)
    with pytest.raises(ValueError, match="dtype is 'bfloat16', expected one of"):
        pd.denoisers.save(path, net, dtype="bfloat16")
    assert not list(tmp_path.iterdir())
