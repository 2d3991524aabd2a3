"""Pictures of a comparison: histogram and map of the distances, map of what was not reached."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.colors import LinearSegmentedColormap
from pyproj import CRS

from survey.compare.bands import draw_bands, has_bands
from survey.compare.canvas import INK, canvas, draw_cells, length_text, mean_per_cell, nice_limit, save, write_title

if TYPE_CHECKING:
    from survey.compare.result import Comparison

_BLUE, _RED = "#2f6f9f", "#c3140d"
_REACHED = LinearSegmentedColormap.from_list("reached", ["#c9d6df", "#f0a48c", _RED])
# Points that a cell should have on average: few where a hole is a hole, more where points lie at random.
_POINTS_PER_CELL, _SAMPLES_PER_CELL = 3.0, 6.0


def write_report(comparison: Comparison, folder: Path) -> list[Path]:
    """Write histogram.png, map.png, completeness.png and, where parts are known, bands.png into a folder that exists.

    Returns their paths.

    Raises
    ------
    UnwritableFile
        If one cannot be written; each is written whole or not at all.
    """
    numbers, crs = comparison.numbers, comparison.inputs.crs
    paths = [folder / name for name in ("histogram.png", "map.png", "completeness.png")]
    histogram(comparison.distances, paths[0], tolerance_m=numbers["tolerance_m"])
    error_map(comparison.points, comparison.distances, paths[1], crs=crs, subtitle=_in_short(numbers))
    is_visible = "completeness_visible" in numbers
    share = numbers["completeness_visible" if is_visible else "completeness"]
    completeness_map(
        comparison.targets,
        comparison.is_reached,
        paths[2],
        crs=crs,
        subtitle=f"{100.0 * share:.2f} % of {'the visible points' if is_visible else 'the reference'} "
        f"closer than {numbers['tolerance_m']:g} m",
    )
    if has_bands(numbers):
        paths.append(folder / "bands.png")
        draw_bands(numbers, paths[-1])
    return paths


def histogram(distances: np.ndarray, path: Path, *, tolerance_m: float | None = None) -> None:
    """Draw how often each distance occurs.

    Parameters
    ----------
    distances : (N,) [m]
        NaN is left out.
    path : Path
        PNG to write.
    tolerance_m : [m], optional
        Named in the text with the share within it.
    """
    d = distances[np.isfinite(distances)]
    limit = nice_limit(d)
    factor, unit = (1000.0, "mm") if limit < 0.5 else (1.0, "m")
    is_signed = bool((d < 0.0).any())
    figure, axes = canvas(7.2, 4.2)
    edges = np.linspace(-limit if is_signed else 0.0, limit, 121 if is_signed else 81)
    inner = np.quantile(np.abs(d), 0.9) if len(d) else math.nan
    axes.axvspan((-inner if is_signed else 0.0) * factor, inner * factor, color="#e8eef3", lw=0, label="inner 90 %")
    counts, _ = np.histogram(d, bins=edges)
    shares = 100.0 * counts / max(len(d), 1)
    axes.bar(edges[:-1] * factor, shares, width=np.diff(edges) * factor, align="edge", color=_BLUE, lw=0)
    axes.axvline(0.0, color=INK, lw=0.8)
    if len(d):
        axes.axvline(d.mean() * factor, color=_RED, lw=1.4, label=f"mean {length_text(d.mean())}")
        axes.axvline(np.median(d) * factor, color=_RED, lw=1.4, ls=":", label=f"median {length_text(np.median(d))}")
    axes.set_xlim(edges[0] * factor, edges[-1] * factor)
    axes.set_xlabel(f"distance to the reference{', above it positive' if is_signed else ''} [{unit}]")
    axes.set_ylabel("share of the points [%]")
    axes.legend(loc="upper left" if is_signed else "center right", frameon=False, fontsize=9)
    axes.text(
        0.985,
        0.97,
        _text_of(d, limit, tolerance_m),
        transform=axes.transAxes,
        ha="right",
        va="top",
        fontsize=9,
    )
    write_title(axes, "Distance of the cloud to the reference", "")
    save(figure, path)


def error_map(
    points: np.ndarray, distances: np.ndarray, path: Path, *, crs: CRS | None = None, subtitle: str = ""
) -> None:
    """Draw signed distances in plan view: mean per cell, red above and blue below the reference.

    Parameters
    ----------
    points : (N, 3), in crs
    distances : (N,) [m]
        Points with NaN are left out.
    path : Path
        PNG to write.
    crs : pyproj.CRS, optional
        For the names of the axes and, if geographic, their aspect.
    subtitle : str
    """
    known = np.isfinite(distances)
    points, d = points[known], distances[known]
    image, extent = mean_per_cell(points, d, _POINTS_PER_CELL)
    limit = nice_limit(d)
    factor, unit = (1000.0, "mm") if limit < 0.5 else (1.0, "m")
    is_signed = bool((d < 0.0).any())
    figure, axes = draw_cells(
        image * factor,
        extent,
        crs,
        colours="RdBu_r" if is_signed else "viridis",
        limits=(-limit * factor if is_signed else 0.0, limit * factor),
        label=f"{'above (+) or below (−)' if is_signed else 'distance to'} the reference [{unit}]",
        extend="both" if is_signed else "max",
    )
    write_title(axes, "Distance to the reference in plan view", subtitle)
    save(figure, path)


def completeness_map(
    targets: np.ndarray, is_reached: np.ndarray, path: Path, *, crs: CRS | None = None, subtitle: str = ""
) -> None:
    """Draw in plan view where the cloud does not reach the reference, in red.

    Parameters
    ----------
    targets : (M, 3), in crs
        Points of the reference.
    is_reached : (M,) bool
    path, crs, subtitle :
        As `error_map`.
    """
    image, extent = mean_per_cell(targets, 1.0 - is_reached, _SAMPLES_PER_CELL)
    figure, axes = draw_cells(
        100.0 * image, extent, crs, colours=_REACHED, limits=(0.0, 100.0), label="not reached [%]"
    )
    axes.set_facecolor("white")
    write_title(axes, "What the cloud does not reach", subtitle)
    save(figure, path)


def _in_short(numbers: dict) -> str:
    is_visible = "completeness_visible" in numbers
    share = numbers["completeness_visible" if is_visible else "completeness"]
    mean, std = (length_text(numbers[f"{name}_inner90_m"]) for name in ("mean", "std"))
    return (
        f"inner 90 %: mean {mean}, std {std}  ·  "
        f"{100.0 * share:.1f} % complete at {numbers['tolerance_m']:g} m{' (visible)' if is_visible else ''}"
    )


def _text_of(d: np.ndarray, limit: float, tolerance_m: float | None) -> str:
    if not len(d):
        return "no points"
    inner = d[np.abs(d) <= np.quantile(np.abs(d), 0.9)]
    lines = [
        f"{len(d):,} points".replace(",", " "),
        f"std {length_text(d.std())}",
        f"inner 90 %: {length_text(inner.mean())} ± {length_text(inner.std())}",
        f"beyond the axis {100.0 * np.mean(np.abs(d) > limit):.1f} %",
    ]
    if tolerance_m is not None:
        lines.append(f"closer than {tolerance_m:g} m {100.0 * np.mean(np.abs(d) < tolerance_m):.1f} %")
    return "\n".join(lines)
