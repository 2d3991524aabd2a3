"""Bias and spread by depth, by incidence and by number of views, as a picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from evaluation import Band
from survey.compare.canvas import save
from survey.compare.figures import Parts
from survey.compare.text import limits_label
from survey.display.palette import BLUE, INK, RED, SOFT
from survey.display.quantities import LengthUnit, count

# Bands of fewer points say nothing: only their number is shown. Those of a smaller share of the points than this may
# reach beyond the axis, so that the others can be distinguished.
_FEWEST, _SHOWN_WHOLE = 20, 0.001


def has_bands(parts: Parts) -> bool:
    """Whether there is anything to draw."""
    return bool(_panels(parts))


def _panels(parts: Parts) -> list[tuple[tuple[Band, ...], str, str]]:
    """Bands, label of their axis and unit of their limits, from the attributes of the points."""
    depth = () if parts.depth is None else parts.depth.bands
    panels = [(depth, "depth below the water [m]", "m"), (parts.incidence, "incidence [°]", "deg"),
              (parts.views, "views that agree", "views")]  # fmt: skip
    return [panel for panel in panels if panel[0]]


def draw_bands(parts: Parts, path: Path) -> None:
    """Mean with its interval of confidence, and one standard deviation to both sides, in each band.

    Parameters
    ----------
    parts : Parts
        Of a comparison.
    path : Path
        PNG to write.

    Raises
    ------
    UnwritableFile
        If it cannot be written.
    """
    panels = _panels(parts)
    figure = Figure(figsize=(11.0, 3.6), layout="constrained")
    FigureCanvasAgg(figure)
    widths = [len(bands) + 2 for bands, _, _ in panels]
    row = figure.subplots(1, len(panels), sharey=True, squeeze=False, width_ratios=widths)[0]
    low, high = _limits([bands for bands, _, _ in panels])
    length_unit = LengthUnit.of([low, high])
    for axes, (bands, label, unit) in zip(row, panels, strict=True):
        _panel(axes, bands, unit, length_unit.per_metre)
        axes.set_xlabel(label, color=INK)
    row[0].set_ylabel(f"distance to the reference [{length_unit.name}]", color=INK)
    row[0].set_ylim(low * length_unit.per_metre, high * length_unit.per_metre)
    handles, labels = row[0].get_legend_handles_labels()
    figure.legend(handles, labels, frameon=False, fontsize=8.5, loc="outside lower center", ncols=3)
    save(figure, path)


def _limits(panels: list[tuple[Band, ...]]) -> tuple[float, float]:
    """Ends [m] of the axis of distances, which holds zero and the bands with a fair share of the points."""
    ends = [0.0]
    for bands in panels:
        enough = max(_FEWEST, _SHOWN_WHOLE * sum(band.distances.n_points for band in bands))
        shown = [band.distances for band in bands if band.distances.n_points >= enough]
        ends += [d.mean_m + sign * d.std_m for d in shown for sign in (-1.0, 1.0)]
    margin = 0.1 * max(max(ends) - min(ends), 0.001)
    return min(ends) - margin, max(ends) + margin


def _panel(axes: Axes, bands: tuple[Band, ...], unit: str, per_metre: float) -> None:
    distances = [band.distances for band in bands]
    at = np.array([i for i, d in enumerate(distances) if d.n_points >= _FEWEST], dtype=int)
    mean, std = per_metre * np.array([(distances[i].mean_m, distances[i].std_m) for i in at]).reshape(-1, 2).T
    axes.bar(at, 2.0 * std, bottom=mean - std, width=0.62, color=BLUE, alpha=0.25, lw=0,
             label="mean ± standard deviation")  # fmt: skip
    intervals = {i: distances[i].mean_ci95_m or (np.nan, np.nan) for i in at}
    known = [i for i, interval in intervals.items() if np.isfinite(interval).all()]
    if known:
        ends = per_metre * np.array([intervals[i] for i in known])
        axes.vlines(known, ends[:, 0], ends[:, 1], color=RED, lw=2.2, label="95 % confidence of the mean")
    axes.plot(at, mean, "o", ms=4.5, color=RED, label="mean")
    axes.axhline(0.0, color=INK, lw=0.8)
    axes.set_xticks(range(len(bands)), [_tick(limits_label(band.low, band.high, unit)) for band in bands])
    axes.set_xlim(-0.7, len(bands) - 0.3)
    axes.tick_params(colors=SOFT, labelsize=8.5)
    for x, band in enumerate(bands):
        axes.text(x, 1.0, count(band.distances.n_points), transform=axes.get_xaxis_transform(),
                  ha="center", va="bottom", color=SOFT, fontsize=7, rotation=30 if len(bands) > 6 else 0)  # fmt: skip
    axes.spines[["right", "top"]].set_visible(False)


def _tick(label: str) -> str:
    """The label of a band without its unit, which the axis names."""
    # The longest first: " and more" holds " m".
    for word, short in ((" and more", "+"), (" views", ""), (" to ", "–"), (" m", ""), ("°", "")):
        label = label.replace(word, short)
    return label
