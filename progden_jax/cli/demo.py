"""`progden demo`: the main job on a small series that comes with the package."""

import contextlib
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from progden_jax.cli._paths import make_folder
from progden_jax.cli._run import Failure, tables

HELP = """Denoise the bundled series (8, 32, 128 samples per pixel) and compare with its reference.

Leaves the denoised EXRs and a picture, sheet.png, in a folder, and prints a table of errors.

```
progden demo
progden demo -o /tmp/demo --force
```
"""


def demo(
    *,
    output: Annotated[
        Path,
        Parameter(
            name=["--output", "-o"], help="The folder, made if missing [default: progden-demo]."
        ),
    ] = Path("progden-demo"),
    force: Annotated[bool, Parameter(help="Replace outputs that exist.")] = False,
) -> None:
    from rich.console import Console

    from progden_jax import demo as series
    from progden_jax import enable_compilation_cache, sheet
    from progden_jax.cli._compare import compare, score_table

    names = series.outputs()
    existing = [name for name in names if (output / name).exists()]
    if existing and not force:
        raise Failure(
            f"{output / existing[0]} exists: pass --force to replace it. Nothing was done."
        )
    make_folder(output)
    enable_compilation_cache()
    errors = Console(stderr=True)
    busy = errors.status("denoising the bundled series") if errors.is_terminal else None
    with busy or contextlib.nullcontext():
        reference = series.reference()
        steps = list(series.run(output))
        scores = {
            f"{s.spp} spp": compare(
                {"noisy": s.noisy, "denoised": s.denoised, "mixed": s.mixed}, reference
            )
            for s in steps
        }
        rows = [sheet.Row(f"{s.spp} spp", s.noisy, s.denoised, s.mixed, s.alpha) for s in steps]
        sheet.save_sheet(output / series.SHEET, rows, reference, title=series.TITLE)
    tables().print(score_table(scores, of="render"))
    print(f"Written to {output}: {', '.join(names)}")
