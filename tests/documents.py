"""README and guides taken apart into code blocks, and these into what can be run."""

import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
DOCUMENTS = (ROOT / "README.md", *sorted((ROOT / "progden_jax" / "guides").glob("*.md")))


class Block(NamedTuple):
    """Code, its language, and the line that it begins on."""

    language: str
    text: str
    line: int


class Command(NamedTuple):
    """The words of a command, and the line that it is on."""

    words: list[str]
    line: int


def blocks(text: str) -> list[Block]:
    """The fenced code of a document."""
    found = re.finditer(r"^```(\w*)\n(.*?)^```$", text, flags=re.MULTILINE | re.DOTALL)
    return [Block(m[1], m[2], text.count("\n", 0, m.start(2)) + 1) for m in found]


def commands(block: Block) -> Iterator[Command]:
    """Every command of a shell block, comments left out."""
    for line, text in enumerate(block.text.splitlines(), block.line):
        words = shlex.split(text, comments=True)
        while words:
            end = words.index("&&") if "&&" in words else len(words)
            yield Command(words[:end], line)
            words = words[end + 1 :]
