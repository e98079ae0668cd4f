"""`progden render`: series of renders with variances and references, by Mitsuba."""

import os
import re
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from progden_jax.cli._paths import make_folder
from progden_jax.cli._progress import Shown, timed
from progden_jax.cli._run import FAILED, OK, Failure, UsageError, complain, explain, show

if TYPE_CHECKING:
    from progden_jax.rendering.files import Job

HELP = """Render series of growing samples per pixel, with variances and an independent reference.

Needs Mitsuba 3: `pip install 'progden_jax[render]'`. Renders procedural scenes, or Mitsuba's XML scenes
with their own sensors and integrators. OUTPUT/NAME_SSSSSSspp.exr are nested (each has the samples of the one
before) and hold colour, the variance of the pixel mean, albedo, normal and depth. The same command goes on
where it was stopped.

```
progden render -o renders/ --scenes 50
progden render -o renders/ --kind studio --seed 7 --size 1280x720 --spp 4,16,64 --reference-spp 1024
progden render kitchen.xml -o renders/ -D resx=640 -D resy=360
```
"""


@Parameter(name="*", group="Procedural scenes")
@dataclass(frozen=True)
class SceneOptions:
    """What is drawn, where no XML scene is named."""

    scenes: Annotated[
        int | None, Parameter(help="How many, of seeds counting up [default: 1].")
    ] = None
    kind: Annotated[
        Literal["room", "outdoor", "studio"] | None,
        Parameter(help="Of scene; by default each seed chooses."),
    ] = None


@Parameter(name="*", group="XML scenes")
@dataclass(frozen=True)
class XmlOptions:
    """How the user's scenes are loaded."""

    define: Annotated[
        tuple[str, ...],
        Parameter(name=["--define", "-D"], help="name=value, for $name in the scene; may be repeated."),
    ] = ()  # fmt: skip
    sensor: Annotated[int, Parameter(help="Which of its sensors, from 0 [default: 0].")] = 0

    def parameters(self) -> dict[str, str]:
        found = {}
        for text in self.define:
            name, equals, value = text.partition("=")
            if not (equals and name):
                raise UsageError(f"-D {text!r}: expected name=value.")
            found[name] = value
        return found


@Parameter(name="*", group="Samples")
@dataclass(frozen=True)
class SampleOptions:
    """How the scenes are sampled."""

    spp: Annotated[
        str, Parameter(help="Samples per pixel of the series [default: 2,8,32,128,512].")
    ] = "2,8,32,128,512"
    reference_spp: Annotated[
        int,
        Parameter(
            help="Of the reference, which has other random numbers; 0: none [default: 4096]."
        ),
    ] = 4096
    seed: Annotated[
        int, Parameter(help="Of random numbers, and of the first procedural scene [default: 0].")
    ] = 0
    size: Annotated[
        str | None,
        Parameter(
            help="WIDTHxHEIGHT, or one number for a square [default: 128, or as the XML says]."
        ),
    ] = None
    max_depth: Annotated[
        int | None,
        Parameter(
            help="Longest path in segments [default: 9]; for an XML scene: take a path tracer "
            "instead of its own integrator."
        ),
    ] = None
    variant: Annotated[
        str | None,
        Parameter(
            help="Of Mitsuba [default: llvm_ad_rgb where a libLLVM is found, else scalar_rgb]."
        ),
    ] = None

    def counts(self) -> tuple[int, ...]:
        """Of the series."""
        from progden_jax.rendering.series import checked_spp

        if not re.fullmatch(r"\s*\d+(\s*,\s*\d+)*\s*", self.spp):
            raise UsageError(f"--spp is {self.spp!r}, expected numbers with commas: 2,8,32.")
        try:
            counts = checked_spp([int(n) for n in self.spp.split(",")])
        except ValueError as error:
            raise UsageError(f"--{error}") from None
        if self.reference_spp in counts:
            raise UsageError(
                f"--reference-spp {self.reference_spp} is among --spp {self.spp}: their files would have "
                "one name."
            )
        if self.reference_spp < 0 or self.reference_spp == 1:
            raise UsageError(f"--reference-spp is {self.reference_spp}, expected 0 or 2 and more.")
        return counts

    def resolution(self) -> tuple[int, int] | None:
        """Height and width, None where each scene has its own."""
        if self.size is None:
            return None
        found = re.fullmatch(r"([1-9]\d*)(?:[x×]([1-9]\d*))?", self.size)
        if not found:
            raise UsageError(f"--size is {self.size!r}, expected WIDTHxHEIGHT or one number.")
        return int(found[2] or found[1]), int(found[1])


