"""Map of where photographs look and no bed was found: too deep, turbid, glint, without texture, or moving."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.colors import to_rgba
from matplotlib.patches import Patch

from survey.compare.canvas import figure_of, map_canvas, save, show, write_title
from survey.display.palette import EMPTY, OBLIQUE, RED, WATER
from survey.display.quantities import share
from survey.report.facts import ReportFacts
from survey.report.raster import Picture
from survey.report.seen_cells import SeenCells, cells_of

# Views that a point of the bed needs.
_VIEWS = 2
# Code of a cell, its colour and what it is; 0 is what no view sees.
_FOUND, _NOT_FOUND, _ONE_VIEW = 1, 2, 3
_LEGEND = {
    _FOUND: (WATER, "has points"),
    _NOT_FOUND: (RED, "two or more views, no bed found"),
    _ONE_VIEW: (OBLIQUE, "one view only"),
}
# Of a map, along its longer side.
_PIXELS = 900


def draw_unseen(path: Path, facts: ReportFacts) -> Picture:
    """Ground with points, and without, by the number of views that look at it."""
    survey = facts.survey
    cells = cells_of(survey, facts.bed.xyz, facts.plan.gsd_m) if facts.cells is None else facts.cells
    codes = codes_of(cells)
    seen = np.isin(codes, (_FOUND, _NOT_FOUND)) & (cells.num_views >= _VIEWS)
    missing = float(np.mean(codes[seen] == _NOT_FOUND)) if seen.any() else 0.0
    corners = cells.middles[:: max(cells.height.shape[0] - 1, 1), :: max(cells.height.shape[1] - 1, 1)]
    low, high = (limit(survey.frame.crs_from_local(corners.reshape(-1, 3)), axis=0)[:2] for limit in (np.min, np.max))
    extent = (float(low[0]), float(high[0]), float(low[1]), float(high[1]))
    figure, axes = map_canvas(extent, survey.frame.crs, below_in=0.3)
    show(axes, _image(cells, codes, facts, extent), extent)
    figure.legend(
        handles=[Patch(color=_LEGEND[code][0], label=_LEGEND[code][1]) for code in _LEGEND if (codes == code).any()],
        loc="lower center", ncols=3, frameon=False, fontsize=8,
    )  # fmt: skip
    title = "Where no bed was found"
    write_title(axes, title, f"{share(missing)} of the ground that two or more views see")
    save(figure_of(axes), path)
    reasons = "no texture, shadow" if survey.water is None else "water that is too deep or turbid, glint, no texture"
    words = (
        f"Ground without a point: {reasons}, or things that moved. Nothing is filled in there. What one view alone "
        "sees cannot be measured."
    )
    return Picture(path, title, words)


def codes_of(cells: SeenCells) -> np.ndarray:
    """What each cell (rows, columns) is: a key of the legend, or 0."""
    without = np.where(cells.num_views >= _VIEWS, _NOT_FOUND, np.where(cells.num_views == 1, _ONE_VIEW, 0))
    return np.where(cells.has_point, _FOUND, without)


def _image(
    cells: SeenCells, codes: np.ndarray, facts: ReportFacts, extent: tuple[float, float, float, float]
) -> np.ndarray:
    """Colours (rows, columns, 4) of an extent in crs, its first row in the north."""
    west, east, south, north = extent
    sides = np.array(cells.height.shape)
    rows, columns = np.clip(sides, 1, _PIXELS).tolist()
    x, y = np.meshgrid(np.linspace(west, east, columns), np.linspace(north, south, rows))
    height = np.full(x.shape, float(facts.survey.frame.origin[2]))
    local = facts.survey.frame.local_from_crs(np.stack([x, y, height], axis=-1))
    colours = np.array([to_rgba(EMPTY), *(to_rgba(colour) for colour, _ in _LEGEND.values())])
    return colours[codes[cells.index(local)]]
