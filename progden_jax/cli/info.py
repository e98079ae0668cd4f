"""`progden info`: what a file holds and what would be used as what."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from progden_jax.cli._options import ReadOptions
from progden_jax.cli._run import FAILED, OK, UsageError, complain, explain, print_json, tables

if TYPE_CHECKING:
    from rich.console import Console

    from progden_jax.exr import ExrInfo, PartInfo, RoleInfo

HELP = """Show what EXR files hold, what `denoise` would use as what, and bad values.

Takes the flags with which `denoise` reads, so that they can be tried out.

```
progden info room.exr
progden info cycles.exr --channels "albedo=DiffCol" --json
```
"""


def info(
    *inputs: Annotated[Path, Parameter(name="IN", help="EXR files.")],
    read: ReadOptions | None = None,
    json: Annotated[bool, Parameter(help="Print it as one JSON list, an object per file.")] = False,
) -> int:
    if not inputs:
        raise UsageError("IN is missing: name the files to describe.")
    read = read or ReadOptions()
    read.check()
    from progden_jax.exr import describe_exr

    found, failed = [], 0
    console = tables()
    for path in inputs:
        try:
            described = describe_exr(path, **read.settings())
        except (ValueError, OSError) as error:
            complain(explain(error))
            found.append({"path": str(path), "error": explain(error)})
            failed += 1
            continue
        found.append(asdict(described))
        if not json:
            _show(described, console)
    if json:
        print_json(found)
    return FAILED if failed else OK


def _show(described: "ExrInfo", console: "Console") -> None:
    from rich.markup import escape
    from rich.table import Table

    console.print(f"[bold]{escape(described.path)}[/]", highlight=False, soft_wrap=True)
    for part in described.parts:
        _show_part(part, console, several=len(described.parts) > 1)
    roles = Table("role", "from", box=None, padding=(0, 2, 0, 2), header_style="dim")
    for name, role in described.roles.items():
        if name == "variance":
            roles.add_row(name, escape(described.variance))
        else:
            roles.add_row(name, _source(role))
    spp = "unknown" if described.spp is None else f"{described.spp:g}, by {described.spp_from}"
    roles.add_row("spp", spp)
    console.print(roles, highlight=False)
    for kind, texts in (("warning", described.warnings), ("note", described.notes)):
        for text in texts:
            console.print(f"  {kind}: {text}", markup=False, highlight=False, soft_wrap=True)
    console.print()


def _source(role: "RoleInfo") -> str:
    from rich.markup import escape

    if not role.channels:
        return (
            f"[dim]none: {escape(role.reason)}[/]"
            if not role.problem
            else f"[red]{escape(role.reason)}[/]"
        )
    names = escape(", ".join(role.channels))
    where = f" of {escape(role.file)}" if role.file else ""
    return names + where


def _show_part(part: "PartInfo", console: "Console", *, several: bool) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.markup import escape
    from rich.table import Table

    height, width = part.size
    title = f"part {part.index}{f' {part.name}' if part.name else ''}: " if several else ""
    window = ""
    if part.data_window != part.display_window:
        window = f", data window {part.data_window} of display window {part.display_window}"
    console.print(
        f"  {title}{width}×{height} (width × height), {part.type}, {part.compression}{window}",
        markup=False,
        highlight=False,
    )
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    table.add_column("channel", overflow="fold")
    table.add_column("type")
    for title in ("NaN", "Inf", "neg.", "min", "median", "mean", "max"):
        table.add_column(title, justify="right", no_wrap=True)
    for channel in part.channels:
        sampling = "" if channel.sampling == (1, 1) else " {}:{}".format(*channel.sampling)
        cells = ["–"] * 7
        if (values := channel.values) is not None:
            counts = (values.nan, values.inf, values.negative)
            bad = [str(n) if n else "·" for n in counts]
            bad[:2] = [n if n == "·" else f"[red]{n}[/]" for n in bad[:2]]
            ranges = (values.minimum, values.median, values.mean, values.maximum)
            cells = bad + ["–" if v is None else f"{v:.3g}" for v in ranges]
        table.add_row(escape(channel.name), channel.dtype + sampling, *cells)
    console.print(table)
