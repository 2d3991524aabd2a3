"""The water by [water]: its level from measurements on site, and its refractive index.

    shoreline, gnss_points   CSV with easting, northing, height in crs, or GeoJSON: a plane is fitted
    surface                  the same or a raster: a plane under the photographs, and `survey.water.surface`
    gauge                    CSV with time, level: interpolated at the time of each photograph
    image_levels             CSV with image, level
    clicks                   CSV with image, x, y, name: places of the waterline where rays meet

Each is converted to level_m, its standard deviation and slopes of [water] when the survey is read; clicks once poses
are known. The measurements themselves are in `survey.water.level_observation`, the level at each photograph in
`survey.water.tides`.

An index belongs to a wavelength (docs/light.md). The one that the program works with belongs to the light that is
matched, a mixture of the channels of the photographs. ``refractive_index`` is that one, unless ``index_wavelength_nm``
says to which wavelength it belongs: then, as from temperature and salinity, the index is that of the shares which red,
green and blue have in the texture of the photographs.
"""

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pyproj import CRS

from evaluation.summary import HUBER_OF_MANY, huber_weights, std_by_median
from geo.crs import height_unit_m
from geo.frames import LocalFrame
from geo.projection import metres_per_unit
from refract.media import converted_index
from survey.display.quantities import length
from survey.errors import FILE_NAME, ConfigError, Findings
from survey.photos.cameras import View
from survey.photos.exif import Exif
from survey.photos.texture import MatchedLight
from survey.settings import config as settings
from survey.water.level_observation import COMMON_STD_M, LevelObservation, levels_of_clicks, points_of_surface
from survey.water.surface import SURFACE, plane_warning
from survey.water.tides import MovingLevel, Tide, tide_of_gauge, tide_of_levels, tide_of_rate

_MEASURED = ("shoreline", "gnss_points")
# A level in survey.toml without level_std_m is that of a staff.
STAFF_STD_M = 0.02
# Slopes count only where they exceed their standard deviation by this factor.
_SIGNIFICANT = 3.0
# Fewer points than this may lie on a tilted plane by chance, and do not determine their scatter.
_FEW = 6
_LEAST_STD_M, _MOST_ROUNDS = 1e-3, 50
# Points farther from the plane than so many standard deviations are named; more than this share are not of one water.
_FAR, _MOST_FAR = 5.0, 0.5
# Points of a surface that are no farther apart count as one place [m].
_ONE_PLACE_M = 0.1
# Points of a surface up to this far beyond the cameras, in flying heights, are used for its plane.
_UNDER_VIEWS = 0.5
# Wavelength of handbooks: the sodium line.
FRESH_WATER, SEA_WATER, SODIUM_NM = 1.333, 1.340, 589.3
# Std of an assumed index: any water from fresh to that of the sea, 0.007 above, is as likely.
ASSUMED_INDEX_STD = 0.004


@dataclass(frozen=True)
class SurfaceFit:
    """A plane through points of the water surface."""

    level_m: float  # [m]: at the mean of the points, easting and northing `level_at`
    level_at: tuple[float, float]  # (easting, northing)
    # slope_east, slope_north [-]: zero where the points do not show any
    slope_east: float
    slope_north: float
    covariance: np.ndarray  # (3, 3): of level, slope_east and slope_north; zero rows for slopes that were not fitted


def with_level(
    folder: Path, config: settings.SurveyConfig, headers: Mapping[str, Exif], crs: CRS
) -> tuple[settings.SurveyConfig, tuple[LevelObservation, ...], Tide | None, Findings]:
    """Settings with the water level from the file that [water] names, the measurements, and the tide.

    Clicks are left for `with_level_of_clicks`.
    """
    water = config.water
    if water is None:
        return config, (), None, Findings()
    tide = None if water.level_rate_m_per_h is None else tide_of_rate(water, headers)
    if water.level_m is not None:
        std = STAFF_STD_M if water.level_std_m is None else water.level_std_m
        return config, (LevelObservation(water.level_m, std, water.level_at, None, "level_m"),), tide, Findings()
    unit_m = height_unit_m(crs)
    if water.gauge is not None:
        moving = tide_of_gauge(folder / water.gauge, water, headers, unit_m)
        return _with_moving(config, water, moving, f"mean at {moving.num_images} of {len(headers)} images")
    if water.image_levels is not None:
        moving = tide_of_levels(folder / water.image_levels, headers, unit_m)
        return _with_moving(config, water, moving, f"mean of {moving.num_images} images")
    name = next((source for source in (*_MEASURED, SURFACE) if source in water.level_files), None)
    if name is None:
        return config, (), tide, Findings()
    path = folder / water.level_files[name]
    points, found = points_of_surface(path, name, crs, water.layer)
    if name == SURFACE:
        _require_apart(path, points, crs)
    fitted, findings = _of_points(water, points, crs)
    if name == SURFACE:
        # `with_plane_of_surface` fits the plane under the photographs, and reports it.
        fitted, findings = replace(fitted, level_std_m=water.level_std_m), Findings()
    return replace(config, water=fitted), points, tide, found + findings


