"""`progden sweep`: an ablation over any settings, on several processes or machines."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from progden_jax.cli._evaluation import PlanOptions, ResultOptions, carry_out, print_plan
from progden_jax.cli._run import OK, UsageError

if TYPE_CHECKING:
    from progden_jax.evaluation.dispatch import Workers

HELP = """Evaluate every combination of settings that CONFIG spans; results go to OUTPUT/results.sqlite.

CONFIG is YAML or TOML. `base` holds settings that all methods share, `grid` lists values whose every
combination is a method, `list` single methods; `data`, `spp` and `scenes` name the renders, `crop` takes
their centre, `keep_images` names samples per pixel whose pictures are kept. Paths in it are relative to it.
What is there already is not computed again.

```yaml
data: [renders]
base: {denoiser: oidn-hdr, bound.window: 11}
grid:
  estimator: [monte-carlo, probing]
  probes: [1, 4]
  bound.c: [3.0, 4.2]
list: [render, denoised, {mixer: runs/k4/weights.safetensors, label: trained with 4 probes}]
```

Settings: image (mix, denoised, render, oracle), denoiser (a name, a file, FILE.py:FUNCTION), precision,
adaptation (none, sure, post-correct) with adaptation.steps and the like and correction.window and the like,
estimator, probes, epsilon, seed, mixer, mixer.window and mixer.confidence (of closed-form), bound, bound.a,
bound.c, bound.window, bound.shift, bound.sigmoid, risk_probes (for SURE of the mix itself).

```
progden sweep smoke.yaml --dry-run
progden sweep smoke.yaml -o run/ && progden report run/ -o site/
progden sweep big.yaml -o run/ --address auto --num-gpus 1
```
"""


def sweep(
    config: Annotated[Path, Parameter(name="CONFIG", help="A file that ends in .yaml or .toml.")],
    *,
    output: Annotated[
        Path | None,
        Parameter(name=["--output", "-o"], help="Folder of this run, made if missing."),
    ] = None,
    data: Annotated[
        tuple[Path, ...],
        Parameter(consume_multiple=True, help="Folders of renders, instead of CONFIG's."),
    ] = (),
    workers: Annotated[
        int | None,
        Parameter(
            help="Processes at a time [default: on a CPU one per core, at most 4; else 1; on Ray all that "
            "there is room for]."
        ),
    ] = None,
    ray: Annotated[bool, Parameter(help="On Ray, on a cluster of this machine alone.")] = False,
    address: Annotated[
        str | None,
        Parameter(
            help="On the Ray cluster there, HOST:PORT, or auto for the one this machine is part of."
        ),
    ] = None,
    num_gpus: Annotated[
        float, Parameter(help="GPUs that each worker has for itself on Ray [default: 0].")
    ] = 0.0,
    dry_run: Annotated[
        bool, Parameter(help="Show the methods and the number of rows; compute nothing.")
    ] = False,
    plan: PlanOptions | None = None,
    results: ResultOptions | None = None,
) -> int:
    plan, results = plan or PlanOptions(), results or ResultOptions()
    results.check()
    if workers is not None and workers < 1:
        raise UsageError(f"--workers is {workers}, expected at least 1.")
    if num_gpus < 0:
        raise UsageError(f"--num-gpus is {num_gpus:g}, expected a number from 0 up.")
    on_ray = ray or address is not None
    if num_gpus and not on_ray:
        raise UsageError("--num-gpus is for Ray, which gives GPUs out: pass --ray or --address.")
    chosen = plan.load(config, data)
    if dry_run:
        print_plan(chosen, json=results.json)
        return OK
    if output is None:
        raise UsageError("--output is missing: name the folder of this run.")
    from progden_jax import enable_compilation_cache

    enable_compilation_cache()
    if on_ray or (workers or 1) > 1:
        import jax

        # This process only gives out work, and must not take a GPU's memory.
        jax.config.update("jax_platforms", "cpu")

    def start(jobs: int) -> "Workers":
        if on_ray:
            from progden_jax.evaluation.cluster import Cluster

            return Cluster(workers, jobs=jobs, address=address, gpus=num_gpus)
        from progden_jax.evaluation.dispatch import Here
        from progden_jax.evaluation.processes import Processes

        count = min(workers or _usual(), jobs)
        return Here() if count == 1 else Processes(count)

    return carry_out(chosen, output, results, start)


def _usual() -> int:
    import jax

    from progden_jax._devices import cores

    return min(len(cores()), 4) if jax.default_backend() == "cpu" else 1
