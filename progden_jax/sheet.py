"""A picture sheet: a row holds the render, its denoised version, their mix, the reference, α and errors."""

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float

from progden_jax import _files

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Image = Float[np.ndarray, "h w 3"]

INK, PAPER, FAINT = "#1c1c1e", "#ffffff", "#6e6e73"
DPI = 100
# Lengths in pixels; CELL is a picture's longer side, UNDER the room for its caption.
CELL, GAP, UNDER = 256, 10, 34
LEFT, RIGHT, TOP, BOTTOM, TITLE = 60, 24, 92, 76, 32


class Row(NamedTuple):
    """One row: a label, and images (H, W, 3), linear radiance; `alpha` in [0, 1]."""

    label: str
    noisy: Image
    denoised: Image
    mixed: Image
    alpha: Image


def save_sheet(
    path: str | os.PathLike[str], rows: Sequence[Row], reference: Image, *, title: str = ""
) -> None:
    """Write the sheet as a PNG, whole or not at all, replacing what is there.

    Raises
    ------
    ValueError
        If there is no row, or sizes differ.
    OSError
        If it cannot be written.
    """
    figure = draw_sheet(rows, reference, title=title)
    with _files.replacing(path) as beside:
        figure.savefig(beside, format="png", dpi=DPI)


def draw_sheet(rows: Sequence[Row], reference: Image, *, title: str = "") -> "Figure":
    """The sheet as a matplotlib figure that needs no display.

    Pictures share one exposure (see `exposure_for`), error maps one logarithmic scale over whole
    powers of ten of radiance. Under each picture is its RMSE, the row's least in bold.

    Parameters
    ----------
    rows : of the same view as `reference`, (H, W, 3) each.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.colors import LogNorm, Normalize
    from matplotlib.figure import Figure

    _check(rows, reference)
    grid = _Grid.of(len(rows), reference.shape)
    figure = Figure(figsize=(grid.width / DPI, grid.height / DPI), dpi=DPI, facecolor=PAPER)
    FigureCanvasAgg(figure)
    exposure = exposure_for(reference)
    errors = [
        [np.abs(image - reference).mean(-1) for image in (row.noisy, row.denoised, row.mixed)]
        for row in rows
    ]
    error_norm, alpha_norm = LogNorm(*_decades(errors)), Normalize(0, 1)
    for i, row in enumerate(rows):
        pictures = {"noisy": row.noisy, "denoised": row.denoised, "mixed": row.mixed}
        rmse = {name: _rmse(image, reference) for name, image in pictures.items()}
        for j, (name, image) in enumerate((pictures | {"reference": reference}).items()):
            ax = _picture(figure, grid, i, j, name, display(image, exposure))
            if name in rmse:
                _caption(ax, f"RMSE {rmse[name]:.4f}", bold=rmse[name] == min(rmse.values()))
        ax = _picture(figure, grid, i, 4, "α", row.alpha.mean(-1), cmap="cividis", norm=alpha_norm)
        _caption(ax, f"mean {row.alpha.mean():.2f}")
        for j, (name, error) in enumerate(zip(pictures, errors[i], strict=True)):
            shown = np.clip(error, error_norm.vmin, error_norm.vmax)
            ax = _picture(
                figure, grid, i, 5 + j, f"|error| {name}", shown, cmap="inferno", norm=error_norm
            )
            _caption(ax, f"mean {error.mean():.4f}")
        y = grid.top(i) + grid.cell[1] / 2
        _text(figure, grid, LEFT / 2, y, row.label, rotation=90, size=15, weight="bold")
    _scale(figure, grid, (4, 4), alpha_norm, "cividis", "weight of the denoised image")
    _scale(
        figure, grid, (5, 7), error_norm, "inferno", "absolute error in radiance, mean of R, G, B"
    )
    _text(figure, grid, LEFT, TITLE, title, ha="left", size=18, weight="bold")
    note = "All pictures at one exposure, all errors on one scale; the least RMSE of a row in bold."
    _text(figure, grid, LEFT, grid.top(grid.rows) + 14, note, ha="left", size=11, color=FAINT)
    return figure


def exposure_for(reference: Image) -> float:
    """The factor that brings the 90th percentile of an image's mean radiance to 0.7 (1 if it is black)."""
    bright = float(np.percentile(reference.mean(-1), 90))
    return 0.7 / bright if bright > 0 else 1.0


