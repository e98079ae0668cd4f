"""Progress bars on stderr, where that is a terminal."""

import contextlib
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, Self

if TYPE_CHECKING:
    from rich.progress import Progress


def timed(unit: str = "", *, percent: bool = False, **options: Any) -> "Progress":
    """Bars with the time taken and left; their tasks have a field `name`, told beside.

    Parameters
    ----------
    unit : what is counted, told before the bar.
    percent : show a share instead of numbers.
    options : further ones of `rich.progress.Progress`.
    """
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TaskProgressColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    console = Console(stderr=True)
    options = {"transient": True, "redirect_stdout": False} | options
    return Progress(
        *([TextColumn(unit)] if unit else []),
        BarColumn(),
        TaskProgressColumn() if percent else MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[name]}", markup=False),
        TimeRemainingColumn(),
        console=console,
        disable=not console.is_terminal,
        **options,
    )


class Shown:
    """A context in which `bars` are shown."""

    bars: "Progress"

    def __enter__(self) -> Self:
        self.bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.bars.stop()


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
