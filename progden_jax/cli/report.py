"""`progden report`: a run's results as a static page."""

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from progden_jax.cli._progress import counting
from progden_jax.cli._run import complain

HELP = """Make a page of a run's results: pictures, convergence plots, tables.

RUN is a folder that `progden evaluate` or `progden sweep` wrote. Open SITE/index.html in a browser: it needs
no network and no server. Pictures are compared side by side or flipped by number keys, with linked zoom, at
any exposure; `?` lists the keys.

```
progden report runs/table1 -o site/
progden report runs/ablation -o site/ --images none --title "t-bound ablation" --force
```
"""

_WARNINGS_TOLD = 10


def report(
    run: Annotated[Path, Parameter(name="RUN", help="The folder that holds results.sqlite.")],
    /,
    *,
    output: Annotated[
        Path, Parameter(name=["--output", "-o"], help="The folder of the page, made if missing.")
    ],
    title: Annotated[
        str | None, Parameter(help="Title of the page [default: the run folder's name].")
    ] = None,
    scenes: Annotated[
        tuple[str, ...],
        Parameter(consume_multiple=True, help="Only these scenes [default: all]."),
    ] = (),
    images: Annotated[
        Literal["auto", "none"],
        Parameter(help="auto: the pictures that the run kept; none: tables and plots alone."),
    ] = "auto",
    flip: Annotated[
        Literal["auto", "all", "none"],
        Parameter(help="FLIP maps: auto, of pictures of up to 512×512 pixels; all; none."),
    ] = "auto",
    force: Annotated[bool, Parameter(help="Replace a report that exists.")] = False,
) -> None:
    from progden_jax.report import build_report

    with counting("pictures of results") as progress:
        built = build_report(
            run,
            output,
            title=title,
            scenes=scenes,
            images=images == "auto",
            flip=flip,
            force=force,
            progress=progress,
        )
    for text in built.warnings[:_WARNINGS_TOLD]:
        complain(f"warning: {text}")
    if (more := len(built.warnings) - _WARNINGS_TOLD) > 0:
        complain(f"warning: and {more} more like these")
    print(f"{built.page}: {built.rows} results, {built.images} images")