def display(radiance: Image, exposure: float) -> Image:
    """sRGB values in [0, 1] of linear radiance times `exposure`, clipped."""
    linear = np.clip(np.nan_to_num(radiance * exposure), 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


class _Grid(NamedTuple):
    """Where things lie, in pixels from the top left; `cell` is (width, height) of a picture."""

    rows: int
    cell: tuple[int, int]

    @classmethod
    def of(cls, rows: int, shape: tuple[int, ...]) -> "_Grid":
        height, width = shape[:2]
        scale = CELL / max(height, width)
        return cls(rows, (max(1, round(width * scale)), max(1, round(height * scale))))

    @property
    def width(self) -> int:
        return self.left(7) + self.cell[0] + RIGHT

    @property
    def height(self) -> int:
        return self.top(self.rows) + BOTTOM

    def left(self, column: int) -> int:
        # Wider gaps set the maps apart from the pictures, and α from the errors.
        return LEFT + column * (self.cell[0] + GAP) + 2 * GAP * ((column > 3) + (column > 4))

    def top(self, row: int) -> int:
        return TOP + row * (self.cell[1] + UNDER)


def _picture(
    figure: "Figure", grid: _Grid, row: int, column: int, head: str, values: Any, **colors: Any
) -> "Axes":
    ax = _axes(figure, grid, grid.left(column), grid.top(row), *grid.cell)
    ax.imshow(values, aspect="auto", interpolation="nearest", **colors)
    ax.set_axis_off()
    if row == 0:
        ax.set_title(head, fontsize=14, color=INK, pad=7)
    return ax


def _caption(ax: "Axes", text: str, *, bold: bool = False) -> None:
    ax.annotate(
        text,
        (0.5, 0),
        xytext=(0, -4),
        xycoords="axes fraction",
        textcoords="offset points",
        ha="center",
        va="top",
        fontsize=11,
        color=INK if bold else FAINT,
        weight="bold" if bold else "normal",
    )


def _scale(
    figure: "Figure", grid: _Grid, columns: tuple[int, int], norm: Any, cmap: str, label: str
) -> None:
    from matplotlib.cm import ScalarMappable

    left, right = grid.left(columns[0]), grid.left(columns[1]) + grid.cell[0]
    ax = _axes(figure, grid, left, grid.top(grid.rows) + 8, right - left, 12)
    bar = figure.colorbar(ScalarMappable(norm, cmap), cax=ax, orientation="horizontal")
    bar.outline.set_visible(False)  # pyright: ignore[reportCallIssue]
    bar.ax.tick_params(labelsize=10, colors=FAINT, length=3)
    if norm.vmax == 1 and norm.vmin == 0:
        bar.set_ticks([0, 0.5, 1], labels=["0", "0.5", "1"])
    bar.set_label(label, fontsize=11, color=FAINT)


def _axes(figure: "Figure", grid: _Grid, left: float, top: float, w: float, h: float) -> "Axes":
    bottom = grid.height - top - h
    return figure.add_axes(
        (left / grid.width, bottom / grid.height, w / grid.width, h / grid.height)
    )


def _text(figure: "Figure", grid: _Grid, x: float, y: float, text: str, **style: Any) -> None:
    style = {"ha": "center", "va": "center", "color": INK} | style
    figure.text(x / grid.width, 1 - y / grid.height, text, **style)


def _decades(errors: list[list[np.ndarray]]) -> tuple[float, float]:
    """Whole powers of ten around the middle 90 % of the errors, at least one and at most four apart."""
    values = np.concatenate([e.ravel() for row in errors for e in row])
    values = values[np.isfinite(values) & (values > 0)]
    if not values.size:
        return 1e-3, 1.0
    low, high = np.percentile(np.log10(values), (5, 99))
    top = int(np.ceil(high))
    bottom = min(max(int(np.floor(low)), top - 4), top - 1)
    return 10.0**bottom, 10.0**top


def _rmse(image: Image, reference: Image) -> float:
    return float(np.sqrt(np.mean((image - reference) ** 2, dtype=np.float64)))


def _check(rows: Sequence[Row], reference: Image) -> None:
    if not rows:
        raise ValueError("rows is empty: a sheet needs at least one.")
    for row in rows:
        for name in ("noisy", "denoised", "mixed", "alpha"):
            shape = getattr(row, name).shape
            if shape != reference.shape:
                raise ValueError(
                    f"{name} of row {row.label!r} has shape {shape}, the reference {reference.shape}: "
                    "a sheet shows one view."
                )
