"""Poses, lens and water of a survey together, from its photographs, positions, control and readings.

matches of structure from motion (`Survey.ties`), where there are any -> a first adjustment, that takes the bend out;
poses of a file that are too far off for windows get such matches first (`survey.adjust.far_poses`)
windows matched to a fraction of a pixel on the adjusted block (`survey.adjust.windows`) -> the final adjustment
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from refract.lens import Lens
from survey.adjust.adjustment import UNKNOWN, Adjustment
from survey.adjust.assembling import lens_with, result
from survey.adjust.contradiction import Contradiction, released, worst_contradiction
from survey.adjust.far_poses import Search, windows_or_search
from survey.adjust.free_water import Lost, adjust_free, dry_or_within_bounds, within_bounds
from survey.adjust.holding import adjusted_with
from survey.adjust.observed import MATCH, WINDOW, Observed, observed
from survey.adjust.priors import Known, known_of
from survey.adjust.rounds import Adjusted, adjust
from survey.adjust.state import WATER, Layout, State
from survey.adjust.thinning import CELLS, PER_CELL, thinned
from survey.adjust.water_settings import WATER_PARAMETERS
from survey.adjust.windows_of_survey import measure_windows
from survey.errors import SurveyError
from survey.folder.place import water_plane
from survey.folder.survey import Survey, View
from survey.folder.tides import with_shift
from survey.photos.tie_points import TiePoints
from survey.plan.plan import make_plan

_MARKS_STD_PX = 0.5


def adjust_survey(
    survey: Survey,
    *,
    device: str = "auto",
    advance: Callable[[float], None] = lambda _share: None,
    use_windows: bool = True,
    free_water: bool = False,
    search: Search | None = None,
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
    search : callable, optional
        Finds poses of a file anew that are too far off for windows; without it they are refused.

    Raises
    ------
    SurveyError
        If the photographs do not match, or the adjustment does not converge.
    """
    known = known_of(survey, make_plan(survey).gsd_m, free_water=free_water)
    if survey.ties is not None or not use_windows:
        return _adjusted(survey, known, None, device, advance, use_windows=use_windows, free_water=free_water)
    windows = windows_or_search(
        survey, lambda: measure_windows(survey, device=device, advance=lambda part: advance(0.9 * part)), search
    )
    if isinstance(windows, TiePoints):
        return _adjusted(survey, known, windows, device, advance, free_water=free_water)
    survey = replace(survey, ties=windows.ties)
    known = windows.start(known_of(survey, make_plan(survey).gsd_m, free_water=free_water))
    found = _adjusted(survey, known, None, device, lambda _share: None, free_water=free_water)
    return replace(found, warnings=(windows.warning, *found.warnings))


def _adjusted(
    survey: Survey,
    known: Known,
    windows: TiePoints | None,
    device: str,
    advance: Callable[[float], None],
    *,
    use_windows: bool = True,
    free_water: bool = False,
) -> Adjustment:
    """See `adjust_survey`; with the windows, where they were measured already."""
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
        matches = dry_or_within_bounds(survey, survey.ties) if free_water else survey.ties
        parts.append((MATCH, _thinned(matches, sizes)))
        done, lost = settle(known, observed(parts, survey.control, survey, known))
        advance(0.3)
    if use_windows:
        if windows is None:
            moved = survey if done is None else _with_state(survey, known, done.solution.state)
            windows = measure_windows(moved, device=device, advance=lambda part: advance(0.6 * part))
        parts.append((WINDOW, _thinned(within_bounds(survey, windows) if free_water else windows, sizes)))
        start = known if done is None else _started(known, done)
        done, lost = settle(start, observed(parts, survey.control, survey, known))
        advance(0.1)
    assert done is not None
    against: list[Contradiction] = []
    while not free_water and len(against) < WATER:
        each = (_doubted(survey) if not against else None) or worst_contradiction(done)
        if each is None:
            break
        against.append(each)
        start = released(_started(done.known, done), each)
        done = adjust(start, observed(parts, survey.control, survey, known), sizes, marks_std)
    total = sum(len(ties.view) for _, ties in parts) + (0 if survey.control is None else len(survey.control.marks))
    if free_water:
        found = result(survey, done, total, lost=lost)
    else:
        numbers = [each.number for each in against]
        found = result(
            survey,
            done,
            total,
            contradicted=numbers,
            hold=lambda held: adjusted_with(done, held, known.std, sizes, marks_std),
        )
    if not survey.is_level_known and found.parameter("level_m").status == UNKNOWN:
        raise SurveyError(
            f"the level of the water is not given, and the photographs do not tell it: "
            f"{found.parameter('level_m').verdict}; give [water] level_m"
        )
    warnings = [_against(found, each) for each in against]
    if survey.doubt is not None and survey.doubt.is_of_lens:
        warnings.append(f"{survey.doubt}: the lens is found anew, under the poses that were given with it; correct it")
    return replace(found, warnings=(*found.warnings, *warnings))


def _doubted(survey: Survey) -> Contradiction | None:
    """What a sample contradicted under the given poses; once poses are free, the block may tell it less surely."""
    doubt = survey.doubt
    if doubt is None or doubt.is_of_lens:
        return None
    number = WATER_PARAMETERS.index(doubt.name)
    return Contradiction(number, doubt.found - doubt.given, doubt.std, doubt.given_std)


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
    return ties.only(np.isin(ties.point, thinned(ties, sizes, CELLS, PER_CELL)))


def apply_adjustment(survey: Survey, found: Adjustment) -> Survey:
    """The survey with the poses, lenses and water that an adjustment found."""
    views = _views(survey, found.lenses, found.layout, found.centres, found.rotations, found.readouts_s, found.tides)
    survey = replace(survey, views=views, points=found.points, ties=None, is_adjusted=True)
    if found.hours is not None and survey.tide is not None and found.water is not None:
        over = {view.name: view.camera.tide for view in views}
        survey = replace(survey, tide=with_shift(replace(survey.tide, over=over), views, survey.require_water()[0]))
    if found.layout.finds_readouts and found.readouts_s is not None and len(found.readouts_s) == 1:
        readout = max(found.readouts_s[0], 0.0)
        cameras = replace(survey.config.cameras, rolling_shutter_s=readout, rolling_shutter_std_s=None)
        survey = replace(survey, config=replace(survey.config, cameras=cameras))
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
    lenses = [lens_with(lens, state.lenses[i]) for i, lens in enumerate(known.lenses)]
    views = _views(
        survey, lenses, known.layout, state.centres, state.rotations, state.readouts, state.tides(known.layout)
    )
    return replace(survey, views=views, water=state.water, points=state.points, is_adjusted=True)


def _views(
    survey: Survey,
    lenses: Sequence[Lens],
    layout: Layout,
    centres: np.ndarray,
    rotations: np.ndarray,
    readouts,
    tides: np.ndarray | None,
) -> tuple[View, ...]:
    """The views with other lenses, poses, readouts of their shutters (L,) [s], and tides (V,) [m]."""
    views = []
    for number, view in enumerate(survey.views):
        lens = lenses[layout.lens_of[number]]
        tide = 0.0 if tides is None else float(tides[number])
        camera = replace(lens.camera(centres[number], rotations[number]), tide=tide)
        if layout.flow is not None and layout.flow[number].any():
            camera = replace(camera, motion=layout.flow[number] * readouts[layout.lens_of[number]])
        views.append(replace(view, camera=camera, lens=lens))
    return tuple(views)
