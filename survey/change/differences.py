"""Differences of two clouds of one place in the cells of a raster, and the standard deviations of their volumes.

The clouds are run folders, LAS, LAZ or COPC, in the CRS of the first.

A difference d of a cell has an error of its own (std s), alike in cells close by, and one that all cells of a survey
share (std c of each survey, fully correlated over it). With the correlation r(h) of own errors at a distance h, the
variance of a sum of cells of area a is

    a² (sum over h of r(h) W(h))  +  a² (A² + B² - 2 q A B),    W(h) = sum over cells of s(x) s(x + h),

A and B the sums of c over the cells of each survey, q the correlation of what the two surveys share. W is computed
exactly by FFT, edges and gaps included. r is exponential (a variogram with a nugget): its share and length are measured
in the differences of cells that have not changed.

Source of the level of detection: J. Wheaton et al., Accounting for uncertainty in DEMs from repeat topographic surveys
(2010); of correlated errors in volumes: S. Rolstad et al., Spatially integrated geodetic glacier mass balance (2009).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pyproj import CRS
from scipy.fft import irfft2, next_fast_len, rfft2

from evaluation.bootstrap import cell_numbers
from evaluation.standards import TO_95
from evaluation.summary import MAD_TO_STD
from geo import Cloud, read_reference, require_same_place
from geo.compatibility import Reprojection, crs_difference
from geo.crs import has_height, height_unit_m
from geo.grid import Grid
from geo.projection import ground_units_m
from geo.shapes import ground_of, in_height_unit
from survey.compare.inputs import common_crs
from survey.compare.options import ChangeOptions
from survey.errors import SurveyError
from survey.export.bed_raster import cells_over, round_side
from survey.export.cell_fit import CellPoints, correlated_px2, fit_cells
from survey.files.json_values import read_json_object
from survey.progress import current
from survey.run.folder import RunDir

# Cells with differences beyond this many robust standard deviations have changed.
CHANGED_STDS = 3.0
# Lags are evaluated up to this share of the shorter side; longer ones have few independent pairs.
_LONGEST_LAG = 0.25
_FEWEST_CELLS = 100
_NUM_LENGTHS = 60
# Side of a cell where none is asked for, in spacings of the points.
_SPACINGS_PER_CELL = 4.0


@dataclass(frozen=True)
class Correlation:
    """Correlation of own errors: 1 at no distance, ``share * exp(-distance / length_m)`` beyond."""

    share: float  # 0 to 1
    length_m: float  # [m]
    # Standard deviation of unchanged differences over the one stated; None where it was not measured
    scatter: float | None = None

    def at(self, distance_m: np.ndarray) -> np.ndarray:
        """The correlation at distances [m]."""
        return np.where(distance_m > 0.0, self.share * np.exp(-distance_m / max(self.length_m, 1e-9)), 1.0)


@dataclass(frozen=True)
class Differences:
    """Second height minus first, in cells; arrays (rows, columns), NaN where one of the surveys has no height."""

    height: np.ndarray  # [m]
    std: np.ndarray  # [m]: by the own errors of both
    # (2, rows, columns) [m]: standard deviation of what all cells of the first and of the second survey share
    common: np.ndarray
    # -1 to 1: correlation of these two: 0 for surveys with a level and poses of their own, 1 where all of it is the
    # same
    shared: float
    side_m: float  # [m]

    @property
    def is_known(self) -> np.ndarray:
        """Cells (rows, columns) with a difference and its standard deviation."""
        return np.isfinite(self.height) & np.isfinite(self.std) & np.isfinite(self.common).all(axis=0)

    @property
    def detection(self) -> np.ndarray:
        """Minimum level of detection (rows, columns) [m] at 95 %: smaller differences are not significant."""
        first, second = self.common
        variance = self.std**2 + first**2 + second**2 - 2.0 * self.shared * first * second
        return TO_95 * np.sqrt(np.maximum(variance, 0.0))

    @property
    def is_significant(self) -> np.ndarray:
        """Cells (rows, columns) beyond the level of detection."""
        return self.is_known & (np.abs(self.height) > self.detection)


@dataclass(frozen=True)
class Volume:
    """A volume [m³] with its standard deviation, over an area [m²]."""

    volume_m3: float
    std_m3: float
    area_m2: float

    @property
    def interval95_m3(self) -> tuple[float, float]:
        """The interval that holds the true volume with a probability of 95 %."""
        half = TO_95 * self.std_m3
        return self.volume_m3 - half, self.volume_m3 + half


def volume_of(differences: Differences, cells: np.ndarray, correlation: Correlation) -> Volume:
    """The volume of the differences of some cells (rows, columns) bool, all of which are known."""
    area = differences.side_m**2
    own = np.where(cells, np.nan_to_num(differences.std), 0.0)
    first, second = (float(np.where(cells, np.nan_to_num(c), 0.0).sum()) for c in differences.common)
    products, distance = _autocorrelation(own, differences.side_m)
    variance = float((products * correlation.at(distance)).sum())
    variance += first**2 + second**2 - 2.0 * differences.shared * first * second
    total = float(np.where(cells, np.nan_to_num(differences.height), 0.0).sum())
    return Volume(area * total, area * math.sqrt(max(variance, 0.0)), area * int(cells.sum()))


def measured_correlation(differences: Differences, cells: np.ndarray) -> Correlation:
    """The correlation of own errors, by differences over their standard deviations in cells that have not changed.

    The exponential function is fitted by least squares to the correlations at all lags, each with the weight of its
    number of pairs.
    """
    ratio = np.where(cells, differences.height / differences.std, np.nan)
    middle = np.nanmedian(ratio)
    spread = MAD_TO_STD * float(np.nanmedian(np.abs(ratio - middle)))
    same = np.isfinite(ratio) & (np.abs(ratio - middle) <= CHANGED_STDS * max(spread, 1e-12))
    if same.sum() < _FEWEST_CELLS:
        raise ValueError(f"{int(same.sum())} cells have not changed, expected at least {_FEWEST_CELLS}")
    if np.ptp(ratio[same]) == 0.0:
        raise ValueError("differences do not scatter: both surveys have the same heights")
    centred = np.where(same, ratio - ratio[same].mean(), 0.0)
    pairs, distance = _autocorrelation(same.astype(np.float64), differences.side_m)
    products, _ = _autocorrelation(centred, differences.side_m)
    longest = _LONGEST_LAG * min(differences.height.shape) * differences.side_m
    used = (distance > 0.0) & (distance <= max(longest, 2.0 * differences.side_m)) & (pairs > 0.5)
    value = products[used] / pairs[used] / (products.flat[0] / pairs.flat[0])
    weight, lag = pairs[used], distance[used]
    best = (math.inf, 0.0, differences.side_m)
    for length in np.geomspace(0.3 * differences.side_m, max(longest, differences.side_m), _NUM_LENGTHS):
        shape = np.exp(-lag / length)
        share = float(np.clip((weight * value * shape).sum() / (weight * shape**2).sum(), 0.0, 1.0))
        best = min(best, (float((weight * (value - share * shape) ** 2).sum()), share, float(length)))
    return Correlation(best[1], best[2], spread)


def _autocorrelation(values: np.ndarray, side_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Sums of products at all lags, and the lengths [m] of these."""
    shape = tuple(next_fast_len(2 * n - 1, real=True) for n in values.shape)
    spectrum = rfft2(values, shape)
    sums = irfft2(np.abs(spectrum) ** 2, shape)
    rows, columns = (np.minimum(np.arange(n), n - np.arange(n)) for n in shape)
    return sums, side_m * np.hypot(rows[:, None], columns[None, :])


