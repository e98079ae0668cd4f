"""Code blocks of a document run in order, in a folder like a clone of the project with renders in it.

The renders are corners of the demo under the names that documents use. Python blocks share a namespace. A
block whose first line is a comment with a file's name, `# mine.py`, is written there. Commands run in this
process, where they share compiled programs.
"""

import contextlib
import dataclasses
import importlib.metadata
import os
import re
import runpy
import shlex
import shutil
import sys
import tomllib
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import jax
import numpy as np
from documents import ROOT, Block, blocks, commands
from packaging.requirements import Requirement

import progden_jax as pd
from progden_jax import adaptation, cli, demo

SIZE = 16
"""Of all renders, in pixels: OIDN's network takes multiples of it."""

RENDERS = (
    ("renders", "room", (70, 40)),
    ("renders", "hall", (40, 70)),
    ("progden_jax/data/demo", "proc2004", (60, 40)),
    ("../shared/data/valid", "proc2000", (50, 40)),
)
"""Series there are: folder, name, and the pixel of the demo's scene that they begin at."""

KITCHEN = """<scene version="3.0.0">
    <default name="resx" value="16"/>
    <integrator type="path"/>
    <sensor type="perspective">
        <transform name="to_world"><lookat origin="0,1,4" target="0,0,0" up="0,1,0"/></transform>
        <film type="hdrfilm"><integer name="width" value="$resx"/><integer name="height" value="16"/></film>
    </sensor>
    <shape type="sphere"/>
    <emitter type="constant"/>
</scene>
"""


class Smaller(NamedTuple):
    """A command that would take long: its pattern, what is run instead, and what that leaves out."""

    pattern: str
    instead: str
    why: str


_TRAINING = r"\g<0> --set steps=2 --set batch=2 --set crop=16 --set held_out=0.5"

SMALLER = (
    Smaller(
        "progden train denoiser .*",
        rf"{_TRAINING} --set start= --set architecture=kpcn --set 'options={{layers = 2, width = 4}}'",
        "two steps of a network of two layers from random weights, on two crops",
    ),
    Smaller(
        "progden train combiner .*",
        f"""{_TRAINING} --set 'options={{layers = 2, width = 4, window = 5, inputs = ["albedo"]}}'""",
        "two steps of a network of two layers, on two crops",
    ),
    Smaller("progden train mixer .*", _TRAINING, "two steps on two crops"),
    Smaller(
        "(progden render .*)--scenes 50",
        rf"\1--scenes 2 --size {SIZE} --spp 2,8,32 --reference-spp 200 --variant scalar_rgb",
        "two scenes of few pixels and samples",
    ),
    Smaller(
        "(progden render .*)--scenes 50 (--spp .*)",
        rf"\1--scenes 2 --size {SIZE} \2 --reference-spp 200 --variant scalar_rgb",
        "two scenes of few pixels, and a reference of fewer samples",
    ),
    Smaller("(progden render kitchen.xml .*)resx=640(.*)", rf"\1resx={SIZE}\2", "few pixels"),
    Smaller(
        "progden sweep .* --address .*",
        r"\g<0> --set seed=1 --spp 8 --scenes room",
        "two rows per method that are not there yet",
    ),
    Smaller(
        "progden sweep (?!.*--dry-run).*",
        r"\g<0> --workers 1",
        "one worker, which is this process",
    ),
    Smaller(
        "progden denoise (?!.* --denoiser ).* (--method exact|--post-correct.*)",
        r"\g<0> --denoiser small.safetensors",
        "a network of two layers",
    ),
    Smaller(
        r"python -m experiments\.divergence\.cone",
        rf"\g<0> --size {SIZE} --denoiser oidn-hdr-small --chunk 1",
        "few pixels",
    ),
)
"""All commands that are not run as they stand, but for `pip` and `pytest`: see `execute`."""


class Part(NamedTuple):
    """What can be run of a block: the line it is on, its words, and itself."""

    line: int
    words: str
    run: Callable[[], object]


