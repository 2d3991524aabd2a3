"""Self-calibration: level, tilt and refractive index of the water from tie points, and whether they are observable.

Photographs that see a place at different angles disagree about it unless the assumed water is right. Its tie
points (`survey.adjust.windows` measures them) are adjusted for the water that makes them agree best
(`survey.adjust.least_squares`), and errors of the poses and the lens are propagated into the result
(`survey.adjust.free_errors`). A parameter whose standard deviation is too large to be of use is "not observable": it
keeps its value from survey.toml.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from refract import FlatWater
from survey.adjust.free_errors import Errors, Freed, free_errors
from survey.adjust.least_squares import Adjusted, NotConvergedError, adjust
from survey.adjust.water_estimate import PARAMETERS, ParameterEstimate, WaterEstimate
from survey.folder.config import WaterConfig
from survey.folder.place import water_plane
from survey.folder.survey import Survey
from survey.photos.tie_points import TiePoints
from survey.plan.plan import make_plan

# Assumed standard deviations of poses and lens, unless the caller knows better: an adjusted block with RTK positions or
# control, and a lens calibrated to a twentieth of a pixel.
POSE_STD_M, POSE_STD_DEG = 0.01, 0.003
LENS_STD_PX = 0.05
# How much higher a rough bed appears at 45 degrees, as a share of the ground sampling distance.
BED_STD_GSD = 0.1
# Tie points within this many ground sampling distances, two windows side by side, have correlated errors.
CELL_GSD = 40.0
# Prior standard deviations about the start. Too wide to affect a parameter that the block determines.
_PRIOR_STD = np.array([5.0, 0.05, 0.05, 0.1])
# A parameter that is not observable is held with this standard deviation while the others are estimated: the index of
# natural water is known this well without measurement, and so are the slopes of water seen on site.
_HELD_STD = np.array([np.nan, 1e-3, 1e-3, 3e-3])
# One sigma beyond which a parameter is of no use. 5 cm of level move the bed by 2 cm, and so does 0.01 of index in 3 m
# of water; slopes count by their effect at the edge of the points.
MOST_STD_LEVEL_M, MOST_STD_INDEX = 0.05, 0.01
# Residuals of more standard deviations than this are outliers.
_OUTLIER = 4.0
_INDEX_RANGE = (1.0, 2.0)
# Fewest tie points under water. The covariance is estimated from the scatter of N points, to one part in sqrt(2 N): an
# eighth. Fewer also turn wet and dry as the level moves, and the adjustment oscillates.
FEWEST_WET = 30


def water_from_ties(
    survey: Survey,
    ties: TiePoints,
    *,
    pose_std_m: float = POSE_STD_M,
    pose_std_deg: float = POSE_STD_DEG,
    lens_std_px: float = LENS_STD_PX,
) -> WaterEstimate:
    """The water from tie points that are measured; parameters as for `calibrate_water`.

    Where too few of them lie under water, or the adjustment does not converge, nothing is observable, and the verdicts
    say why.
    """
    cameras = [view.camera for view in survey.views]
    _, settings = survey.require_water()
    given = np.array([getattr(settings, name) for name in PARAMETERS])

    def water_of(parameters: np.ndarray):
        return water_plane(survey.frame, _config_of(settings, parameters))

    def freed_with(prior_std: np.ndarray) -> Freed:
        return free_errors(cameras, kept, solved, water_of, given, prior_std, errors)

    gsd = make_plan(survey).gsd_m
    errors = Errors(pose_std_m, math.radians(pose_std_deg), lens_std_px, BED_STD_GSD * gsd, CELL_GSD * gsd)
    if _num_wet(ties.start, water_of(given)) < FEWEST_WET:
        return _unknown(settings, ties, water_of(given), errors)
    prior_std, limits = _PRIOR_STD.copy(), _useful_std(ties)
    try:
        kept, solved = _without_outliers(cameras, ties, water_of, given, prior_std)
    except NotConvergedError as error:
        return _unknown(settings, ties, water_of(given), errors, str(error))
    if _num_wet(solved.points, water_of(solved.parameters)) < FEWEST_WET:
        return _unknown(settings, replace(kept, start=solved.points), water_of(solved.parameters), errors)
    first = freed = freed_with(prior_std)
    held = np.zeros(len(PARAMETERS), dtype=bool)
    for _ in PARAMETERS:
        std = np.sqrt(np.diag(freed.covariance))
        lost = ~held & ~(std <= limits)
        if not lost.any():
            break
        if lost[0]:
            # Without the level nothing is observable; the reported values are those with all parameters free.
            freed, held[:] = first, True
            break
        worst = int(np.argmax(np.where(lost, std / limits, 0.0)))
        held[worst], prior_std[worst] = True, _HELD_STD[worst]
        freed = freed_with(prior_std)
    estimates = tuple(_estimate(i, freed, first, given[i], held[i], limits[i]) for i in range(len(PARAMETERS)))
    water = water_of(freed.parameters)
    return WaterEstimate(
        water=_config_of(settings, np.where(held, given, freed.parameters)),
        estimates=estimates,
        covariance=tuple(tuple(float(v) for v in row) for row in freed.covariance),
        num_views=len(np.unique(kept.view)),
        num_points=len(kept),
        num_measurements=len(kept.view),
        num_dry=len(kept) - _num_wet(solved.points, water),
        rms_px=float(np.sqrt(np.mean(np.square(solved.residuals)))),
        pose_std_m=pose_std_m,
        pose_std_deg=pose_std_deg,
        lens_std_px=lens_std_px,
    )


def _num_wet(points: np.ndarray, water: FlatWater) -> int:
    return int((water.depth(points) > 0.0).sum())


def _unknown(
    given: WaterConfig, ties: TiePoints, water: FlatWater, errors: Errors, why: str | None = None
) -> WaterEstimate:
    """The estimate where nothing is observable: the values of survey.toml, with their prior standard deviations."""
    num_wet = _num_wet(ties.start, water)
    under = f"{num_wet} of {len(ties)} tie points lie under water"
    why = f"{under}, expected at least {FEWEST_WET}" if why is None else f"{why}; {under}"
    estimates = []
    for name, std in zip(PARAMETERS, _PRIOR_STD, strict=True):
        value = float(getattr(given, name))
        # The reason stands once, with the level.
        reason = why if name == "level_m" else "the level is not"
        verdict = f"not observable: {reason}; {_with_unit(name, value)} is kept as given"
        estimates.append(ParameterEstimate(name, value, float(std), float(std), 0.0, 0.0, 0.0, value, False, verdict))
    return WaterEstimate(
        water=given,
        estimates=tuple(estimates),
        covariance=tuple(tuple(float(v) for v in row) for row in np.diag(_PRIOR_STD**2)),
        num_views=len(np.unique(ties.view)),
        num_points=len(ties),
        num_measurements=len(ties.view),
        num_dry=len(ties) - num_wet,
        rms_px=None,
        pose_std_m=errors.position_m,
        pose_std_deg=math.degrees(errors.direction_rad),
        lens_std_px=errors.lens_px,
    )


def _with_unit(name: str, value: float) -> str:
    return f"{value:.5f} m" if name == "level_m" else f"{value:.5f}"


def _config_of(given: WaterConfig, parameters: np.ndarray) -> WaterConfig:
    level, east, north, index = parameters.tolist()
    # Single steps may leave the physical range; a converged solution never lies at its ends.
    index = min(max(index, _INDEX_RANGE[0]), _INDEX_RANGE[1])
    return replace(given, level_m=level, slope_east=east, slope_north=north, refractive_index=index)


def _useful_std(ties: TiePoints) -> np.ndarray:
    """The largest standard deviations that are of use."""
    middle = np.median(ties.start[:, :2], axis=0)
    reach = float(np.quantile(np.linalg.norm(ties.start[:, :2] - middle, axis=1), 0.95))
    return np.array([MOST_STD_LEVEL_M, MOST_STD_LEVEL_M / reach, MOST_STD_LEVEL_M / reach, MOST_STD_INDEX])


def _without_outliers(cameras, ties: TiePoints, water_of, start, prior_std) -> tuple[TiePoints, Adjusted]:
    """The adjustment, repeated without its outliers."""
    solved = adjust(cameras, ties, water_of, start, prior_std)
    length = np.linalg.norm(solved.residuals, axis=1)
    kept = replace(ties, start=solved.points).only(length < _OUTLIER * solved.std_px)
    return kept, adjust(cameras, kept, water_of, solved.parameters, prior_std, centre=start)


def _estimate(i: int, freed: Freed, first: Freed, given: float, is_held: bool, limit: float) -> ParameterEstimate:
    unit, value = " m" if i == 0 else "", float(freed.parameters[i])
    measured, pose, lens, bed, std, first_std = (
        float(np.sqrt(part[i, i]))
        for part in (freed.measured, freed.pose, freed.lens, freed.bed, freed.covariance, first.covariance)
    )
    if is_held:
        reason = f"1 sigma is {first_std:.2g}{unit}, at most {limit:.2g}{unit} would be of use"
        if first_std <= limit:
            # Held because the level is: what it seems to be depends on where the level is kept.
            reason = f"the level is not, and {PARAMETERS[i]} cannot be separated from it"
        verdict = f"not observable: {reason}; {_with_unit(PARAMETERS[i], given)} is kept as given"
    else:
        verdict = f"estimated: {value:.5f} +- {std:.2g}{unit}"
    return ParameterEstimate(PARAMETERS[i], value, std, measured, pose, lens, bed, float(given), not is_held, verdict)
