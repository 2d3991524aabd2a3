"""`change`: differences of two surveys, cut and fill with their uncertainty, written as JSON, GeoTIFF and picture.

With stable ground, the second survey is shifted by the mean difference there. Errors common to all cells then cancel;
they are replaced by the standard deviation of that mean. What varies of ``std_common``, by a tilt or with the depth,
remains: its variance less the smallest one of the survey, once at the cell and once on the stable ground (mean).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from shapely import Polygon

from evaluation.summary import MAD_TO_STD
from geo.features import assumed_crs, cells_inside, layer_of, read_polygons
from geo.files import existing_file
from geo.grid import Grid
from geo.raster import RasterBand, RasterForm, is_our_tiff, write_cog
from survey.change.differences import (
    CHANGED_STDS,
    Correlation,
    Differences,
    Volume,
    differences_of,
    measured_correlation,
    volume_of,
)
from survey.compare.options import ChangeOptions
from survey.display.quantities import MINUS, LengthUnit, length, share
from survey.errors import SurveyError
from survey.export.export import cloud_of
from survey.files.json_values import write_json
from survey.files.paths import ReadFiles, is_json, is_png, require_file
from survey.files.toml_table import require_options
from survey.progress import current

# Fewer cells than this do not determine a mean, nor reveal which of them changed.
FEWEST_CELLS = 30
_NODATA = -9999.0
_NOTABLE_SCATTER = 1.5


@dataclass(frozen=True)
class Alignment:
    """Shift of the second survey."""

    shift_m: float  # [m]: added to its heights
    std_m: float  # [m]: standard deviation of the shift
    area_m2: float  # [m²]: of the stable ground that counted
    left_out: int  # Cells of it whose difference lies beyond three robust standard deviations


def align(differences: Differences, stable: np.ndarray, correlation: Correlation) -> tuple[Differences, Alignment]:
    """The differences after the second survey was aligned to the first in height by stable cells, with the shift."""
    known = stable & differences.is_known
    if known.sum() < FEWEST_CELLS:
        raise ValueError(f"{int(known.sum())} cells of both surveys lie in it, expected at least {FEWEST_CELLS}")
    deviation = np.abs(differences.height - np.median(differences.height[known]))
    used = known & (deviation <= CHANGED_STDS * MAD_TO_STD * max(float(np.median(deviation[known])), 1e-12))
    # Where unchanged cells scatter more than they state, their mean does too.
    scatter = max(1.0, correlation.scatter or 1.0)
    own = replace(differences, std=scatter * differences.std, common=np.zeros_like(differences.common))
    total = volume_of(own, used, correlation)
    mean, std = total.volume_m3 / total.area_m2, total.std_m3 / total.area_m2
    # The part of common errors that varies over a survey.
    variances = [common**2 - np.nanmin(common[differences.is_known]) ** 2 for common in differences.common]
    first, second = (np.sqrt(np.maximum(v, 0.0) + max(float(v[used].mean()), 0.0)) for v in variances)
    varying = np.sqrt(np.maximum(first**2 + second**2 - 2.0 * differences.shared * first * second, 0.0))
    common = np.stack([np.hypot(varying, std), np.zeros(used.shape)])
    aligned = replace(differences, height=differences.height - mean, common=common, shared=0.0)
    return aligned, Alignment(-mean, std, total.area_m2, int(known.sum() - used.sum()))


@dataclass(frozen=True)
class Change:
    differences: Differences
    cells: Grid
    inside: np.ndarray  # (rows, columns) bool: cells that count
    net: Volume  # Of all of them: fill less cut
    # cut, fill: Of those beyond the level of detection; cut is below zero
    cut: Volume
    fill: Volume
    correlation: Correlation
    alignment: Alignment | None
    notes: tuple[str, ...]  # sentences


def change_between(first: str | Path, second: str | Path, options: ChangeOptions = ChangeOptions()) -> Change:
    """Compare two surveys, runs or clouds, and write what is asked for."""
    first, second = Path(first), Path(second)
    surveys = require_surveys((first, second), options)
    with current().stage("Reading"):
        (differences,), cells, notes = differences_of(surveys, options)
        inside = differences.is_known
        if options.area is not None:
            inside &= cells_inside(polygons_for(options.area, cells).values(), cells)
    require_cells(inside, options)
    (change,) = changes_in([inside], differences, cells, options)
    change = replace(change, notes=(*notes, *change.notes))
    if options.json_path is not None:
        write_json(options.json_path, numbers_of(change, first, second))
    if options.tif_path is not None:
        _write_raster(change, first, second, options.tif_path)
    if options.picture_path is not None:
        with current().stage("Picture"):
            _draw(change, options.picture_path)
    return change


def changes_in(
    areas: Sequence[np.ndarray], differences: Differences, cells: Grid, options: ChangeOptions
) -> list[Change]:
    """Changes in areas (rows, columns) bool of known cells; the correlation of errors is measured in the first."""
    notes, alignment = [], None
    if options.correlation_length_m is not None:
        correlation = Correlation(1.0, options.correlation_length_m)
    else:
        try:
            correlation = measured_correlation(differences, areas[0])
        except ValueError as error:
            raise SurveyError(
                f"how errors of cells are correlated cannot be measured ({error}); give --correlation-length METRES"
            ) from error
        if correlation.scatter is not None and correlation.scatter > _NOTABLE_SCATTER:
            notes.append(
                f"cells that did not change scatter {correlation.scatter:.1f} times as much as their standard "
                "deviations say: these are too small, or most of the bed has changed"
            )
    if options.stable is not None:
        stable = cells_inside(polygons_for(options.stable, cells).values(), cells)
        try:
            differences, alignment = align(differences, stable, correlation)
        except ValueError as error:
            message = f"--stable {options.stable}: {error}; draw larger polygons, or correct their CRS"
            raise SurveyError(message) from error
    changes = []
    for inside in areas:
        is_beyond = differences.is_significant & inside
        parts = (inside, is_beyond & (differences.height < 0.0), is_beyond & (differences.height > 0.0))
        net, cut, fill = (volume_of(differences, part, correlation) for part in parts)
        changes.append(Change(differences, cells, inside, net, cut, fill, correlation, alignment, tuple(notes)))
    return changes


def require_cells(inside: np.ndarray, options: ChangeOptions) -> None:
    """Raise SurveyError where no cell that all surveys cover lies in the polygons."""
    if not inside.any():
        raise SurveyError(f"no cell that both surveys cover lies in {options.area}; correct the polygon or its CRS")


def rows_of(change: Change) -> list[tuple[str, str]]:
    """Labels and texts of the result."""
    known, alignment, correlation = change.inside, change.alignment, change.correlation
    low, middle, high = np.quantile(change.differences.height[known], [0.0, 0.5, 1.0]).tolist()
    detection = float(np.median(change.differences.detection[known]))
    beyond = float(change.differences.is_significant[known].mean())
    source = "stated"
    if correlation.scatter is not None:
        source = f"measured; unchanged cells scatter {correlation.scatter:.2f} times as stated"
    rows = [
        ("area", f"{change.net.area_m2:.6g} m², {int(known.sum())} cells of {change.cells.side_m:g} m"),
        ("difference", f"median {length(middle)}, from {length(low)} to {length(high)}"),
        ("detection", f"{length(detection)} (median) at 95 %; {share(beyond)} of the cells are beyond"),
        ("fill", f"{volume_text(change.fill)}, of cells beyond detection"),
        ("cut", f"{volume_text(change.cut)}, of cells beyond detection"),
        ("net", f"{volume_text(change.net)}, of all cells"),
        (
            "errors",
            f"of cells correlated over {length(correlation.length_m)} (at short lags {correlation.share:.2f}), "
            f"{source}",
        ),
    ]
    if alignment is not None:
        text = (
            f"second survey shifted by {length(alignment.shift_m)} ± {length(alignment.std_m)} (one standard "
            f"deviation) on {alignment.area_m2:.4g} m² of stable ground"
        )
        if alignment.left_out:
            text += f"; without {alignment.left_out} cells beyond three robust standard deviations"
        rows.append(("alignment", text))
    return [*rows, *(("note", note) for note in change.notes)]


def numbers_of(change: Change, first: Path, second: Path) -> dict:
    """The result as ``--json`` holds it."""
    known, differences = change.inside, change.differences
    keys = ("volume_m3", "std_m3", "interval95_m3", "area_m2")
    volumes = {name: {key: getattr(getattr(change, name), key) for key in keys} for name in ("net", "cut", "fill")}
    return {
        "first": str(first),
        "second": str(second),
        "crs": change.cells.crs.to_string(),
        "cell_m": change.cells.side_m,
        "n_cells": int(known.sum()),
        "share_significant": float(differences.is_significant[known].mean()),
        "median_m": float(np.median(differences.height[known])),
        "detection_median_m": float(np.median(differences.detection[known])),
        **volumes,
        "correlation": change.correlation,
        "common_correlation": differences.shared,
        "alignment": change.alignment,
        "notes": list(change.notes),
    }


def volume_text(volume: Volume) -> str:
    """A volume with its interval of 95 %, to two digits of that, and its area."""
    half = 0.5 * (volume.interval95_m3[1] - volume.interval95_m3[0])
    digits = max(1 - math.floor(math.log10(half)), 0) if half > 0.0 else 0
    text = f"{volume.volume_m3:+z.{digits}f}".replace("-", MINUS)
    return f"{text} m³ ± {half:.{digits}f} m³ (95 %) over {volume.area_m2:.4g} m²"


def polygons_for(path: Path, cells: Grid) -> dict[str, Polygon]:
    """The polygons of a file by their names, in the CRS of the cells."""
    current().note(*assumed_crs(path))
    return read_polygons(path, cells.crs, cells.box)


def require_surveys(paths: Sequence[Path], options: ChangeOptions) -> dict[Path, Path]:
    """The files of the clouds of surveys; raises where an option is unusable, or a file must not be written."""
    require_options(options)
    surveys = {path: existing_file(cloud_of(path)) for path in paths}
    polygons = [path for path in (options.area, options.stable) if path is not None]
    read = ReadFiles.of(*surveys.values(), *(existing_file(layer_of(path)[0]) for path in polygons))
    require_file("--json", options.json_path, read, kind="a JSON file", is_of_kind=is_json)
    require_file("--picture", options.picture_path, read, kind="a PNG", is_of_kind=is_png)
    if (tif := options.tif_path) is not None:
        if tif.suffix.lower() not in (".tif", ".tiff"):
            raise SurveyError(f"--tif names {tif}, expected a name that ends in .tif")
        kind = "a raster that bathynerf wrote"
        require_file("--tif", tif, read, kind=kind, is_of_kind=lambda head: not head or is_our_tiff(tif))
    if len(surveys) < len(paths):
        twice = next(path for path in paths if list(paths).count(path) > 1)
        raise SurveyError(f"{twice} and {twice} hold the same points: give two surveys")
    return surveys


def _write_raster(change: Change, first: Path, second: Path, path: Path) -> None:
    differences, cells = change.differences, change.cells
    layers = (differences.height, differences.std, differences.detection, differences.is_significant)
    values = np.stack([np.where(change.inside, layer, np.nan) for layer in layers])
    bands = (
        RasterBand("difference, second minus first", "metre"),
        RasterBand("uncertainty of its own, one standard deviation", "metre"),
        RasterBand("minimum level of detection at 95 %", "metre"),
        RasterBand("beyond it: 1", "code"),
    )
    tags = {"FIRST": first.name, "SECOND": second.name, "CELL_M": f"{cells.side_m:g}"}
    form = RasterForm(cells.crs, cells.transform, cells.shape, bands, nodata=_NODATA, tags=tags, resampling="NEAREST")
    write_cog(path, form, [(0, 0, np.where(np.isfinite(values), values, _NODATA).astype(np.float32))])


def _draw(change: Change, path: Path) -> None:
    """A map of the differences; those within the level of detection are pale."""
    from matplotlib.colors import Normalize

    from survey.display.canvas import colour_bar, finished, map_canvas, nice_limit, show
    from survey.display.palette import DIFFERENCES

    cells = change.cells
    d = np.where(change.inside, change.differences.height, np.nan)
    limit = nice_limit(d)
    unit = LengthUnit.of([limit])
    _, axes = map_canvas(cells.extent, cells.crs)
    end = limit * unit.per_metre
    style = {"cmap": DIFFERENCES, "norm": Normalize(-end, end)}
    show(axes, d * unit.per_metre, cells.extent, alpha=0.3, **style)
    is_beyond = change.differences.is_significant
    drawn = show(axes, np.where(is_beyond, d, np.nan) * unit.per_metre, cells.extent, **style)
    colour_bar(axes, drawn, f"second minus first [{unit.name}], pale where not significant")
    parts = (f"{name} {volume_text(getattr(change, name)).partition(' (')[0]}" for name in ("fill", "cut", "net"))
    finished(axes, path, "Change of the bed", f"{'  ·  '.join(parts)} (95 %)", "")
