"""Which files belong to which scene, and which scenes are kept out of training."""

import hashlib
import os
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from progden_jax import subaverages

_NAME = re.compile(r"(?P<scene>.+)_(?P<spp>\d+)spp$")


class Item(NamedTuple):
    """One noisy render and the reference that it is to be compared with."""

    scene: str
    spp: int
    path: Path
    reference: Path


def index(
    folders: Iterable[str | os.PathLike[str]],
    *,
    spp: Sequence[int] = (),
    reference_spp: int = 0,
) -> list[Item]:
    """The renders in folders of NAME_SSSSSSspp.exr, subfolders included, sorted by scene and spp.

    A scene is named by its path below the folder, so that scenes of one name in two subfolders are two.

    Parameters
    ----------
    folders : at least one. The authors' published data set has this form.
    spp : samples per pixel to take; none: all.
    reference_spp : samples per pixel of the references; 0: the highest of each scene.

    Raises
    ------
    ValueError
        If a folder is missing, or there is no scene with a reference and a render besides.
    """
    folders = [Path(folder) for folder in folders]
    if not folders:
        raise ValueError("no data: name at least one folder of NAME_SSSSSSspp.exr files.")
    series: dict[str, dict[int, Path]] = {}
    for folder in folders:
        if not folder.is_dir():
            raise ValueError(f"{folder} is no folder; expected one of NAME_SSSSSSspp.exr files.")
        for path in sorted(folder.rglob("*.exr")):
            if found := _NAME.fullmatch(path.stem):
                scene = (path.parent.relative_to(folder) / found["scene"]).as_posix()
                files = series.setdefault(scene, {})
                if files.setdefault(int(found["spp"]), path) != path:
                    raise ValueError(
                        f"{files[int(found['spp'])]} and {path} are both {scene} at {found['spp']} spp: "
                        "give folders without duplicates."
                    )
    items = []
    for scene, files in sorted(series.items()):
        best = reference_spp or max(files)
        if best in files:
            items += [
                Item(scene, n, path, files[best])
                for n, path in sorted(files.items())
                if n != best and (not spp or n in spp)
            ]
    if not items:
        listed = ", ".join(str(folder) for folder in folders)
        asked = f" at {', '.join(map(str, spp))} spp" if spp else ""
        wanted = f" of {reference_spp} spp" if reference_spp else ""
        raise ValueError(
            f"{listed}: no render{asked} named NAME_SSSSSSspp.exr with a reference{wanted} beside it."
        )
    return items


def earlier(item: Item, parts: int) -> dict[int, Path]:
    """The renders beside an item's, by samples per pixel, that divide its samples into so many parts.

    The series must be nested: each render with the samples of the one before.

    Raises
    ------
    ValueError
        If there are too few.
    """
    if parts == 1:
        return {}
    scene = item.path.stem.rpartition("_")[0]
    beside = {}
    for path in item.path.parent.glob("*.exr"):
        found = _NAME.fullmatch(path.stem)
        if found and found["scene"] == scene and path != item.reference:
            beside[int(found["spp"])] = path
    try:
        return {spp: beside[spp] for spp in subaverages.cuts(beside, item.spp, parts)}
    except ValueError as error:
        raise ValueError(f"{item.path}: {error}") from None


def split(
    items: Sequence[Item], *, share: float, scenes: Sequence[str] = ()
) -> tuple[list[Item], list[Item]]:
    """(to train on, held out): whole scenes, by name or by a hash of the name.

    By hash a scene stays on its side when others are added. The share is then kept only roughly, but at
    least one scene is on each side.

    Raises
    ------
    ValueError
        If a named scene is not there, or a side would be empty.
    """
    known = sorted({item.scene for item in items})
    if missing := sorted(set(scenes) - set(known)):
        raise ValueError(f"held_out_scenes names {', '.join(missing)}, not among the scenes found.")
    if len(known) < 2:
        raise ValueError(
            f"there is one scene, {known[0]}; at least two are needed, for one is held out."
        )
    ranks = {
        scene: int.from_bytes(hashlib.blake2b(scene.encode(), digest_size=8).digest()) / 2**64
        for scene in known
    }
    held = set(scenes) or {scene for scene in known if ranks[scene] < share}
    held = held or {min(known, key=ranks.__getitem__)}
    if len(held) == len(known):
        if scenes:
            raise ValueError("held_out_scenes names every scene, so none is left to train on.")
        held.discard(max(known, key=ranks.__getitem__))
    return (
        [item for item in items if item.scene not in held],
        [item for item in items if item.scene in held],
    )
