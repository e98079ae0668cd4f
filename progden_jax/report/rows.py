"""The rows of a run's results.sqlite."""

import json
import sqlite3
from pathlib import Path
from typing import Any, NamedTuple

DATABASE = "results.sqlite"


class Row(NamedTuple):
    """One result; None where there is no value."""

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
    render: str | None
    reference: str | None
    image: str | None
    created: str


def rows(run: Path) -> list[Row]:
    """All results of a run, in the order in which they were written.

    Raises
    ------
    ValueError
        If the folder holds no results, or the file is damaged.
    """
    path = run / DATABASE
    if not path.is_file():
        raise ValueError(
            f"{run} has no {DATABASE}: name a folder that `progden evaluate` or `progden sweep` wrote."
        )
    try:
        connection = sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)
        try:
            found = connection.execute(
                f"SELECT {', '.join(Row._fields)} FROM results ORDER BY rowid"
            ).fetchall()
        finally:
            connection.close()
    except sqlite3.DatabaseError as error:
        raise ValueError(f"{path} cannot be read as results: {error}.") from None
    settings = Row._fields.index("settings")
    return [Row(*values)._replace(settings=json.loads(values[settings])) for values in found]