def differences_of(
    surveys: Mapping[Path, Path], options: ChangeOptions
) -> tuple[list[Differences], Grid, tuple[str, ...]]:
    """Each later survey minus the first, in the same cells; these, and notes on the surveys.

    ``surveys`` has the file of the cloud of each, in the order of time.
    """
    first, *others = surveys
    clouds = {path: _cloud(path, file) for path, file in surveys.items()}
    for path in others:
        if np.array_equal(clouds[first].points, clouds[path].points):
            raise SurveyError(f"{first} and {path} hold the same points: give two surveys")
    crs, notes = common_crs({path: cloud.crs for path, cloud in clouds.items()})
    if crs is None:
        raise SurveyError(
            f"neither {first} nor {others[0]} states its CRS, in which the differences are written; write it into the "
            "files, e.g. by pdal translate --writers.las.a_srs=EPSG:25832+7837"
        )
    parts: list[Cloud] = []
    for path in surveys:
        notes += shared_photographs(first, path) if path != first else []
        parts.append(_survey_points(clouds.pop(path), path, crs, options, notes))
        require_same_place(parts[0].points, parts[-1].points, str(first), str(path))
    low = np.max([part.points[:, :2].min(axis=0) for part in parts], axis=0)
    high = np.min([part.points[:, :2].max(axis=0) for part in parts], axis=0)
    metres = ground_units_m(crs, 0.5 * (low + high))
    spacing = max(_spacing_m(part.points, metres) for part in parts)
    side = options.resolution_m or round_side(_SPACINGS_PER_CELL * spacing)
    cells = cells_over(np.array([low, high]), crs, side)
    (height, std, common), *later = [_raster_of(part, cells, crs, spacing) for part in parts]
    differences = [
        Differences(h - height, np.hypot(std, s), np.stack([common, c]), options.shared, side) for h, s, c in later
    ]
    if not np.logical_and.reduce([each.is_known for each in differences]).any():
        raise SurveyError(
            f"{', '.join(map(str, others))} and {first} have no cell of {side:g} m in common that points of all cover; "
            "give a larger --resolution, or surveys that overlap"
        )
    return differences, cells, tuple(notes)


