"""Which file becomes which, settled before any work is done."""

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from progden_jax.cli._run import Failure, UsageError


@dataclass(frozen=True)
class Item:
    """One file to be denoised, and what goes with it."""

    input: Path
    output: Path
    variance_from: tuple[Path, ...] = ()
    halves: tuple[Path, ...] = ()
    reference: Path | None = None


def plan(
    inputs: Sequence[Path],
    output: Path,
    *,
    folder: bool = False,
    variance_from: Sequence[Path] = (),
    halves: Sequence[Path] = (),
    reference: Path | None = None,
    force: bool = False,
    resume: bool = False,
) -> list[Item]:
    """What is to be read and written; the folders for it are made.

    Parameters
    ----------
    inputs : files, and folders that stand for the .exr files in and below them.
    output : a file for one file, else a folder, whose files keep the names of the inputs.
    folder : whether `output` is to be a folder whatever it is called.
    variance_from, halves, reference : files, or folders that hold files named like the inputs.
    force : outputs may exist, and will be replaced.
    resume : inputs whose outputs exist are left out.

    Raises
    ------
    UsageError
        If inputs and output do not go together.
    Failure
        If an output exists, or its folder cannot be written.
    """
    if not inputs:
        raise UsageError(
            "IN is missing: name the files or folders to denoise (before flags that take several values)."
        )
    several = len(inputs) > 1 or inputs[0].is_dir()
    folder = folder or several or output.is_dir()
    if several and output.is_file():
        raise UsageError(f"-o {output} is a file: for several inputs it must be a folder.")
    if not folder and output.suffix.lower() != ".exr":
        raise UsageError(
            f"-o {output} does not end in .exr, the only format written; "
            "end it with a slash if it is to be a folder."
        )
    named = list(_named(inputs, skip=output))
    if not named:
        raise Failure(f"{', '.join(map(str, inputs))}: no .exr files in there.")
    single = len(named) == 1
    items = [
        Item(
            path,
            output / name if folder else output,
            tuple(_companion(other, name, "--variance-from", single) for other in variance_from),
            tuple(_companion(other, name, "--halves", single) for other in halves),
            reference if reference is None else _companion(reference, name, "--reference", True),
        )
        for path, name in named
    ]
    _check(items, force or resume)
    if resume:
        items = [item for item in items if not os.path.lexists(item.output)]
    _make_folders(items, output if folder else None)
    return items


def _named(inputs: Iterable[Path], *, skip: Path) -> Iterable[tuple[Path, Path]]:
    """Each file with the name that its output gets below the output folder."""
    for path in inputs:
        if not path.is_dir():
            yield path, Path(path.name)
            continue
        for found in sorted(path.rglob("*")):
            hidden = any(part.startswith(".") for part in found.relative_to(path).parts)
            if found.suffix.lower() != ".exr" or not found.is_file() or hidden:
                continue
            # An output folder inside the input folder holds results of an earlier run.
            if skip.resolve() != path.resolve() and found.resolve().is_relative_to(skip.resolve()):
                continue
            yield found, found.relative_to(path)


def _companion(path: Path, name: Path, flag: str, file_allowed: bool) -> Path:
    if path.is_dir():
        return path / name
    if not file_allowed:
        raise UsageError(
            f"{flag} {path} is one file, but there are several inputs: give folders that hold "
            "a file of the same name for each, or run once per input."
        )
    return path


def _check(items: list[Item], force: bool) -> None:
    read = {
        p.resolve() for i in items for p in (i.input, *i.variance_from, *i.halves, i.reference) if p
    }
    written: dict[Path, Path] = {}
    for item in items:
        target = item.output.resolve()
        if target in read:
            raise UsageError(f"{item.output} would replace a file that is read: choose another -o.")
        if target in written:
            raise UsageError(
                f"{item.input} and {written[target]} would both become {item.output}: "
                "run once for each of them."
            )
        written[target] = item.input
    existing = [item.output for item in items if os.path.lexists(item.output)]
    if existing and not force:
        more = f" (and {len(existing) - 1} more)" if len(existing) > 1 else ""
        raise Failure(
            f"{existing[0]}{more} exists: pass --force to replace it, or --resume to leave it and do the "
            "rest. Nothing was done."
        )


def _make_folders(items: list[Item], output: Path | None) -> None:
    for folder in dict.fromkeys(item.output.parent for item in items):
        if output is not None:
            make_folder(folder)
        elif not folder.is_dir():
            raise Failure(f"{items[0].output} cannot be written: there is no folder {folder}.")
        if not os.access(folder, os.W_OK):
            raise Failure(f"{folder} cannot be written to: permission denied.")


def make_folder(folder: Path) -> None:
    """The folder with those above it, or a `Failure` that says what is in the way."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise Failure(f"{folder} cannot be made: {error.strerror}.") from None