def smaller(words: list[str]) -> list[str]:
    """The command as it is run."""
    entry = entry_of(words)
    if entry is None:
        return words
    return shlex.split(re.sub(entry.pattern, entry.instead, shlex.join(words), count=1))


def entry_of(words: list[str]) -> Smaller | None:
    """What makes the command smaller, if anything does."""
    text = shlex.join(words)
    return next((entry for entry in SMALLER if re.fullmatch(entry.pattern, text)), None)


def run(document: Path, folder: Path) -> None:
    """Everything in it, in order; what fails is told with its place."""
    namespace: dict[str, Any] = {"__name__": document.stem}
    folder.mkdir()
    prepare(folder)
    with contextlib.chdir(folder), small_fits(), scripts_of(folder):
        for block in blocks(document.read_text(encoding="utf-8")):
            for part in parts(document, block, namespace):
                # Commands for one file are alternatives of each other.
                Path("out.exr").unlink(missing_ok=True)
                try:
                    part.run()
                except Exception as error:
                    raise AssertionError(
                        f"{document.relative_to(ROOT)}:{part.line}: {part.words}: {error}"
                    ) from error


def parts(document: Path, block: Block, namespace: dict[str, Any]) -> Iterator[Part]:
    """What can be run of a block."""
    if named := re.match(r"# ([\w-]+\.\w+)\n", block.text):
        Path(named[1]).write_text(block.text, encoding="utf-8")
    if block.language == "python":
        # Errors show the document's own lines.
        code = compile("\n" * (block.line - 1) + block.text, document, "exec")
        yield Part(block.line, "the Python block", lambda: exec(code, namespace))
    if block.language == "sh":
        for command in commands(block):
            words = smaller(command.words)
            yield Part(command.line, shlex.join(words), lambda words=words: execute(words))


def execute(words: list[str]) -> None:
    """Run a command; what stands for `pip install` and `pytest` is a look at this environment and .ci/run."""
    match words:
        case ["progden", *arguments]:
            with gpu_cluster() if "--address" in arguments else contextlib.nullcontext():
                status = cli.main(arguments)
            assert not status, f"exit status {status}"
        case ["python", "-m", module, *arguments]:
            with mock.patch.object(sys, "argv", [module, *arguments]):
                try:
                    runpy.run_module(module, run_name="__main__", alter_sys=True)
                except SystemExit as end:
                    if end.code:
                        raise AssertionError(f"exit status {end.code}") from None
        case ["pip", "install", what]:
            importlib.metadata.version("progden_jax")
            for extra in re.findall(r"\w+", what.partition("[")[2]):
                lacking = ", ".join(unsatisfied(extra))
                assert not lacking, f"this environment lacks {lacking}"
        case ["pytest"]:
            assert 'step "pytest" pytest\n' in (ROOT / ".ci" / "run").read_text()
        case _:
            raise AssertionError("nothing is known of such a command")