def _require_apart(path: Path, points: Sequence[LevelObservation], crs: CRS) -> None:
    """Raise ConfigError where all points of a surface lie at one place, and so do not determine a surface."""
    places = np.array([(*each.place, 0.0) for each in points if each.place is not None]).reshape(-1, 3)
    if not len(places):
        return
    spread_m = float(np.linalg.norm(np.ptp(places[:, :2], axis=0) * metres_per_unit(crs, places)))
    if spread_m < _ONE_PLACE_M:
        raise ConfigError(
            f"{path} has {len(places)} points of the water surface within {100.0 * spread_m:.0f} cm of each other, "
            "expected points spread over the water under the photographs; measure more, or give their mean height as "
            "[water] level_m"
        )


def with_plane_of_surface(
    config: settings.SurveyConfig, levels: Sequence[LevelObservation], views: Sequence[View], frame: LocalFrame
) -> tuple[settings.SurveyConfig, Findings]:
    """Settings with the plane through the points of [water] surface under the photographs, or through all of them."""
    points = [level for level in levels if level.source == SURFACE and level.place is not None]
    if config.water is None or not points:
        return config, Findings()
    at = frame.local_from_crs(np.array([(*point.place, 0.0) for point in points if point.place is not None]))[:, :2]
    centres = np.array([view.camera.centre for view in views])
    level = [*config.water.known_level_at, config.water.known_level_m / height_unit_m(frame.crs)]
    height = float(np.median(centres[:, 2])) - float(frame.local_from_crs(np.array(level))[2])
    reach = _UNDER_VIEWS * max(height, 0.0)
    low, high = centres[:, :2].min(axis=0) - reach, centres[:, :2].max(axis=0) + reach
    near = [points[i] for i in np.flatnonzero(((at >= low) & (at <= high)).all(axis=1))]
    water = replace(config.water, level_at=None, slope_east=0.0, slope_north=0.0)
    water, findings = _of_points(water, near if len(near) >= _FEW else points, frame.crs)
    return replace(config, water=water), findings


def with_level_of_clicks(
    folder: Path, config: settings.SurveyConfig, views: Sequence[View], frame: LocalFrame
) -> tuple[settings.SurveyConfig, tuple[LevelObservation, ...], Findings]:
    """Settings with the water level where rays of clicks in the photographs meet, and the heights of all places."""
    water = config.water
    if water is None or water.clicks is None:
        return config, (), Findings()
    places, findings = levels_of_clicks(folder / water.clicks, views, frame)
    water, of_level = _of_points(water, places, frame.crs)
    return replace(config, water=water), places, findings + of_level


