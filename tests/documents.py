"""README and guides taken apart, and run: `python documents.py DOCUMENT...` in an empty folder.

There are in.exr and truth.exr, and renders/, a series of two numbers of samples and its reference: a corner
of the demo. Python blocks share a namespace. A block whose first line is a comment with a file's name,
`# mine.py`, is written there; one that begins with `# needs: pip install '.[EXTRA]'` runs where it is.
One that begins with `# takes minutes` is not run: what it takes from modules must exist.
"""

import ast
import contextlib
import importlib.metadata
import io
import re
import shlex
import sys
import traceback
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).parents[1]
DOCUMENTS = (ROOT / "README.md", *sorted((ROOT / "progden_jax" / "guides").glob("*.md")))

QUICK = {"info", "devices"}
"""Commands that compile nothing."""


class Block(NamedTuple):
    """Code, its language, and the line that it begins on."""

    language: str
    text: str
    line: int


def blocks(text: str) -> list[Block]:
    """The fenced code of a document."""
    found = re.finditer(r"^```(\w*)\n(.*?)^```$", text, flags=re.MULTILINE | re.DOTALL)
    return [Block(m[1], m[2], text.count("\n", 0, m.start(2)) + 1) for m in found]


def commands(shell: str) -> Iterator[list[str]]:
    """The words of every command, comments left out."""
    for line in shell.replace("\\\n", " ").splitlines():
        words = shlex.split(line, comments=True)
        while words:
            end = words.index("&&") if "&&" in words else len(words)
            yield words[:end]
            words = words[end + 1 :]


def is_quick(command: list[str]) -> bool:
    """Whether to run it: on files that are there, by no network that must be compiled."""
    if command[0] != "progden":
        return False
    if "--dry-run" in command or any("=mine.py:" in word for word in command):
        return True
    named = [word for word in command[2:] if word.endswith(".exr")]
    return command[1] in QUICK and all(Path(name).exists() for name in named)


def installed(extra: str) -> bool:
    """Whether what the extra asks for is there."""
    needed = importlib.metadata.requires("progden_jax") or []
    names = [
        re.match(r"[\w.-]+", r) for r in needed if f"extra == '{extra}'" in r.replace('"', "'")
    ]
    try:
        for name in names:
            importlib.metadata.version(name[0] if name else "")
    except importlib.metadata.PackageNotFoundError:
        return False
    return True


def prepare(folder: Path) -> None:
    """Write the renders that documents speak of."""
    import numpy as np

    import progden_jax as pd
    from progden_jax import demo

    corner = np.s_[70:86, 40:56]
    (folder / "renders").mkdir()
    for path in sorted(demo.FOLDER.glob("*.exr")):
        frame = pd.read_exr(path)
        layers = {
            name.capitalize(): np.asarray(buffer)[corner]
            for name in ("variance", "albedo", "normal")
            if (buffer := getattr(frame, name)) is not None
        }
        spp = path.stem[-9:]
        names = {"000008spp": ["in.exr"], "004096spp": ["truth.exr"], "000128spp": None}
        if (further := names.get(spp, [])) is not None:
            for name in (f"renders/room_{spp}.exr", *further):
                pd.write_exr(folder / name, np.asarray(frame.color)[corner], layers=layers)


def check_names(tree: ast.Module, namespace: dict[str, Any]) -> None:
    """Import what the code imports, and look up what it takes from modules, without running it."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            exec(compile(ast.Module([node], []), "imports", "exec"), namespace)
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            found = namespace.get(node.value.id)
            if isinstance(found, types.ModuleType):
                getattr(found, node.attr)


def run(document: Path) -> None:
    """Everything in it that can run, in order, in the working folder; raises what a block raises."""
    from progden_jax import cli

    namespace = {"__name__": document.stem}
    for block in blocks(document.read_text(encoding="utf-8")):
        if named := re.match(r"# ([\w-]+\.\w+)\n", block.text):
            Path(named[1]).write_text(block.text, encoding="utf-8")
        if block.language == "python":
            # Errors show the document's own lines.
            code = compile("\n" * (block.line - 1) + block.text, document, "exec")
            needs = re.match(r"# needs: pip install '\.\[(\w+)\]'\n", block.text)
            if block.text.startswith("# takes minutes\n"):
                check_names(ast.parse(block.text), namespace)
            elif needs is None or installed(needs[1]):
                exec(code, namespace)
        if block.language == "sh":
            for command in filter(is_quick, commands(block.text)):
                if status := cli.main(command[1:]):
                    raise RuntimeError(f"{shlex.join(command)} ended with {status}")


def main() -> int:
    """Run the documents named, each in a folder of its own; what fails goes to stderr."""
    failed = 0
    for document in map(Path, sys.argv[1:]):
        folder = Path(document.stem).resolve()
        folder.mkdir()
        prepare(folder)
        said = io.StringIO()
        with contextlib.chdir(folder), contextlib.redirect_stdout(said):
            try:
                run(document)
            except Exception:
                failed += 1
                print(f"{document}:\n{said.getvalue()}\n{traceback.format_exc()}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
