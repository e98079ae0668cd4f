"""Progress bars on stderr, where that is a terminal."""

import contextlib
from collections.abc import Callable, Iterator


@contextlib.contextmanager
def counting(text: str) -> Iterator[Callable[[int, int], None]]:
    """A bar that vanishes at the end; yields what is to be called with (done, total)."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

    console = Console(stderr=True)
    columns = (TextColumn(text), BarColumn(), MofNCompleteColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as p:
        bar = p.add_task("", total=None)
        yield lambda done, total: p.update(bar, completed=done, total=total)
