"""README and guides: their code runs, their commands, flags, files and names exist."""

import importlib.util
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

import document_runs
import pytest
from cyclopts import App, CycloptsError
from documents import DOCUMENTS, ROOT, blocks, commands

import progden_jax as pd
from progden_jax.cli import app
from progden_jax.training import CombinerConfig, DenoiserConfig, MixerConfig, config

EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
TRAINING = {"combiner": CombinerConfig, "mixer": MixerConfig, "denoiser": DenoiserConfig}

each = pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.stem)


def prose(document: Path) -> str:
    """The text without its code blocks."""
    return re.sub(r"^```.*?^```$", "", document.read_text(), flags=re.MULTILINE | re.DOTALL)


def subcommands(command: App) -> Iterator[App]:
    """A command's own commands, and theirs."""
    for name in command:
        if not name.startswith("-"):
            yield command[name]
            yield from subcommands(command[name])


def flags_of(command: App) -> set[str]:
    """What may stand before values on its command line."""
    if command.default_command is None:
        return set()
    return {name for a in command.assemble_argument_collection() for name in a.names}


def helps() -> dict[str, str]:
    """The help texts of the commands that have a name."""
    return {name: app[name].help for name in app if not name.startswith("-")}


def check(command: list[str]) -> None:
    """What can be known of a command without running it."""
    match [word for word in command if not re.match("[A-Z_]+=", word)]:
        case ["progden", *arguments]:
            app.parse_args(arguments, exit_on_error=False, print_error=False)
        case ["pip", "install", "."]:
            pass
        case ["pip", "install", what]:
            for extra in re.fullmatch(r"(?:\.|progden_jax)\[([\w,]+)\]", what)[1].split(","):
                assert extra in EXTRAS
        case ["python", "-m", module, *_]:
            assert importlib.util.find_spec(module) is not None
        case ["pytest"]:
            assert EXTRAS["test"]
        case ["tensorboard", *_]:
            assert any("tensorboard" in package for package in EXTRAS["train"])
        case _:
            pytest.fail(f"nothing is known of the command {command}")


@each
def test_every_command_exists_with_its_flags(document):
    found = [b for b in blocks(document.read_text()) if b.language == "sh"]
    assert found
    for block in found:
        for command in commands(block):
            check(command.words)


@pytest.mark.parametrize("name", helps())
def test_examples_in_help_texts_exist_with_their_flags(name):
    for block in blocks(helps()[name]):
        if not block.language:
            for command in commands(block):
                check(command.words)


def test_a_flag_or_command_that_is_gone_would_be_noticed():
    for wrong in ("progden denoise in.exr -o out.exr --shiny", "progden polish in.exr"):
        with pytest.raises(CycloptsError, match="shiny|polish"):
            check(wrong.split())


@each
def test_no_code_escapes(document):
    text = document.read_text()
    assert len(re.findall("^```", text, flags=re.MULTILINE)) == 2 * len(blocks(text))
    assert {b.language for b in blocks(text)} <= {"python", "sh", "yaml", "toml"}
    assert not re.search(r"^ {4}\S", prose(document), flags=re.MULTILINE)


@each
def test_links_lead_to_files(document):
    links = re.findall(r"\]\((?!https?:)([^)#]+)(?:#[^)]*)?\)", document.read_text())
    assert links
    for link in links:
        assert (document.parent / link).exists(), link


@each
def test_names_in_the_text_exist(document):
    flags = {"--help", "--debug"}.union(*map(flags_of, subcommands(app)))
    for code in re.findall(r"(?<!`)`([^`\n]+)`(?!`)", prose(document)):
        if flag := re.match(r"--[\w-]+", code):
            assert flag[0] in flags, code
        if name := re.match(r"(?:pd|progden_jax)((?:\.\w+)+)(?!\S*/)", code):
            found = pd
            for part in name[1].split(".")[1:]:
                found = getattr(found, part)
        if command := re.match(r"progden ([a-z]\w*)", code):
            assert command[1] in app, code


@each
def test_named_configurations_load(document, tmp_path):
    written = blocks(document.read_text())
    kinds = re.findall(r"progden train (\w+) .*--config (\S+\.toml)", document.read_text())
    named = [b for b in written if b.language == "toml"]
    assert len(named) == len(kinds)
    for block, (kind, name) in zip(named, kinds, strict=True):
        assert block.text.startswith(f"# {name}\n")
        (tmp_path / name).write_text(block.text)
        config.load(TRAINING[kind], tmp_path / name)


@pytest.mark.documents
@pytest.mark.parametrize(
    "document", sorted(DOCUMENTS, key=lambda path: -path.stat().st_size), ids=lambda path: path.stem
)
def test_every_block_runs(document, tmp_path, tmp_path_factory, worker_id, monkeypatch):
    """In a lane of its own, see .ci/run, the longest first; it needs all extras but `bench`."""
    base = tmp_path_factory.getbasetemp()
    shared = base if worker_id == "master" else base.parent
    monkeypatch.setenv("PROGDEN_CACHE", str(shared / "programs"))
    document_runs.run(document, tmp_path / "clone")


def test_every_smaller_command_is_in_a_document():
    used = {
        document_runs.entry_of(command.words)
        for document in DOCUMENTS
        for block in blocks(document.read_text())
        if block.language == "sh"
        for command in commands(block)
    }
    assert used == {None, *document_runs.SMALLER}