def render(
    *inputs: Annotated[
        Path, Parameter(name="SCENE", help="Mitsuba scenes (.xml); none: procedural ones.")
    ],
    output: Annotated[
        Path,
        Parameter(name=["--output", "-o"], help="The folder for the files, made if missing."),
    ],
    scene: SceneOptions | None = None,
    xml: XmlOptions | None = None,
    sample: SampleOptions | None = None,
    force: Annotated[bool, Parameter(help="Render and replace files that exist.")] = False,
    preview: Annotated[
        bool, Parameter(help="Write NAME.png too, the picture of most samples.")
    ] = False,
) -> int:
    scene, xml, sample = scene or SceneOptions(), xml or XmlOptions(), sample or SampleOptions()
    jobs = _jobs(inputs, scene, xml, sample)
    make_folder(output)
    left = [job.paths_left(output, force=force) for job in jobs]
    failed = 0
    with _Bar(sum(left)) as bar:
        for job, paths in zip(jobs, left, strict=True):
            begin = time.monotonic()
            try:
                written = bar.run(job, output, force=force)
                if preview:
                    _save_preview(job, output)
            except KeyboardInterrupt:
                complain(f"stopped in {job.name}; the same command goes on")
                raise
            except (ValueError, OSError) as error:
                complain(f"{job.name}: {explain(error)}")
                failed += 1
                continue
            took = f"{time.monotonic() - begin:.1f} s for {paths} samples per pixel"
            said = f"{len(written)} files, {took}" if written else "nothing was left to do"
            show(f"{job.name}: {said}", bar.bars)
    if failed and len(jobs) > 1:
        complain(f"{failed} of {len(jobs)} scenes failed")
    return FAILED if failed else OK


def _jobs(
    inputs: tuple[Path, ...], scene: SceneOptions, xml: XmlOptions, sample: SampleOptions
) -> "list[Job]":
    """One for each scene, nothing rendered yet."""
    for flag, value, least in (
        ("--seed", sample.seed, 0),
        ("--max-depth", sample.max_depth, 1),
        ("--scenes", scene.scenes, 1),
    ):
        if value is not None and value < least:
            raise UsageError(f"{flag} is {value}, expected a whole number from {least} up.")
    if inputs and scene != SceneOptions():
        raise UsageError("--scenes and --kind are for procedural scenes, but a SCENE is named.")
    if not inputs and xml != XmlOptions():
        raise UsageError("--sensor and -D are for XML scenes: name one.")
    # The GPU's memory is for Mitsuba.
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    parameters, size, counts = xml.parameters(), sample.resolution(), sample.counts()

    from progden_jax.rendering import files, use_variant

    try:
        mi = use_variant(sample.variant)
    except ModuleNotFoundError as error:
        raise Failure(str(error)) from None
    except ValueError as error:
        raise UsageError(f"--{error}") from None
    mi.set_log_level(mi.LogLevel.Error)
    sampled = files.Sampling(counts, sample.reference_spp, size, sample.max_depth)
    if not inputs:
        seeds = range(sample.seed, sample.seed + (scene.scenes or 1))
        return [files.procedural(seed, scene.kind, sampled) for seed in seeds]
    jobs = [files.of_xml(path, parameters, xml.sensor, sample.seed, sampled) for path in inputs]
    names = [job.name for job in jobs]
    if len(set(names)) < len(names):
        raise UsageError("two SCENEs have one name: render them into folders of their own.")
    return jobs


def _save_preview(job: "Job", folder: Path) -> None:
    from matplotlib.image import imsave

    from progden_jax import sheet
    from progden_jax._files import replacing
    from progden_jax.exr import read_exr

    color = read_exr(job.path(folder, max(job.counts))).color.__array__()
    with replacing(folder / f"{job.name}.png") as beside:
        imsave(beside, sheet.display(color, sheet.exposure_for(color)))


class _Bar(Shown):
    """Samples per pixel that are taken and the time left, on stderr if that is a terminal."""

    def __init__(self, total: int) -> None:
        self.bars = timed(percent=True, speed_estimate_period=120)
        self._task = self.bars.add_task("", total=total, name="")

    def run(self, job: "Job", folder: Path, *, force: bool) -> list[Path]:
        """Render the job, its progress on the bar."""
        from progden_jax.rendering import files

        self.bars.update(self._task, name=job.name)

        def advance(paths: int) -> None:
            self.bars.update(self._task, advance=paths)

        return files.render(job, folder, force=force, progress=advance)
