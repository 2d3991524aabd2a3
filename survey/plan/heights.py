"""Heights of a survey: the range searched for the bed with its source, and the approximate height of dry ground.

Every height in this range is tried: chance matches far from the bed cost time and points, and a bed beyond it is lost.
So the range is the one in survey.toml, else that of the matched points that came with the poses, else a multiple of
the flying height.

Matched points under water come from straight rays and seem too shallow: two rays from the same side meet between their
tangential images, two from opposite sides between their sagittal ones (`refract.snell`), and the least squares of
many is a weighted mean of where the pairs meet. The tangential image of the most oblique view is the highest of all
these, so that its share of the true depth gives the greatest depth at which the point can lie.
"""

from dataclasses import dataclass

import numpy as np

from geo.crs import height_unit_m
from refract import apparent_depth_tangential
from survey.errors import FILE_NAME, ConfigError
from survey.folder.plausible import GroundHeight, ground_below
from survey.folder.survey import Survey

# Search limits in flying heights: above the water, and below it. Drones fly 8 m above 10 m of clear water, and beside
# banks nearly as high as they are.
HIGHEST, DEEPEST = 0.8, 1.5
# Over dry ground without points the flying height is only estimated from the overlap: a third of it to three times it.
_DRY_NEAREST, _DRY_FARTHEST = 1.0 / 3.0, 3.0
# Wrong matches lie beyond these quantiles of the points; with fewer points the quantiles are too uncertain.
_OUTER = (0.005, 0.995)
_FEWEST_POINTS = 200
# Added above and below: the quantiles leave out one point in a hundred, and the deepest bed shows the least texture.
# Half of the points' span covers continuing slopes, a tenth of the flying height isolated objects (a mast, a pool).
_MARGIN_SPAN, _MARGIN_FLYING = 0.5, 0.1
# Views of a point nearer to the horizon than this do not determine its height.
_GRAZING_DEG = 80.0
# Fewer tie points are not used for a height: some of them may be wrong.
_FEWEST_TIE_POINTS = 50


@dataclass(frozen=True)
class HeightRange:
    """Heights [m] over the water plane (over local z = 0 in a dry survey) between which the bed is searched."""

    # low, high: [m]
    low: float
    high: float
    reason: str  # a sentence


def height_range(survey: Survey, flying_m: float) -> HeightRange:
    """The range of heights searched for the bed; ``flying_m`` [m]: of the cameras over water or ground, median."""
    if survey.config.area.heights is not None:
        return _of_config(survey, survey.config.area.heights)
    points = survey.observations.points
    if points is not None and len(points) >= _FEWEST_POINTS:
        return _of_points(survey, points, flying_m)
    if survey.water is not None:
        low, high = -DEEPEST * flying_m, HIGHEST * flying_m
        return HeightRange(
            low,
            high,
            f"{DEEPEST:g} flying heights down and {HIGHEST:g} up, because neither [area] heights nor "
            f"{_FEWEST_POINTS} matched points are given; either would narrow it",
        )
    top = float(np.median(_centres(survey)[:, 2]))
    low, high = top - _DRY_FARTHEST * flying_m, top - _DRY_NEAREST * flying_m
    return HeightRange(
        low,
        high,
        "a third to three times the height over the ground; [area] heights, or poses with matched points, would narrow "
        "it",
    )


def _of_config(survey: Survey, heights: tuple[float, float]) -> HeightRange:
    """Range by [area] heights in crs, in its unit, converted to heights over the (possibly sloped) plane."""
    centres = survey.frame.crs_from_local(_centres(survey))
    ends = []
    for height in heights:
        centres[:, 2] = height
        ends.append(_heights(survey, survey.frame.local_from_crs(centres)))
    low, high = float(ends[0].min()), float(ends[1].max())
    lowest = float(_heights(survey, _centres(survey)).min())
    if high >= lowest:
        raise ConfigError(
            f"[area] heights is {list(heights)} in {FILE_NAME}, whose upper end lies {high - lowest:.1f} m above the "
            "lowest camera; give the lowest and highest ground to search, in the heights of crs"
        )
    return HeightRange(low, high, f"[area] heights in {FILE_NAME}")


