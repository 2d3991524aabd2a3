"""Poses, lens and water of a survey together, from its photographs, positions, control and readings.

matches of structure from motion (`Survey.ties`), where there are any -> a first adjustment, that takes the bend out
windows matched to a fraction of a pixel on the adjusted block (`survey.adjust.windows`) -> the final adjustment
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from refract.lens import Lens
from survey.adjust.adjustment import UNKNOWN, Adjustment, ControlResidual, Parameter
from survey.adjust.contradiction import Contradiction, contradictions, released
from survey.adjust.holding import adjusted_with, not_observable
from survey.adjust.observed import KINDS, MARK, MATCH, WINDOW, Observed, observed
from survey.adjust.priors import Known, is_held, known_of
from survey.adjust.rounds import Adjusted, adjust
from survey.adjust.state import LENS_NAMES, WATER, WATER_NAMES, State
from survey.adjust.thinning import thinned
from survey.adjust.verdicts import WATER_PARAMETERS, lens_verdicts, water_limits, water_verdicts
from survey.adjust.windows_of_survey import measure_windows
from survey.errors import SurveyError
from survey.folder.config import WaterConfig
from survey.folder.place import water_plane
from survey.folder.survey import Survey
from survey.photos.tie_points import TiePoints
from survey.plan.plan import make_plan

# Matches and windows are thinned to this many in each of so many cells along a photograph.
_CELLS, _PER_CELL = 8, 3
_POSE_NAMES = ("x", "y", "z", "turn_x", "turn_y", "turn_z")
_MARKS_STD_PX = 0.5
# Three determine a pose; as many again tell whether they are right.
_FEW_MATCHES = 6


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
    if survey.ties is not None:
        parts.append((MATCH, _thinned(survey.ties, sizes)))
        done = adjust(known, observed(parts, survey.control, survey, known), sizes, marks_std)
        advance(0.3)
    if use_windows:
        moved = survey if done is None else _with_state(survey, known, done.solution.state)
        share = 0.6 if done is not None else 0.9
        windows = measure_windows(moved, device=device, advance=lambda part: advance(share * part))
        parts.append((WINDOW, _thinned(windows, sizes)))
        start = known if done is None else _started(known, done)
        done = adjust(start, observed(parts, survey.control, survey, known), sizes, marks_std)
        advance(0.1)
    assert done is not None
    against = contradictions(done)
    if against:
        start = released(_started(done.known, done), against)
        done = adjust(start, observed(parts, survey.control, survey, known), sizes, marks_std)
    total = sum(len(ties.view) for _, ties in parts) + (0 if survey.control is None else len(survey.control.marks))
    stated = known if not free_water else known_of(survey, gsd)
    found = _result(survey, done, total, lambda held: adjusted_with(done, held, stated.std, sizes, marks_std))
    if not survey.is_level_known and found.parameter("level_m").status == UNKNOWN:
        raise SurveyError(
            f"the level of the water is not given, and the photographs do not tell it: "
            f"{found.parameter('level_m').verdict}; give [water] level_m"
        )
    return replace(found, warnings=found.warnings + tuple(_against(found, each) for each in against))


def _against(found: Adjustment, each: Contradiction) -> str:
    """A contradiction in words, with both numbers."""
    row, unit = found.parameter(WATER_PARAMETERS[each.number]), " m" if each.number == 0 else ""
    digits = 3 if each.number == 0 else 4
    return (
        f"{row.name} is given as {row.given:.{digits}f} +- {each.given_std:.2g}{unit}, and the photographs say "
        f"{row.value:.{digits}f} +- {row.std:.2g}{unit}: the two contradict each other by more than three standard "
        "deviations; what the photographs say is used. Correct the value, its vertical datum, or its standard deviation"
    )


def _thinned(ties: TiePoints, sizes: list[tuple[int, int]]) -> TiePoints:
    return ties.only(np.isin(ties.point, thinned(ties, sizes, _CELLS, _PER_CELL)))


def apply_adjustment(survey: Survey, found: Adjustment) -> Survey:
    """The survey with the poses, lenses and water that an adjustment found."""
    views = tuple(
        replace(view, camera=found.lenses[number].camera(centre, rotation), lens=found.lenses[number])
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
    return replace(known, state=replace(done.solution.state, points=none), std=done.known.std)


def _with_state(survey: Survey, known: Known, state: State) -> Survey:
    lenses = [_lens_of(lens, state.lenses[i]) for i, lens in enumerate(known.lenses)]
    views = tuple(
        replace(view, camera=lenses[number].camera(centre, rotation), lens=lenses[number])
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


def _result(survey: Survey, done: Adjusted, total: int, hold: Callable[[np.ndarray], Adjusted]) -> Adjustment:
    """What was found; ``hold`` adjusts again with the parameters (P,) bool held that are not observable."""
    layout, first = done.known.layout, done.solution.covariance
    held = np.zeros(len(layout), dtype=bool)
    while True:
        parameters, water = _judged(survey, done, first, held)
        also = held | not_observable(parameters, layout)
        if (also == held).all():
            break
        held, done = also, hold(also)
    known, solution, used = done.known, done.solution, done.used
    state, covariance = solution.state, solution.covariance
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
    gps = np.median(gps, axis=0) if len(gps) else gps[:0, 0]
    counts = {name: int((used.kind == kind).sum()) for kind, name in enumerate(KINDS)}
    blunders = [view.name for view, bad in zip(survey.views, done.blunders, strict=True) if bad]
    warnings = []
    if blunders:
        warnings.append(f"positions that the block contradicts are not used: {', '.join(blunders)}")
    matches = np.bincount(used.ties.view, minlength=len(survey.views))
    loose = [view.name for view, count in zip(survey.views, matches, strict=True) if count < _FEW_MATCHES]
    if loose:
        warnings.append(
            f"with fewer than {_FEW_MATCHES} matches, poses stay about as they came: {', '.join(loose)}; leave these "
            "photographs out"
        )
    return Adjustment(
        parameters=parameters,
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
        water_point=known.place_of_water,
        std_px={name: float(solution.std_px[kind]) for kind, name in enumerate(KINDS) if counts[name]},
        factor={name: float(done.factor[kind]) for kind, name in enumerate(KINDS) if counts[name]},
        num_observations={name: count for name, count in counts.items() if count},
        num_points=len(used.ties),
        num_left_out=total - len(used.kind),
        gps_std_m=None if not len(gps) else (float(gps[0]), float(gps[1]), float(gps[2])),
        control=_control(survey, used, solution, state),
        notes=(),
        warnings=tuple(warnings),
        residual_view=used.ties.view,
        residual_px=solution.residuals,
        residual_at_px=used.ties.pixel,
        residual_point=used.ties.point,
        points=state.points,
    )


def _judged(
    survey: Survey, done: Adjusted, first: np.ndarray, held: np.ndarray
) -> tuple[tuple[Parameter, ...], WaterConfig | None]:
    """Parameters of water and lenses with their verdicts, and the water; ``first`` tells of those that are held."""
    known, state, covariance = done.known, done.solution.state, done.solution.covariance
    parameters: list[Parameter] = []
    water: WaterConfig | None = None
    if survey.water is not None:
        verdicts, water = _water(survey, known, state, (covariance, first), held[:WATER])
        parameters += verdicts
    variance = np.where(held, np.diag(first), np.diag(covariance))
    for number, lens in enumerate(known.lenses):
        if not is_held(lens):
            at = known.layout.lens(number)
            std = np.sqrt(variance[at])
            parameters += lens_verdicts(number, state.lenses[number], std, known.mean.lenses[number], known.std[at])
    return tuple(parameters), water


def _water(
    survey: Survey, known: Known, state: State, covariances: tuple[np.ndarray, np.ndarray], held: np.ndarray
) -> tuple[list[Parameter], WaterConfig]:
    """Level, slopes and index as survey.toml counts them, with verdicts; the second covariance tells of the held."""
    _, given = survey.require_water()
    before = np.array([float(getattr(given, name)) for name in WATER_PARAMETERS])
    start = known.mean.water_parameters()
    by_given = _by_config(survey, given, start, np.array(known.place_of_water))
    inverse = np.linalg.inv(by_given)
    values = before + inverse @ (state.water_parameters() - start)
    std, held_std = (np.sqrt(np.diag(inverse @ c[:WATER, :WATER] @ inverse.T)) for c in covariances)
    given_std = np.sqrt(np.diag(inverse @ np.diag(known.std[:WATER] ** 2) @ inverse.T))
    found = water_verdicts(values, np.where(held, held_std, std), given, given_std, water_limits(state.points))
    level, east, north, index = (row.value for row in found)
    return found, replace(given, level_m=level, slope_east=east, slope_north=north, refractive_index=index)


def _by_config(survey: Survey, given: WaterConfig, start: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Derivative (4, 4) of height at a place, slopes and index in local by the settings; the relation is linear."""
    columns = []
    for name, step in zip(WATER_PARAMETERS, (1e-3, 1e-6, 1e-6, 1e-6), strict=True):
        plane = water_plane(survey.frame, replace(given, **{name: getattr(given, name) + step}))
        moved = [float(plane.height(*place)), plane.slope_x, plane.slope_y, plane.n_water]
        columns.append((np.array(moved) - start) / step)
    return np.stack(columns, axis=-1)


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