def _of_points(
    water: settings.WaterConfig, points: Sequence[LevelObservation], crs: CRS
) -> tuple[settings.WaterConfig, Findings]:
    """The water through points of its surface, with the standard deviation of its level at ``level_at``."""
    source = points[0].source if points else "points"
    coordinates = np.array([(*each.place, each.level_m) for each in points if each.place is not None]).reshape(-1, 3)
    stds = np.array([each.std_m for each in points])
    # Slopes are metres of height in metres of ground, whatever the unit of crs.
    unit_m = metres_per_unit(crs, coordinates) if len(coordinates) else np.ones(2)
    if not np.isfinite(unit_m).all():
        # On no map: `survey.water.level_observation` refuses them beside the cameras.
        unit_m = np.ones(2)
    coordinates[:, :2] *= unit_m
    free = water.slope_east == 0.0 == water.slope_north
    fit = fit_surface(coordinates, stds, with_slopes=free, least=1 if source == "clicks" else 3)
    slope = (fit.slope_east or water.slope_east, fit.slope_north or water.slope_north)
    remedy = "points of two waters, of the bed or the bank are not of one surface: give those of the water alone"
    settings.require_slope(slope, f"the points in [water] {source} have slopes east and north of", remedy)
    # By the slopes, from the middle of the points to level_at.
    east, north = (np.array(fit.level_at) / unit_m).tolist()
    level_at = water.level_at or (east, north)
    offset_m = np.array(level_at) * unit_m - fit.level_at
    level = fit.level_m + float(np.array(slope) @ offset_m)
    terms, common = np.array([1.0, *offset_m]), COMMON_STD_M.get(source, 0.0)
    std = math.hypot(math.sqrt(terms @ fit.covariance @ terms), common)
    shared = f", of which {common:g} m that all of them share" if common else ""
    message = (
        f"level_m = {level:.3f} +- {std:.3f} from {len(coordinates)} points in [water] {source}, slope "
        f"{slope[0]:.5f} east and {slope[1]:.5f} north{shared}"
    )
    level_std_m = water.level_std_m or min(std, settings.MOST_LEVEL_STD_M)
    warning = None
    if source in _MEASURED:
        residuals = coordinates[:, 2] - fit.level_m - (coordinates[:, :2] - fit.level_at) @ slope
        warning = plane_warning(coordinates, stds, level_std_m, source) if free else None
        warning = warning or _far_warning(residuals, stds, source)
    water = replace(
        water, level_m=level, level_at=level_at, slope_east=slope[0], slope_north=slope[1], level_std_m=level_std_m,
        layer=None, **settings.NO_LEVEL_FILES,
    )  # fmt: skip
    return water, Findings((message,), () if warning is None else (warning,))


def _far_warning(residuals: np.ndarray, stds: np.ndarray, source: str) -> str | None:
    """A warning where points lie farther from the plane, by residuals (N,) [m], than their std explains."""
    far = np.abs(residuals) > _FAR * stds
    if not far.any():
        return None
    worst = float(residuals[np.argmax(np.abs(residuals))])
    message = (
        f"{int(far.sum())} of {len(far)} points in [water] {source} lie more than {_FAR:g} standard deviations from "
        f"the plane through all, the farthest {length(abs(worst))}"
    )
    if far.mean() > _MOST_FAR:
        raise ConfigError(
            f"{message}: they are not of one water; leave out those of the bed, the bank or another water, or give "
            "the accuracy of the points in a column std"
        )
    side = "over" if worst > 0.0 else "under"
    return f"{message} {side} it: check that none is of the bed, the bank or another water"


def fit_surface(
    points: np.ndarray, stds: np.ndarray | None = None, *, with_slopes: bool = True, least: int = 3
) -> SurfaceFit:
    """A level surface, or a tilted plane where the points show one; robust against outliers.

    Points (N, 3) are easting, northing, height [m], at least ``least`` of them; ``stds`` (N,) [m] are weights, and the
    lower bound of the scatter of few points. A tilt is one that exceeds three standard deviations.
    """
    points = np.asarray(points, dtype=np.float64)
    if len(points) < least:
        raise ConfigError(
            f"{len(points)} points of the water surface were found, expected {'three' if least == 3 else 'one'} or "
            "more; measure more, or give level_m"
        )
    stds = np.full(len(points), _LEAST_STD_M) if stds is None else stds
    east, north = points[:, :2].mean(axis=0).tolist()
    design = np.column_stack([np.ones(len(points)), points[:, :2] - (east, north)])
    # Points along one line do not determine the slope across it.
    spread = np.linalg.svd(design[:, 1:], compute_uv=False)
    if with_slopes and len(points) >= _FEW and spread[1] > 0.05 * spread[0]:
        values, covariance = _robust(design, points[:, 2], stds)
        if math.hypot(*values[1:]) > settings.MOST_SLOPE:
            # The scatter of few points may be small by chance: no water slopes so.
            values, covariance = _robust(design, points[:, 2], stds, 1.0)
        if values[1:] @ np.linalg.solve(covariance[1:, 1:], values[1:]) > _SIGNIFICANT**2:
            level, slope_east, slope_north = values.tolist()
            return SurfaceFit(level, (east, north), slope_east, slope_north, covariance)
    values, covariance = _robust(design[:, :1], points[:, 2], stds)
    return SurfaceFit(float(values[0]), (east, north), 0.0, 0.0, np.diag([covariance[0, 0], 0.0, 0.0]))


