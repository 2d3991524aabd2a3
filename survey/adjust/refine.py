"""Poses, lens and water of a survey together, from its photographs, positions, control and readings.

matches of structure from motion (`Survey.ties`), where there are any -> a first adjustment, that takes the bend out
windows matched to a fraction of a pixel on the adjusted block (`survey.adjust.windows`) -> the final adjustment
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from refract.lens import Lens
from survey.adjust.adjustment import Adjustment, ControlResidual, Parameter
from survey.adjust.free_water import Lost, adjust_free, dry_or_within_bounds, within_bounds
from survey.adjust.observed import KINDS, MARK, MATCH, WINDOW, Observed, observed
from survey.adjust.priors import Known, is_held, known_of
from survey.adjust.rounds import Adjusted, adjust
from survey.adjust.state import LENS_NAMES, WATER, WATER_NAMES, State
from survey.adjust.thinning import thinned
from survey.adjust.verdicts import lens_verdicts, lost_verdict, water_limits, water_verdicts
from survey.adjust.water_settings import settings_by_local, settings_of, with_settings
from survey.adjust.windows_of_survey import measure_windows
from survey.folder.config import WaterConfig
from survey.folder.place import water_plane
from survey.folder.survey import Survey
from survey.photos.tie_points import TiePoints
from survey.plan.plan import make_plan

# Matches are thinned to this many in each of so many cells along a photograph.
_CELLS, _PER_CELL = 10, 4
_POSE_NAMES = ("x", "y", "z", "turn_x", "turn_y", "turn_z")
_MARKS_STD_PX = 0.5


def adjust_survey(
    survey: Survey,
    *,
    device: str = "auto",
    advance: Callable[[float], None] = lambda _share: None,
    use_windows: bool = True,
    free_water: bool = False,
) -> Adjustment:
    """Adjust a survey.

    Parameters
    ----------
    survey : Survey
    device : "auto", "cpu" or "cuda"
    advance : callable
        Called with the increment; increments sum to 1.
    use_windows : bool
        Measure windows too, not matches alone.
    free_water : bool
        Find the water as if nothing were known of it.

    Raises
    ------
    SurveyError
        If the photographs do not match, or the adjustment does not converge.
    """
    gsd = make_plan(survey).gsd_m
    known = known_of(survey, gsd, free_water=free_water)
    sizes = [(view.lens.width, view.lens.height) for view in survey.views]
    marks_std = _MARKS_STD_PX if survey.control is None else survey.control.marks_std_px
    parts: list[tuple[int, TiePoints]] = []
    done: Adjusted | None = None
    lost: dict[str, Lost] = {}

    def settle(start: Known, seen: Observed) -> tuple[Adjusted, dict[str, Lost]]:
        if free_water:
            return adjust_free(survey, start, seen, sizes, marks_std)
        return adjust(start, seen, sizes, marks_std), {}

    if survey.ties is not None:
        keep = np.isin(survey.ties.point, thinned(survey.ties, sizes, _CELLS, _PER_CELL))
        matches = survey.ties.only(keep)
        parts.append((MATCH, dry_or_within_bounds(survey, matches) if free_water else matches))
        done, lost = settle(known, observed(parts, survey.control, survey, known))
        advance(0.3)
    if use_windows:
        moved = survey if done is None else _with_state(survey, known, done.solution.state)
        share = 0.6 if done is not None else 0.9
        windows = measure_windows(moved, device=device, advance=lambda part: advance(share * part))
        parts.append((WINDOW, within_bounds(survey, windows) if free_water else windows))
        start = known if done is None else _started(known, done)
        done, lost = settle(start, observed(parts, survey.control, survey, known))
        advance(0.1)
    assert done is not None
    total = sum(len(ties.view) for _, ties in parts) + (0 if survey.control is None else len(survey.control.marks))
    return _result(survey, done, total, lost if free_water else None)


def apply_adjustment(survey: Survey, found: Adjustment) -> Survey:
    """The survey with the poses, lenses and water that an adjustment found."""
    views = tuple(
        replace(view, camera=found.lenses[number].pinhole(centre, rotation), lens=found.lenses[number])
        for view, number, centre, rotation in zip(
            survey.views, found.lens_of, found.centres, found.rotations, strict=True
        )
    )
    survey = replace(survey, views=views, points=found.points, ties=None, is_adjusted=True)
    if found.water is None:
        return survey
    config = replace(survey.config, water=found.water)
    return replace(survey, config=config, water=water_plane(survey.frame, found.water))


def _started(known: Known, done: Adjusted) -> Known:
    """What was known, with the start where an adjustment ended, and the positions as good as it found them."""
    none = np.zeros((0, 3))
    std = np.concatenate([known.std[:WATER], done.known.std[WATER:]])
    return replace(known, state=replace(done.solution.state, points=none), std=std)


def _with_state(survey: Survey, known: Known, state: State) -> Survey:
    lenses = [_lens_of(lens, state.lenses[i]) for i, lens in enumerate(known.lenses)]
    views = tuple(
        replace(view, camera=lenses[number].pinhole(centre, rotation), lens=lenses[number])
        for view, number, centre, rotation in zip(
            survey.views, known.layout.lens_of, state.centres, state.rotations, strict=True
        )
    )
    return replace(survey, views=views, water=state.water, points=state.points, is_adjusted=True)


def _lens_of(lens: Lens, parameters: np.ndarray) -> Lens:
    """A lens with adjusted parameters (8,)."""
    if is_held(lens):
        return lens
    fx, fy = lens.focal
    f, cx, cy, k1, k2, k3, p1, p2 = parameters.tolist()
    return Lens("FULL_OPENCV", (f, f * fy / fx, cx, cy, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0), lens.width, lens.height)


def _result(survey: Survey, done: Adjusted, total: int, lost: dict[str, Lost] | None) -> Adjustment:
    known, solution, used = done.known, done.solution, done.used
    layout, state, covariance = known.layout, solution.state, solution.covariance
    parameters: list[Parameter] = []
    water: WaterConfig | None = None
    if survey.water is not None:
        verdicts, water = _water(survey, known, state, covariance, lost)
        parameters += verdicts
    for number, lens in enumerate(known.lenses):
        if not is_held(lens):
            at = layout.lens(number)
            std = np.sqrt(np.diag(covariance)[at])
            parameters += lens_verdicts(number, state.lenses[number], std, known.mean.lenses[number], known.std[at])
    poses = np.sqrt(np.diag(covariance)[layout.first_pose :]).reshape(-1, 6)
    # What a rough bed seems to rise by is no result.
    kept = np.r_[: len(WATER_NAMES), layout.first_lens : len(layout)]
    names = (
        *WATER_NAMES,
        *(f"camera{i}.{name}" for i in range(len(known.lenses)) for name in LENS_NAMES),
        *(f"{view.name}.{name}" for view in survey.views for name in _POSE_NAMES),
    )
    gps = known.std[layout.first_pose :].reshape(-1, 6)[:, :3]
    gps = gps[np.isfinite(gps).all(axis=1)]
    point = (0.0, 0.0) if state.water is None else state.water.point[:2]
    counts = {name: int((used.kind == kind).sum()) for kind, name in enumerate(KINDS)}
    blunders = [view.name for view, bad in zip(survey.views, done.blunders, strict=True) if bad]
    warnings = []
    if blunders:
        warnings.append(f"positions that the block contradicts are not used: {', '.join(blunders)}")
    return Adjustment(
        parameters=tuple(parameters),
        water=water,
        lenses=tuple(_lens_of(lens, state.lenses[i]) for i, lens in enumerate(known.lenses)),
        names=tuple(view.name for view in survey.views),
        lens_of=layout.lens_of,
        centres=state.centres,
        rotations=state.rotations,
        position_std=poses[:, :3],
        rotation_std_deg=np.degrees(poses[:, 3:]),
        covariance=covariance[np.ix_(kept, kept)],
        covariance_names=names,
        water_point=(float(point[0]), float(point[1])),
        std_px={name: float(solution.std_px[kind]) for kind, name in enumerate(KINDS) if counts[name]},
        factor={name: float(done.factor[kind]) for kind, name in enumerate(KINDS) if counts[name]},
        num_observations={name: count for name, count in counts.items() if count},
        num_points=len(used.ties),
        num_left_out=total - len(used.kind),
        gps_std_m=tuple(float(v) for v in np.median(gps, axis=0)) if len(gps) else None,
        control=_control(survey, used, solution, state),
        notes=(),
        warnings=tuple(warnings),
        residual_view=used.ties.view,
        residual_px=solution.residuals,
        residual_at_px=used.ties.pixel,
        residual_point=used.ties.point,
        points=state.points,
    )


def _water(
    survey: Survey, known: Known, state: State, covariance: np.ndarray, lost: dict[str, Lost] | None
) -> tuple[list[Parameter], WaterConfig]:
    """Level, slopes and index as survey.toml counts them, with their verdicts; `lost` of free water."""
    _, given = survey.require_water()
    assert state.water is not None
    by_local = settings_by_local(survey, np.array(state.water.point[:2]))
    values = settings_of(given) + by_local @ (state.water_parameters() - known.mean.water_parameters())
    of_config = by_local @ covariance[:WATER, :WATER] @ by_local.T
    given_std = np.sqrt(np.diag(by_local @ np.diag(known.std[:WATER] ** 2) @ by_local.T))
    if lost is not None:
        given_std = np.full(WATER, np.inf)
    found = water_verdicts(values, of_config, given, given_std, water_limits(state.points))
    for i, row in enumerate(found):
        if lost and row.name in lost:
            found[i] = lost_verdict(row.name, lost[row.name].std, row.given, lost[row.name].reason)
    return found, with_settings(given, np.array([row.value for row in found]))


def _control(survey: Survey, used: Observed, solution, state: State) -> tuple[ControlResidual, ...]:
    """How the block fits its control points."""
    if survey.control is None:
        return ()
    by_name = {point.name: point for point in survey.control.points}
    first = len(used.ties) - len(used.control)
    found = []
    for number, name in enumerate(used.control, start=first):
        mine = (used.ties.point == number) & (used.kind == MARK)
        point = state.points[number]
        wet = state.water is not None and float(state.water.depth(point[None])[0]) > 0.0
        east, north, up = (point - by_name[name].local).tolist()
        rms = float(np.sqrt(np.mean(np.square(solution.residuals[mine]))))
        found.append(ControlResidual(name, by_name[name].is_check, wet, (east, north, up), int(mine.sum()), rms))
    return tuple(found)
