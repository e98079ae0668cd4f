"""`progden evaluate`: how far methods are from references, kept in a database."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from progden_jax.cli._evaluation import PlanOptions, ResultOptions, carry_out, print_plan
from progden_jax.cli._run import OK, UsageError

HELP = """Compare methods with references on folders of renders; results go to OUTPUT/results.sqlite.

Folders hold NAME_SSSSSSspp.exr files; of each scene the most samples are the reference. What is there already
is not computed again, unless a file, a network or a setting changed: the same command goes on after an
interrupt. Without DATA and --config it shows and exports what OUTPUT holds.

Methods: render, denoised, mix, closed-form (these by default), unbounded (no t-bound), paper (four finite
differences), oracle (what mixing could gain); or what a configuration lists, as for `progden sweep`.

```
progden evaluate renders/ -o run/
progden evaluate renders/ -o run/ --methods denoised mix oracle --spp 8 32 --set denoiser=oidn-hdr
progden evaluate renders/ -o run/ --config methods.yaml --keep-images
progden evaluate -o run/ --export table.tex --export rows.csv --baseline denoised
```
"""


def evaluate(
    *data: Annotated[Path, Parameter(name="DATA", help="Folders of renders, subfolders included.")],
    output: Annotated[
        Path, Parameter(name=["--output", "-o"], help="Folder of this run, made if missing.")
    ],
    config: Annotated[
        Path | None, Parameter(help="Methods, and renders, from a file: .yaml or .toml.")
    ] = None,
    methods: Annotated[
        tuple[str, ...], Parameter(consume_multiple=True, help="By name, instead of the default.")
    ] = (),
    plan: PlanOptions | None = None,
    results: ResultOptions | None = None,
    dry_run: Annotated[
        bool, Parameter(help="Show the methods and the number of rows; compute nothing.")
    ] = False,
) -> int:
    plan, results = plan or PlanOptions(), results or ResultOptions()
    results.check()
    if not data and config is None:
        if methods or plan != PlanOptions() or dry_run:
            raise UsageError("DATA is missing: name folders of renders, or a --config that does.")
        results.show(output)
        return OK
    chosen = plan.load(config, data, methods)
    if dry_run:
        print_plan(chosen, json=results.json)
        return OK
    from progden_jax import enable_compilation_cache

    enable_compilation_cache()
    return carry_out(chosen, output, results)