def _of_points(survey: Survey, points: np.ndarray, flying_m: float) -> HeightRange:
    """Range by the apparent and the lowest true heights of matched points (N, 3) [m], local."""
    apparent = _heights(survey, points)
    base = 0.0 if survey.water is not None else float(np.median(apparent))
    if survey.water is None:
        flying_m = float(np.median(_heights(survey, _centres(survey)))) - base
    lowest, highest = base - DEEPEST * flying_m, base + HIGHEST * flying_m
    low = float(np.quantile(np.maximum(_deepest(survey, points, apparent), lowest), _OUTER[0]))
    apparent_low, high = (float(v) for v in np.quantile(apparent, _OUTER))
    margin = max(_MARGIN_SPAN * (high - low), _MARGIN_FLYING * flying_m)
    wet = f", the deepest no lower than {low:.1f} m through the water" if low < apparent_low else ""
    kind = "heights" if survey.provenance.is_adjusted else "apparent heights"
    reason = (
        f"{kind} of the {len(apparent):,} matched points: {apparent_low:.1f} to {high:.1f} m{wet}; "
        f"{margin:.1f} m are added on both sides"
    )
    num_wet = int((apparent < 0.0).sum())
    if survey.water is not None and num_wet < _FEWEST_POINTS:
        reason += f"; only {num_wet} of them are under water: give [area] heights if its bed may lie deeper"
    return HeightRange(max(low - margin, lowest), min(high + margin, highest), reason)


def _deepest(survey: Survey, points: np.ndarray, apparent: np.ndarray) -> np.ndarray:
    """Lowest true heights (N,) [m] over the plane for points (N, 3) with apparent heights (N,)."""
    water, wet = survey.water, apparent < 0.0
    if water is None or survey.provenance.is_adjusted or not wet.any():
        return apparent
    points, up = points[wet], np.array(water.up)
    cosine = np.ones(len(points))
    for view in survey.views:
        pixel, camera = view.camera.project(points, None), view.camera
        is_seen = camera.sees(pixel)
        ray = camera.centre - points
        own = ray @ up / np.linalg.norm(ray, axis=1)
        cosine = np.where(is_seen, np.minimum(cosine, own), cosine)
    angle = np.arccos(np.maximum(cosine, np.cos(np.radians(_GRAZING_DEG))))
    deepest = apparent.copy()
    deepest[wet] /= apparent_depth_tangential(1.0, angle, n_water=water.n_water)
    return deepest


def _centres(survey: Survey) -> np.ndarray:
    return np.array([view.camera.centre for view in survey.views])


def _heights(survey: Survey, points: np.ndarray) -> np.ndarray:
    """Heights (N,) [m] of points (N, 3), local, over the water plane, or over local z = 0."""
    return points[:, 2] if survey.water is None else -survey.water.depth(points)


def camera_height_m(survey: Survey) -> float:
    """Height [m] of the cameras over the water or ground, median."""
    ground = 0.0 if survey.water is not None else dry_ground(survey).height
    return float(np.median(_heights(survey, _centres(survey)))) - ground


def dry_ground(survey: Survey) -> GroundHeight:
    """Rough height of the ground of a survey, without regard to water.

    From the median of the tie points, else of the control points, else the middle of ``[area] heights``, else where
    the axes of oblique views converge, else where neighbours overlap as planners aim at.
    """
    points, control = survey.observations.points, survey.observations.control
    if points is not None and len(points) >= _FEWEST_TIE_POINTS:
        return GroundHeight(float(np.median(points[:, 2])), f"the median of {len(points):,} tie points")
    cameras = [view.camera for view in survey.views]
    if control is not None and control.points:
        # By their heights in crs: level ground kilometres from the origin lies metres below its z = 0.
        height = float(np.median([point.crs[2] for point in control.points])) - survey.frame.origin[2]
        return GroundHeight(
            height * height_unit_m(survey.frame.crs), f"the median of {len(control.points)} control points"
        )
    heights = survey.config.area.heights
    if heights is not None:
        place = survey.frame.crs_from_local(np.median([camera.centre for camera in cameras], axis=0))
        place[2] = 0.5 * sum(heights)
        return GroundHeight(float(survey.frame.local_from_crs(place)[2]), "the middle of [area] heights")
    return ground_below(cameras)
