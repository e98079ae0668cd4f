"""The one file that results are kept in: a SQLite table, a row per method, scene and samples per pixel."""

import fcntl
import json
import os
import sqlite3
from collections.abc import Iterable
from contextlib import closing, suppress
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

FILE = "results.sqlite"
IMAGES = "images"

_VERSION = 2
"""Of the table, kept as SQLite's user_version. What version 1 lacks is added before a file is written."""

_ADDED = {
    "risk": "REAL",
    "sure_error": "REAL",
    "alpha": "REAL",
    "memory": "INTEGER",
    "crop": "INTEGER",
}
"""Columns that version 1 has not, and their types."""

_SCHEMA = f"""
CREATE TABLE results(
    key TEXT PRIMARY KEY,
    scene TEXT NOT NULL,
    spp INTEGER NOT NULL,
    method TEXT NOT NULL,
    settings TEXT NOT NULL,
    rmse REAL, smape REAL, relmse REAL, flip REAL, ssim REAL,
    mse REAL, sure REAL, denoised_mse REAL,
    seconds REAL,
    render TEXT, reference TEXT, image TEXT,
    created TEXT NOT NULL,
    {", ".join(f"{name} {kind}" for name, kind in _ADDED.items())},
    UNIQUE(method, scene, spp)
)
"""


class Row(NamedTuple):
    """How far one method is from the reference on one render.

    Attributes
    ----------
    key : sha256 in hex of all that determines the row.
    scene, spp : of the render, as its file is named.
    method : a label for people, one per distinct settings in a run.
    settings : by flat dotted names, such as "bound.c"; those that matter to this method.
    rmse, smape, relmse, flip, ssim : see `progden_jax.metrics`.
    mse : mean squared error against the truth: the reference's own variance is subtracted, where its file
        has one. It may come out negative where the method is as good as the reference.
    sure : mean of the risk estimate of the denoised image; None where there is none.
    denoised_mse : what `sure` estimates, measured as `mse` is.
    seconds : that the images took, without reading and comparing; None where a program was compiled
        meanwhile, or nothing was computed.
    render, reference : absolute paths.
    image : path relative to the run's folder; None where it was not kept.
    created : ISO 8601, UTC.
    risk : the estimate of `mse` without the reference: the mean variance of the render, SURE of the denoised
        image, and of a mix SURE with α held constant or, by the setting risk_probes, of the whole chain.
    sure_error : standard error of `sure`, from the spread between pixels.
    alpha : mean weight of the denoised image, after the bound; None where nothing is mixed.
    memory : bytes that the process, or the device, grew by at most meanwhile, less than was taken where what
        was freed before was at hand; None where `seconds` is, and where the system does not tell.
    crop : side in pixels of the centre square that this is of; None: the whole image.
    """

    key: str
    scene: str
    spp: int
    method: str
    settings: dict[str, Any]
    rmse: float | None
    smape: float | None
    relmse: float | None
    flip: float | None
    ssim: float | None
    mse: float | None
    sure: float | None
    denoised_mse: float | None
    seconds: float | None
    render: str
    reference: str
    image: str | None
    created: str
    risk: float | None = None
    sure_error: float | None = None
    alpha: float | None = None
    memory: int | None = None
    crop: int | None = None


def rows(run: str | os.PathLike[str]) -> list[Row]:
    """All results of a run, by scene and samples per pixel, the methods in the order they came.

    Raises
    ------
    ValueError
        If the folder holds no results, or a file that is none of this version.
    """
    path = Path(run) / FILE
    if not path.is_file():
        raise ValueError(f"{run} holds no {FILE}: name a folder that `progden evaluate` wrote.")
    with closing(_open(path)) as connection:
        there = _columns(connection)
        names = [name for name in Row._fields if name in there]
        found = connection.execute(
            f"SELECT {', '.join(names)} FROM results ORDER BY scene, spp, rowid"
        ).fetchall()
    return [_row(dict(zip(names, values, strict=True))) for values in found]


