"""What the experiments share: the data, the machine they ran on, tables."""

import argparse
import csv
import os
import platform
from collections.abc import Iterable, Iterator, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.figure import Figure

import progden_jax as pd
from progden_jax._files import replacing

VALID = Path(__file__).resolve().parents[2] / "shared" / "data" / "valid"
TRAIN = VALID.with_name("train")
SPP = (2, 8, 32, 128, 512)
REFERENCE_SPP = 4096


def parser(description: str | None) -> argparse.ArgumentParser:
    """A command line with --data and --scenes; modules add their own."""
    made = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    made.add_argument("--data", type=Path, default=VALID, help="folder of NAME_SSSSSSspp.exr files")
    made.add_argument("--scenes", type=int, default=None, help="only this many scenes")
    return made


def scenes(folder: Path, most: int | None = None) -> list[str]:
    """Names of the scenes in a folder of NAME_SSSSSSspp.exr files that have a reference."""
    found = sorted(
        p.name[: -len("_000000spp.exr")] for p in folder.glob(f"*_{REFERENCE_SPP:06}spp.exr")
    )
    if not found:
        raise SystemExit(f"{folder} holds no NAME_{REFERENCE_SPP:06}spp.exr: give --data FOLDER.")
    return found[:most]


def begin(arguments: argparse.Namespace, about: str = "") -> list[str]:
    """Print where this runs and on what; the names of the scenes."""
    pd.enable_compilation_cache()
    print(machine())
    names = scenes(arguments.data, arguments.scenes)
    print(f"{len(names)} scenes of {arguments.data}{about and ', '}{about}\n")
    return names


def series(
    folder: Path, names: Iterable[str], spp: Sequence[int] = SPP
) -> Iterator[tuple[str, int, pd.Frame, pd.Frame]]:
    """(scene, spp, frame, reference) for every file of the named scenes that is there."""
    for name in names:
        reference = pd.read_exr(folder / f"{name}_{REFERENCE_SPP:06}spp.exr")
        for count in spp:
            path = folder / f"{name}_{count:06}spp.exr"
            if path.exists():
                yield name, count, pd.read_exr(path), reference


def machine() -> str:
    """One line on where this runs."""
    cpu = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        names = {
            x.split(":", 1)[1].strip()
            for x in cpuinfo.read_text().splitlines()
            if "model name" in x
        }
        cpu = ", ".join(sorted(names)) or cpu
    devices = ", ".join(sorted({d.device_kind for d in jax.devices()}))
    packages = " ".join(f"{name} {version(name)}" for name in ("jax", "jaxlib", "progden_jax"))
    return (
        f"{cpu}, {os.cpu_count()} cores, JAX devices: {devices}; "
        f"Python {platform.python_version()}, {packages}"
    )


def markdown(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A Markdown table."""
    lines = ["| " + " | ".join(header) + " |", "|" + " --- |" * len(header)]
    for row in rows:
        cells = [f"{cell:.4g}" if isinstance(cell, float) else str(cell) for cell in row]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def read_csv(path: Path) -> list[dict[str, str]]:
    """The rows; none where there is no file."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def write_csv(path: Path, header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """All rows, whole or not at all."""
    with replacing(path) as temporary, temporary.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows(rows)


def rms(values: Any) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.square(np.asarray(values, np.float64)).mean()))


def write_text(path: Path, text: str) -> None:
    """Whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_text(text)


def save_figure(path: Path, figure: Figure, **options: Any) -> None:
    """As a PNG, whole or not at all."""
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=110, **options)