def unsatisfied(extra: str) -> Iterator[str]:
    """What the extra asks for and is not installed."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for requirement in map(Requirement, project["optional-dependencies"][extra]):
        if requirement.name == project["name"]:
            for other in requirement.extras:
                yield from unsatisfied(other)
            continue
        try:
            version = importlib.metadata.version(requirement.name)
        except importlib.metadata.PackageNotFoundError:
            yield str(requirement)
        else:
            if version not in requirement.specifier:
                yield f"{requirement} (it has {version})"


@contextlib.contextmanager
def gpu_cluster() -> Iterator[None]:
    """A Ray cluster that takes this machine for one with a GPU; `auto` finds it."""
    from ray.cluster_utils import Cluster

    resources = {"num_cpus": 1, "num_gpus": 1, "include_dashboard": False}
    with warnings.catch_warnings():
        # JAX warns of forks; Ray's are of other programs.
        warnings.filterwarnings("ignore", message=r"os\.fork\(\) was called")
        cluster = Cluster(initialize_head=True, head_node_args=resources)
    try:
        with mock.patch.dict(os.environ, RAY_ADDRESS=cluster.address):
            yield
    finally:
        cluster.shutdown()


@contextlib.contextmanager
def small_fits() -> Iterator[None]:
    """Two steps where minutes are spent on one render, by small networks."""
    with (
        defaults(adaptation.Adaptation, steps=2),
        defaults(adaptation.PostCorrection, epochs=2, window=5, layers=2, width=4),
        mock.patch.object(adaptation.correction, "_MIN_STEPS", 1),
        mock.patch.object(demo, "FOLDER", Path("progden_jax/data/demo").resolve()),
    ):
        yield


def defaults(kind: type, **values: object) -> Any:
    """A dataclass with other defaults."""
    init: Any = kind.__init__
    named = zip(dataclasses.fields(kind), init.__defaults__, strict=True)
    changed = tuple(values.get(field.name, default) for field, default in named)
    return mock.patch.object(init, "__defaults__", changed)


@contextlib.contextmanager
def scripts_of(folder: Path) -> Iterator[None]:
    """`experiments` are the folder's, which write into it."""

    def ours() -> list[str]:
        return [name for name in sys.modules if name.split(".")[0] == "experiments"]

    before = {name: sys.modules.pop(name) for name in ours()}
    with mock.patch.object(sys, "path", [str(folder), *sys.path]):
        yield
    for name in ours():
        del sys.modules[name]
    sys.modules.update(before)


def prepare(folder: Path) -> None:
    """Write the files that documents name and do not make."""
    for script in (ROOT / "experiments").rglob("*"):
        if script.suffix in (".py", ".yaml"):
            copy = folder / script.relative_to(ROOT)
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(script, copy)
    rendered = {path.stem[-9:]: pd.read_exr(path) for path in demo.FOLDER.glob("*.exr")}
    for series, name, begin in RENDERS:
        (folder / series).mkdir(parents=True, exist_ok=True)
        for spp, frame in rendered.items():
            pd.write_exr(folder / series / f"{name}_{spp}.exr", corner(frame, *begin))
    renders = folder / "renders"
    shutil.copyfile(renders / "room_004096spp.exr", folder / "truth.exr")
    frame = pd.read_exr(renders / "room_000008spp.exr")
    color, variance = np.asarray(frame.color), np.asarray(frame.variance)
    (folder / "frames").mkdir()
    for name in ("in.exr", "huge.exr", "frames/0001.exr", "frames/0002.exr"):
        pd.write_exr(folder / name, frame)
    noise = np.sqrt(variance) * np.random.default_rng(0).standard_normal(color.shape)
    for name, sign in (("a.exr", 1), ("b.exr", -1)):
        half = color + sign * noise.astype(np.float32)
        pd.write_exr(folder / name, pd.Frame(half, None, frame.albedo, frame.normal))
    pd.write_exr(folder / "pbrt.exr", color, layers={"Variance": 64 * variance})
    layers = {"Noisy Image": color, "DiffCol": frame.albedo}
    pd.write_exr(folder / "cycles.exr", np.zeros_like(color), layers=layers)
    (folder / "kitchen.xml").write_text(KITCHEN)
    network = pd.denoisers.KPCN.init(jax.random.key(0), layers=2, width=4)
    pd.denoisers.save(folder / "small.safetensors", network)


def corner(frame: pd.Frame, row: int, column: int) -> pd.Frame:
    """SIZE×SIZE pixels of a frame."""
    part = np.s_[row : row + SIZE, column : column + SIZE]
    names = ("color", "variance", "albedo", "normal", "depth")
    buffers = {name: getattr(frame, name) for name in names}
    cut = {name: None if b is None else np.asarray(b)[part] for name, b in buffers.items()}
    return pd.Frame(**cut, spp=frame.spp)