class Database:
    """A run's results for writing, by one process at a time.

    Every call that writes is one transaction, on disk when it returns: a process that is killed leaves
    all that it had added, and the next one that opens the file clears away what it had begun.

    Parameters
    ----------
    run : folder, made if missing.

    Raises
    ------
    ValueError
        If the file there is none of this version, or another process writes it.
    """

    def __init__(self, run: str | os.PathLike[str]) -> None:
        self.run = Path(run)
        self.run.mkdir(parents=True, exist_ok=True)
        # Of the folder, for SQLite's own locks on the file would go with any other handle of it.
        self._lock = os.open(self.run, os.O_RDONLY | os.O_DIRECTORY)
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self._connection = _open(self.run / FILE, create=True)
        except BlockingIOError:
            os.close(self._lock)
            raise ValueError(
                f"{run} is being written by another process: wait for it, or name another folder."
            ) from None
        except BaseException:
            os.close(self._lock)
            raise
        self._remove_orphans()

    def known(self, *, with_images: bool = False) -> set[str]:
        """The keys of the rows that are there; or of those only whose image is, too."""
        found = self._connection.execute("SELECT key, image FROM results")
        return {
            key
            for key, image in found
            if not with_images or (image and (self.run / image).is_file())
        }

    def labels(self) -> dict[str, dict[str, Any]]:
        """Method -> its settings."""
        found = self._connection.execute("SELECT DISTINCT method, settings FROM results")
        return {method: json.loads(settings) for method, settings in found}

    def add(self, rows: Iterable[Row]) -> None:
        """Add rows; each replaces what there is of its method, scene and samples per pixel."""
        values = [r._replace(settings=json.dumps(r.settings)) for r in rows]  # pyright: ignore
        places = [(row.method, row.scene, row.spp) for row in values]
        names, marks = ", ".join(Row._fields), ", ".join("?" * len(Row._fields))
        replaced: list[str] = []
        with self._connection:
            for place in places:
                replaced += self._images_at(place)
            self._connection.executemany(
                f"INSERT OR REPLACE INTO results({names}) VALUES({marks})", values
            )
        kept = {row.image for row in values}
        for image in replaced:
            if image not in kept:
                (self.run / image).unlink(missing_ok=True)

    def close(self) -> None:
        """Let other processes write."""
        self._connection.close()
        os.close(self._lock)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _images_at(self, place: tuple[str, str, int]) -> list[str]:
        found = self._connection.execute(
            "SELECT image FROM results WHERE method = ? AND scene = ? AND spp = ? AND image NOT NULL",
            place,
        )
        return [image for (image,) in found]

    def _remove_orphans(self) -> None:
        """Images whose row was never written, for the process was killed in between."""
        folder = self.run / IMAGES
        kept = {
            image
            for (image,) in self._connection.execute(
                "SELECT image FROM results WHERE image NOT NULL"
            )
        }
        for path in folder.glob("*.exr") if folder.is_dir() else ():
            if f"{IMAGES}/{path.name}" not in kept:
                path.unlink(missing_ok=True)


def _open(path: Path, *, create: bool = False) -> sqlite3.Connection:
    mode = "rwc" if create else "rw"
    connection = None
    try:
        connection = sqlite3.connect(
            f"{path.absolute().as_uri()}?mode={mode}", uri=True, timeout=30
        )
        (version,) = connection.execute("PRAGMA user_version").fetchone()
        (tables,) = connection.execute("SELECT count(*) FROM sqlite_master").fetchone()
        if create and version == 0 and tables == 0:
            # Both or none, for a process may be killed between them.
            connection.executescript(f"BEGIN; {_SCHEMA}; PRAGMA user_version = {_VERSION}; COMMIT;")
            version = _VERSION
        elif create and version == 1:
            _upgrade(connection)
            version = _VERSION
    except sqlite3.Error as error:
        if connection is not None:
            connection.close()
        raise ValueError(f"{path} cannot be used as a database of results: {error}.") from None
    if version not in (1, _VERSION):
        with suppress(sqlite3.Error):
            connection.close()
        raise ValueError(
            f"{path} is no database of results of this version (its user_version is {version}, expected "
            f"{_VERSION}): name another folder."
        )
    return connection


def _upgrade(connection: sqlite3.Connection) -> None:
    """Add what version 1 has not, all or nothing; what was measured before is not known then."""
    missing = [name for name in _ADDED if name not in _columns(connection)]
    added = "".join(f"ALTER TABLE results ADD COLUMN {n} {_ADDED[n]}; " for n in missing)
    connection.executescript(f"BEGIN; {added}PRAGMA user_version = {_VERSION}; COMMIT;")


def _columns(connection: sqlite3.Connection) -> set[str]:
    return {name for _, name, *_ in connection.execute("PRAGMA table_info(results)")}


def _row(values: dict[str, Any]) -> Row:
    row = Row(**values)
    return row._replace(settings=json.loads(str(row.settings)))
