"""Bias and spread in a picture: by depth, by incidence at the water, by the number of views."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from survey.compare.canvas import save
from survey.compare.text import band_label
from survey.palette import BLUE, INK, RED, SOFT
from survey.quantities import LengthUnit, count

_PANELS = (("depth_bands", "depth below the water [m]", "m"), ("incidence_bands", "incidence [°]", "deg"),
           ("views_bands", "views that agree", "views"))  # fmt: skip
# Bands of fewer points say nothing: only their number is shown. Those of a smaller share of the points than this may
# reach beyond the axis, so that the others can be told apart.
_FEWEST, _SHOWN_WHOLE = 20, 0.001


def has_bands(numbers: dict) -> bool:
    """Whether there is anything to draw."""
    return any(numbers.get(key) for key, _, _ in _PANELS)


def draw_bands(numbers: dict, path: Path) -> None:
    """Mean with its interval of confidence, and one standard deviation to both sides, in each band.

    Parameters
    ----------
    numbers : dict
        Of a comparison, see `survey.compare.comparison.compare_files`.
    path : Path
        PNG to write.

    Raises
    ------
    UnwritableFile
        If it cannot be written.
    """
    panels = [panel for panel in _PANELS if numbers.get(panel[0])]
    figure = Figure(figsize=(11.0, 3.6), layout="constrained")
    FigureCanvasAgg(figure)
    widths = [len(numbers[key]) + 2 for key, _, _ in panels]
    row = figure.subplots(1, len(panels), sharey=True, squeeze=False, width_ratios=widths)[0]
    low, high = _limits([numbers[key] for key, _, _ in panels])
    length_unit = LengthUnit.of([low, high])
    for axes, (key, label, unit) in zip(row, panels, strict=True):
        _panel(axes, numbers[key], unit, length_unit.per_metre)
        axes.set_xlabel(label, color=INK)
    row[0].set_ylabel(f"distance to the reference [{length_unit.name}]", color=INK)
    row[0].set_ylim(low * length_unit.per_metre, high * length_unit.per_metre)
    handles, labels = row[0].get_legend_handles_labels()
    figure.legend(handles, labels, frameon=False, fontsize=8.5, loc="outside lower center", ncols=3)
    save(figure, path)


def _limits(panels: list[list[dict]]) -> tuple[float, float]:
    """Ends [m] of the axis of distances, which holds zero and the bands with a fair share of the points."""
    ends = [0.0]
    for bands in panels:
        enough = max(_FEWEST, _SHOWN_WHOLE * sum(band["n_points"] for band in bands))
        shown = [band for band in bands if band["n_points"] >= enough]
        ends += [band["mean_m"] + sign * band["std_m"] for band in shown for sign in (-1.0, 1.0)]
    margin = 0.1 * max(max(ends) - min(ends), 0.001)
    return min(ends) - margin, max(ends) + margin


def _panel(axes: Axes, bands: list[dict], unit: str, per_metre: float) -> None:
    at = np.array([i for i, band in enumerate(bands) if band["n_points"] >= _FEWEST], dtype=int)
    mean, std = (per_metre * np.array([bands[i][key] for i in at], dtype=float) for key in ("mean_m", "std_m"))
    axes.bar(at, 2.0 * std, bottom=mean - std, width=0.62, color=BLUE, alpha=0.25, lw=0,
             label="mean ± standard deviation")  # fmt: skip
    known = [i for i in at if None not in (bands[i].get("mean_ci95_m") or [None])]
    if known:
        ends = per_metre * np.array([bands[i]["mean_ci95_m"] for i in known])
        axes.vlines(known, ends[:, 0], ends[:, 1], color=RED, lw=2.2, label="95 % confidence of the mean")
    axes.plot(at, mean, "o", ms=4.5, color=RED, label="mean")
    axes.axhline(0.0, color=INK, lw=0.8)
    labels = [band_label(band, unit).replace(" views", "").replace(" m", "").replace("°", "") for band in bands]
    axes.set_xticks(range(len(bands)), [text.replace(" to ", "–").replace(" and more", "+") for text in labels])
    axes.set_xlim(-0.7, len(bands) - 0.3)
    axes.tick_params(colors=SOFT, labelsize=8.5)
    for x, band in enumerate(bands):
        axes.text(x, 1.0, count(band["n_points"]), transform=axes.get_xaxis_transform(),
                  ha="center", va="bottom", color=SOFT, fontsize=7, rotation=30 if len(bands) > 6 else 0)  # fmt: skip
    axes.spines[["right", "top"]].set_visible(False)
