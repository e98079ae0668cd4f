"""How a command ends: exit status, messages on stderr, results on stdout, never a traceback."""

import io
import json
import math
import os
import re
import sys
import traceback
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from cyclopts import CycloptsError

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress

_MISSING = re.compile(r'Command "\w+" parameter (\S+) requires an argument\.')

OK, FAILED, USAGE, INTERRUPTED = 0, 1, 2, 130


class UsageError(Exception):
    """The command line itself is wrong: exit status 2."""


class Failure(Exception):
    """The command line is right, but files or the machine stand in the way: exit status 1."""


def guarded(call: Callable[[], int | None], command: str) -> int:
    """The exit status of `call`, what it raises told in one line on stderr."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal without α must not stop us
    try:
        status = call() or OK
        sys.stdout.flush()
        return status
    except (CycloptsError, UsageError) as error:
        complain(_MISSING.sub(r"\1 is missing, or its value.", str(error)))
        complain(f"see `progden{command and ' '}{command} --help`")
        return USAGE
    except KeyboardInterrupt:
        complain("interrupted")
        return INTERRUPTED
    except BrokenPipeError:
        # The reader of our output has left; the interpreter's last flush must not complain.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return FAILED
    except Exception as error:
        complain(explain(error))
        return FAILED


def explain(error: Exception) -> str:
    """One line for people: what went wrong, and how to see more where that was not foreseen.

    Called while `error` is handled; with PROGDEN_DEBUG set the traceback goes to stderr too.
    """
    if os.environ.get("PROGDEN_DEBUG", "0") not in ("", "0"):
        traceback.print_exc()
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error):
        return "not enough memory for an image of this size"
    if isinstance(error, Failure | ValueError | OSError) and str(error):
        return str(error)
    text = " ".join(str(error).split())
    return (
        f"unexpected {type(error).__name__}: {text[:300]} "
        "(PROGDEN_DEBUG=1 or --debug shows where; please report it)"
    )


def complain(message: str) -> None:
    """A line on stderr."""
    print(f"progden: {message}", file=sys.stderr, flush=True)


def show(line: str, bars: "Progress") -> None:
    """A line on stdout; on one terminal the bars have to make room for it."""
    if bars.disable or not sys.stdout.isatty():
        print(line, flush=True)
    else:
        bars.console.print(line, markup=False, highlight=False, soft_wrap=True)


def tables() -> "Console":
    """Where tables are printed: stdout, wide enough for them where that is no terminal."""
    from rich.console import Console

    return Console() if sys.stdout.isatty() else Console(width=140)


def print_json(document: Any) -> None:
    """The document on stdout; numbers that JSON does not know become null."""
    print(json.dumps(_plain(document), indent=2, allow_nan=False))


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return os.fspath(value) if isinstance(value, os.PathLike) else value