def _robust(
    design: np.ndarray, heights: np.ndarray, stds: np.ndarray, least_scatter: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Huber's estimate and its covariance, in units of the stated standard deviations.

    The scatter is the median absolute deviation. For few points it is uncertain, and the stated one counts if larger.
    """
    # Such files are rounded to a millimetre: the scatter is not smaller than that.
    least = max(_LEAST_STD_M / float(np.median(stds)), 1.0 if len(heights) < _FEW else least_scatter)
    weights, scatter = np.ones(len(heights)), least
    for _ in range(_MOST_ROUNDS):
        root = np.sqrt(weights) / stds
        values = np.linalg.lstsq(design * root[:, None], heights * root, rcond=None)[0]
        normalised = np.abs(heights - design @ values) / stds
        scatter = max(float(std_by_median(normalised)), least)
        weights = huber_weights(normalised, scatter, HUBER_OF_MANY)
    normal = design.T @ ((weights / stds**2)[:, None] * design)
    return values, np.linalg.inv(normal) * scatter**2 * len(heights) / max(len(heights) - design.shape[1], 1)


def _with_moving(
    config: settings.SurveyConfig, water: settings.WaterConfig, moving: MovingLevel, note: str
) -> tuple[settings.SurveyConfig, tuple[LevelObservation, ...], Tide, Findings]:
    """Settings with the mean level over the photographs, and a sentence on it.

    Its standard deviation includes that of a reading, of the zero of the gauge, and of what lies between readings.
    """
    source = moving.tide.source
    reading = float(np.median([each.std_m for each in moving.observations]))
    std = math.hypot(reading, COMMON_STD_M[source], moving.gap_std_m)
    text = (
        f"level_m = {moving.level_m:.3f} +- {std:.3f} from [water] {source}: {note}, over which it changes by "
        f"{1000.0 * moving.tide.moves_m:.0f} mm"
    )
    level_std = water.level_std_m or min(std, settings.MOST_LEVEL_STD_M)
    water = replace(water, level_m=moving.level_m, level_std_m=level_std, gauge_zero_m=None, **settings.NO_LEVEL_FILES)
    return replace(config, water=water), moving.observations, moving.tide, Findings((text,)) + moving.findings


def refractive_index(given: settings.WaterConfig, light: Callable[[], MatchedLight]) -> tuple[float, Findings]:
    """Index of the water relative to air, for the light that is matched, and what is assumed.

    ``light`` measures that of the photographs; it is called only where the index depends on it.
    """
    temperature_c, salinity_psu = given.temperature_c, given.salinity_psu
    if temperature_c is None:
        index, wavelength_nm, what = given.refractive_index, given.index_wavelength_nm, ""
        if index is None:
            index, wavelength_nm = FRESH_WATER, SODIUM_NM
            what = f"fresh water (the sea has {SEA_WATER:.3f}, 0.7 % more depth), "
        if wavelength_nm is None:
            return index, Findings()
        matched = light()
        found = round(converted_index(index, wavelength_nm, matched.shares), 6)
        return found, Findings((f"refractive_index = {found}, {what}{index:g} at {wavelength_nm:g} nm for {matched}",))
    matched, assumed = light(), () if salinity_psu is not None else ("salinity_psu = 0, fresh water",)
    with warnings.catch_warnings(record=True) as fit_warnings:
        warnings.simplefilter("always")
        try:
            index = round(matched.index(temperature_c, salinity_psu or 0.0), 6)
        except ValueError as error:
            raise ConfigError(f"[water] in {FILE_NAME}: {error}; or give refractive_index instead") from error
    message = f"refractive_index = {index}, of water of {temperature_c:g} degrees for {matched}"
    if fit_warnings:
        message += f", although {' and '.join(dict.fromkeys(str(each.message) for each in fit_warnings))}"
    return index, Findings((*assumed, message))