def shared_photographs(first: Path, second: Path) -> list[str]:
    """A note where two runs are of the same flight: they share its photographs by name, and its first moment.

    Where neither knows the moment and all names are the same, they probably are.
    """
    if not (first.is_dir() and second.is_dir()):
        return []
    flights = [read_json_object(RunDir(path).report_json_path) for path in (first, second)]
    began = [(flight.get("taken") or {}).get("first") for flight in flights]
    names = [{each["name"] for each in flight.get("photographs", ())} for flight in flights]
    shared = names[0] & names[1]
    if began[0] != began[1] or not shared or (began[0] is None and names[0] != names[1]):
        return []
    what = f"both runs are of the flight of {began[0]} and share {len(shared)} photographs"
    if began[0] is None:
        what = f"both runs have {len(shared)} photographs of the same names, without a time: if they are of one flight"
    return [
        f"{what}, what differs is how they were processed, and their errors are not independent (--common-correlation)"
    ]


def _cloud(path: Path, file: Path) -> Cloud:
    shape = read_reference(file)
    if not isinstance(shape, Cloud):
        raise SurveyError(f"{path} is a mesh, expected a run folder or a cloud as LAS, LAZ or COPC")
    cloud, notes = ground_of(shape, path)
    current().note(*notes)
    return cloud


def _survey_points(cloud: Cloud, path: Path, crs: CRS, options: ChangeOptions, notes: list[str]) -> Cloud:
    """The points of a survey in the common CRS with ``std`` and ``std_common``, both known; adds notes on them."""
    own, unit_m = cloud.crs, height_unit_m(crs)
    if own is None or crs_difference(own, crs) is None:
        if own is not None and has_height(own):
            # Equal but for the unit of heights.
            cloud = replace(cloud, points=cloud.points * [1.0, 1.0, height_unit_m(own) / unit_m])
        cloud = in_height_unit(cloud, unit_m)
    elif has_height(own):
        reprojection = Reprojection.between(own, crs, where=f"the CRS of {path}", places=cloud.points)
        cloud = replace(cloud, points=reprojection(cloud.points))
        notes.append(f"{path} is in {own.name}: transformed to {crs.name}")
        notes += [] if reprojection.warning is None else [reprojection.warning]
    else:
        raise SurveyError(
            f"{path} is in {own.name} without heights, and the other survey in {crs.name}; give both in one"
        )
    columns = {}
    for name, stated, option, what in (
        ("std", options.std_m, "--std", "of its heights"),
        ("std_common", options.std_common_m, "--std-common", "that its heights have in common (level, datum, poses)"),
    ):
        carried = cloud.extra.get(name)
        if carried is not None and np.isfinite(carried).any():
            columns[name] = np.asarray(carried, dtype=np.float64)
        elif stated is not None:
            columns[name] = np.full(len(cloud.points), stated)
            notes.append(f"{path} carries no {name}: taken as {stated:g} m ({option})")
        else:
            raise SurveyError(
                f"{path} carries no {name}, the standard deviation {what}; give it in metres, {option} 0.02"
            )
    keep = np.isfinite(columns["std"]) & np.isfinite(columns["std_common"]) & np.isfinite(cloud.points).all(axis=1)
    if not keep.any():
        raise SurveyError(f"no point of {path} has a standard deviation; give --std and --std-common")
    return Cloud(points=cloud.points[keep], extra={name: values[keep] for name, values in columns.items()})


def _spacing_m(points: np.ndarray, metres: np.ndarray) -> float:
    """Distance of neighbouring points [m], by their density in the box between their quartiles."""
    low, high = np.quantile(points[:, :2], [0.25, 0.75], axis=0)
    inside = ((points[:, :2] >= low) & (points[:, :2] <= high)).all(axis=1)
    return float(np.sqrt(np.prod((high - low) * metres) / max(int(inside.sum()), 1)))


def _raster_of(survey: Cloud, cells: Grid, crs: CRS, spacing_m: float) -> tuple[np.ndarray, ...]:
    """Heights, their own and their common standard deviations (rows, columns) [m]; NaN where there are none."""
    at = cells.columns_rows(survey.points)
    number = cell_numbers(at, cells.shape)
    inside = number >= 0
    at, number = at[inside], number[inside]
    std, common = (survey.extra[name][inside] for name in ("std", "std_common"))
    height = survey.points[inside, 2] * height_unit_m(crs)
    layers = np.full((3, cells.shape[0] * cells.shape[1]), np.nan)
    if len(at):
        correlated = correlated_px2(at * cells.side_m, height, std, spacing_m)
        offset = (at - np.floor(at) - 0.5) * [1.0, -1.0]
        points = CellPoints(number, offset, height, std)
        fits = fit_cells(points, side=cells.side_m, pixel=spacing_m, correlated=correlated)
        size = layers.shape[1]
        mean = np.bincount(number, common**2, size)[fits.cell] / np.bincount(number, minlength=size)[fits.cell]
        layers[:, fits.cell] = fits.height, fits.std, np.sqrt(mean)
    return tuple(layer.reshape(cells.shape) for layer in layers)
