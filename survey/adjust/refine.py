"""Poses, lens and water of a survey together, from its photographs, positions, control and readings.

matches of structure from motion (`Survey.ties`), where there are any -> a first adjustment, which removes the bending;
poses of a file that are too far off for windows get such matches first (`survey.adjust.starts`)
windows matched to a fraction of a pixel on the adjusted block (`survey.adjust.block.windows`) -> the final adjustment
windows matched under poses before an adjustment, over waves: again on the adjusted block
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from threadpoolctl import threadpool_limits

from survey.adjust import observability, parameter_tests
from survey.adjust.applied import at_state
from survey.adjust.assembling import assemble_result
from survey.adjust.block.bundle import NotConvergedError
from survey.adjust.block.control_check import control_contradiction, has_unchecked_control
from survey.adjust.block.observed import CELLS, KINDS, MATCH, PER_CELL, WINDOW, Observed, observed, sizes_of, thinned
from survey.adjust.block.on_ground import ground_fit, shift_onto
from survey.adjust.block.priors import PriorKnowledge, SharedShift, prior_of
from survey.adjust.block.state import NUM_WATER, WATER_PARAMETERS
from survey.adjust.block.windows import RADIUS, measure_windows
from survey.adjust.clusters import shared_variance
from survey.adjust.common_height import apply_level_datum, drop_common_height, height_warnings, water_start, with_common
from survey.adjust.focal_lengths import FocalDrift, with_focal_std, with_focals, with_square_pixels
from survey.adjust.result.adjustment import MOST_SIGMAS, MOST_SIGMAS_OF_FOUR, MOST_STD_LEVEL_M, Adjustment, Status
from survey.adjust.result.parts import parts_warning
from survey.adjust.rounds import RobustSolution, adjust
from survey.adjust.starts import PoseRecovery, better_of_two_starts, windows_or_recovered_poses
from survey.control.points import StableGround
from survey.errors import GivenValueTest, SurveyError
from survey.folder.pose_priors import GPS_STD_M
from survey.folder.survey import Survey
from survey.photos.poses import TiePoints
from survey.plan.check import DOWN_DEG, GIVE_LEVEL, tilts_deg
from survey.plan.choices import gsd_m, image_scale_of

# Of the time of an adjustment, about: of matches, of windows, and of all.
_SHARES = (0.3, 0.4, 0.3)
# Windows under water that scatter by more [px], and share more of it with those beside them, were displaced by waves:
# measured under poses before the adjustment, they bend the block (docs/decisions.md).
_WAVES_PX = (0.1, 0.04)
# Windows are measured up to four times as well as matches, and are as many.
_MOST_GAIN = 6.0
# Of the shift onto the ground before the adjustment.
_START_STD_M = 0.1


# Threads of BLAS wait for each other longer than they compute on matrices as small as those of the adjustment.
@threadpool_limits.wrap(limits=1, user_api="blas")
def adjust_survey(
    survey: Survey,
    *,
    device: str = "auto",
    advance: Callable[[float], None] = lambda _share: None,
    use_windows: bool = True,
    free_water: bool = False,
    search: PoseRecovery | None = None,
    measure: Callable[..., TiePoints] | None = None,
) -> Adjustment:
    """Adjust a survey, by windows too, not by matches alone; free water is found as if nothing were known of it.

    ``advance`` is called with increments that sum to 1. ``search`` estimates poses of a file again that are too
    inaccurate for windows; without it they are refused. ``measure`` is called in place of `measure_windows`.
    """
    measure = partial(measure or measure_windows, device=device)
    survey, note = with_square_pixels(survey)
    prior = prior_of(survey, gsd_m(survey), free_water=free_water)

    def from_start(other: Survey, start: PriorKnowledge, windows: TiePoints | None, *, silent: bool) -> Adjustment:
        staged = StagedAdjustment(other, start, free_water)
        return _adjust_in_stages(staged, windows, measure, (lambda _share: None) if silent else advance, use_windows)

    if survey.observations.ties is not None or not use_windows:
        with observability.name_open_roll(prior.rolls):
            first = from_start(survey, prior, None, silent=False)
            again = partial(from_start, windows=None, silent=True)
            found = better_of_two_starts(survey, prior, first, again)
    else:
        at_start = partial(measure, survey, advance=lambda part: advance(0.9 * part))
        windows = windows_or_recovered_poses(survey, at_start, search)
        if isinstance(windows, TiePoints):
            found = from_start(survey, prior, windows, silent=False)
        else:
            matched = replace(survey, observations=replace(survey.observations, ties=windows.ties))
            prior = windows.start(prior_of(matched, gsd_m(matched), free_water=free_water))
            found = from_start(matched, prior, None, silent=True)
            found = replace(found, warnings=(windows.warning, *found.warnings))
    return found if note is None else replace(found, notes=(note, *found.notes))


def _adjust_in_stages(
    staged: StagedAdjustment,
    windows: TiePoints | None,
    measure: Callable[..., TiePoints],
    advance: Callable[[float], None],
    use_windows: bool,
) -> Adjustment:
    """Adjust with matches, with windows, and without contradicted values; ``windows`` where they are measured."""
    survey, free_water = staged.survey, staged.free_water
    done: RobustSolution | None = None
    shares = (0.0, 0.9, 0.1)
    if survey.observations.ties is not None:
        shares = _SHARES if use_windows else (1.0, 0.0, 0.0)
        ties = survey.observations.ties
        done = staged.first_ties(MATCH, observability.dry_or_within_bounds(survey, ties) if free_water else ties)
        if use_windows and not survey.provenance.is_level_known and not free_water:
            std = float(observability.water_std(survey, done)[0])
            # Windows cannot tell it either.
            if not std <= _MOST_GAIN * MOST_STD_LEVEL_M:
                raise _level_error(survey, std)
        advance(shares[0])
    if use_windows:
        if windows is None:
            windows = _windows_at(survey, done, measure, lambda part: advance(shares[1] * part))
        while True:
            before, windows = done, observability.within_bounds(survey, windows) if free_water else windows
            if done is None:
                done = staged.first_ties(WINDOW, windows)
            else:
                done = staged.with_ties(WINDOW, windows, restarted(staged.prior, done))
            if before is not None or not _show_waves(survey, done):
                break
            windows = _windows_at(survey, done, measure, lambda _share: None)
        advance(shares[2])
    assert done is not None
    contradictions: list[GivenValueTest] = []
    drift: FocalDrift | None = None
    notes: list[str] = []
    if not free_water:
        done, drift = staged.with_focals(done)
        done, contradictions = staged.without_contradictions(done)
        notes = observability.roll_notes(survey, done, gsd_m(survey))
    water = None if survey.water is not None else parameter_tests.unnamed_water_warning(done)
    found = staged.result(done, contradictions)
    if not survey.provenance.is_level_known and found.parameter("level_m").status == Status.UNKNOWN:
        raise _level_error(survey, found.parameter("level_m").std)
    warnings = [*(_contradiction_text(found, each) for each in contradictions), *height_warnings(survey, done)]
    warnings += parts_warning(found, survey.water) + [str(each) for each in (water, drift) if each is not None]
    if not free_water:
        warnings += staged.against_control()
    contradiction = survey.provenance.contradiction
    if contradiction is not None and contradiction.is_of_lens:
        warnings.append(f"{contradiction}: the lens is estimated again under the given poses; correct it")
    return replace(found, notes=(*found.notes, *notes), warnings=(*found.warnings, *warnings))


def _show_waves(survey: Survey, done: RobustSolution) -> bool:
    """Whether windows under water scatter as over waves: by more than noise, and as those beside them do."""
    kind, residuals = done.problem.kind, done.solution.residuals
    wet = (kind >= len(KINDS)) & (kind % len(KINDS) == WINDOW)
    scatter, shared = _WAVES_PX
    if not wet.any() or np.mean(done.problem.given_std_px[kind[wet]] ** 2) <= scatter**2:
        return False
    window_px = (2 * RADIUS + 1) / image_scale_of(survey)
    return shared_variance(done.problem.ties, residuals, wet, window_px) > shared**2


def _level_error(survey: Survey, std: float) -> SurveyError:
    tilts = tilts_deg(np.array([view.camera.cam_from_local for view in survey.views]))
    down = int((tilts <= DOWN_DEG).sum())
    kept = "" if survey.config.cameras.poses is not None else ". The poses that were found are kept for the next run"
    return SurveyError(
        f"the level of the water is not given, and the photographs do not determine it ({down} of {len(tilts)} look "
        f"straight down): one sigma is {std:.2g} m, and at most {MOST_STD_LEVEL_M:g} m would be of use; "
        f"{GIVE_LEVEL}{kept}"
    )


def _windows_at(
    survey: Survey, done: RobustSolution | None, measure: Callable[..., TiePoints], advance: Callable[[float], None]
) -> TiePoints:
    """Windows measured on an adjusted block, or on the survey as given where there is none."""
    if done is None:
        return measure(survey, advance=advance)
    placed, common = apply_level_datum(done)
    windows = measure(at_state(survey, done.prior, placed.solution.state), advance=advance)
    up = np.array([0.0, 0.0, 0.0 if common is None else common.error])
    return replace(windows, start=windows.start + up)


def _contradiction_text(found: Adjustment, each: GivenValueTest) -> str:
    """A contradiction in words, with both numbers."""
    row, unit, digits = found.parameter(each.name), *((" m", 3) if each.name == parameter_tests.LEVEL_NAME else ("", 4))
    return (
        f"{row.name} is given as {row.given:.{digits}f} +- {each.given_std:.2g}{unit}, and the photographs say "
        f"{row.value:.{digits}f} +- {row.std:.2g}{unit}: the two contradict each other by more than "
        f"{MOST_SIGMAS_OF_FOUR:.1f} standard deviations; what the photographs say is used. Correct the value, its "
        "vertical datum, or its standard deviation"
    )


class StagedAdjustment:
    """Adjustment of a survey in stages: observations are added, and all of them adjusted again.

    `prior` is that of the next stage: `first_ties` and `with_focals` replace it by what their stage has shown.
    ``free_water``: nothing counts as known of the water.
    """

    def __init__(self, survey: Survey, prior: PriorKnowledge, free_water: bool):
        self.survey, self.prior, self.free_water = survey, prior, free_water
        self._parts: dict[int, TiePoints] = {}
        self._unobservable: dict[str, observability.Unobservable] = {}
        self._is_against_positions = False

    def first_ties(self, kind: int, ties: TiePoints) -> RobustSolution:
        """Adjust with the first tie points, which place the block on ground or water if these tell its height."""
        start, ground = self.prior, self.survey.observations.ground
        self._parts = {kind: self._thinned(ties)}
        if ground is not None:
            start = self._onto_ground(ground)
        elif start.shifts:
            # As high as stated positions have it: others have moved structure from motion too.
            stated = np.isfinite(start.pose_std[:, :3]).all(axis=1) & ~start.unknown_positions
            shift = np.median((start.mean.centres - start.state.centres)[stated], axis=0)
            start = replace(start, state=replace(start.state, centres=start.state.centres + shift))
            self._shift(shift)
        if start.common_up_std > 0.0:
            return self._at_level()
        done = self._adjust(start)
        if self.survey.provenance.is_level_known and not self.free_water:
            level = parameter_tests.check_dry_block(self.survey, start, self._observed(), done)
            if level is not None:
                raise parameter_tests.dry_bed_error(level, "leave out [water] if the bed is dry")
        return done

    def with_ties(self, kind: int, ties: TiePoints, start: PriorKnowledge) -> RobustSolution:
        """Adjust with tie points in place of those of their kind, beside others."""
        self._parts[kind] = self._thinned(ties)
        return self._adjust(start)

    def _thinned(self, ties: TiePoints) -> TiePoints:
        return ties.only(np.isin(ties.point, thinned(ties, sizes_of(self.survey), CELLS, PER_CELL)))

    def _shift(self, by: np.ndarray) -> None:
        self._parts = {kind: replace(ties, start=ties.start + by) for kind, ties in self._parts.items()}

    def _observed(self) -> Observed:
        """Tie points with control and ground."""
        return observed([*self._parts.items()], self.survey.observations.control, self.survey, self.prior)

    def _adjust(self, start: PriorKnowledge) -> RobustSolution:
        if not self.free_water:
            return adjust(start, self._observed())
        done, self._unobservable = observability.adjust_free(self.survey, start, self._observed())
        return done

    def _onto_ground(self, ground: StableGround) -> PriorKnowledge:
        """Shift block and tie points onto the ground, after an adjustment without it; positions too, where it shows.

        Positions of unknown accuracy may share an error of metres, those of a stated one an error as large as that,
        unless the ground contradicts it: the prior of later stages says so.
        """
        unknown, (ties,) = self.prior.unknown_positions, self._parts.values()
        stated = self.prior.pose_std[~unknown, :3]
        stated = stated[np.isfinite(stated).all(axis=1)]
        are_stated = len(stated) > 0 and not unknown.any()
        shared = np.median(stated, axis=0) if are_stated else np.full(3, GPS_STD_M)
        every = np.ones(len(unknown), dtype=bool)
        self.prior = prior = replace(self.prior, shifts=(SharedShift(every, shared),))
        try:
            done = adjust(prior, replace(self._observed(), ground=None))
            state, points = done.solution.state.without_points(), done.solution.state.points
            points = points[: len(done.used.ties) - len(done.used.control)]
        except NotConvergedError:
            state, points = prior.state, ties.start
        shift = shift_onto(ground, points)
        off = np.median(state.centres - prior.mean.centres, axis=0) + shift
        horizontal, vertical = ground.std_m
        of_both = np.sqrt(shared**2 + np.square([horizontal, horizontal, vertical]) + _START_STD_M**2)
        self._is_against_positions = are_stated and bool((np.abs(off) > MOST_SIGMAS * of_both).any())
        if not are_stated or self._is_against_positions:
            shifts = (SharedShift(every, np.maximum(shared, GPS_STD_M)),)
            self.prior = replace(prior, mean=replace(prior.mean, centres=prior.mean.centres + off), shifts=shifts)
        self._shift(shift)
        return replace(self.prior, state=replace(state, centres=state.centres + shift))

    def _at_level(self) -> RobustSolution:
        """Adjust a block whose height the level of the water determines, or else the positions, as later stages do."""
        start, points = water_start(self.prior, self._observed())
        # Without those of check points, which come last.
        self._parts = {kind: replace(ties, start=points[: len(ties)]) for kind, ties in self._parts.items()}
        done = adjust(start, self._observed())
        are_stated = any(each.position_std is not None for each in self.survey.observations.priors.values())
        held = None if are_stated else drop_common_height(self.prior, done)
        if held is None:
            return done
        self.prior = replace(held, state=self.prior.state)
        return adjust(held, self._observed())

    def with_focals(self, done: RobustSolution) -> tuple[RobustSolution, FocalDrift | None]:
        """Adjust with a focal length for each photograph, where they differ."""
        if self.survey.observations.ground is not None:
            return done, None
        seen = self._observed()
        done, drift = with_focals(self.prior, done, lambda start: adjust(start, seen))
        if drift is not None:
            self.prior = with_focal_std(self.prior, done, drift.std)
        return done, drift

    def without_contradictions(self, done: RobustSolution) -> tuple[RobustSolution, list[GivenValueTest]]:
        """Adjust with contradicted parameters of the water free, the worst first; also returns the contradictions."""
        contradictions: list[GivenValueTest] = []
        # A sample under the given poses may test with more power than a block with free poses.
        of_sample = self.survey.provenance.contradiction
        is_of_water = of_sample is not None and not of_sample.is_of_lens
        each = of_sample if is_of_water else parameter_tests.worst_contradiction(self.survey, done)
        while each is not None and len(contradictions) < NUM_WATER:
            contradictions.append(each)
            done = self._adjust(parameter_tests.release(restarted(done.prior, done), each))
            each = parameter_tests.worst_contradiction(self.survey, done)
        return done, contradictions

    def against_control(self) -> list[str]:
        """A warning where positions and water contradict control that is too little to check itself."""
        control = self.survey.observations.control
        if control is None or not has_unchecked_control(self.survey):
            return []
        alone = replace(self.survey, observations=replace(self.survey.observations, control=None, ground=None))
        prior = prior_of(alone, gsd_m(alone))
        # A block with an undetermined roll cannot test control.
        if prior.rolls:
            return []
        kind, ties = next(iter(self._parts.items()))
        try:
            free = apply_level_datum(StagedAdjustment(alone, prior, free_water=False).first_ties(kind, ties))[0]
        except NotConvergedError:
            return []
        warning = control_contradiction(control, self.survey.views, free.prior, free.solution)
        return [] if warning is None else [warning]

    def result(self, done: RobustSolution, contradictions: Sequence[GivenValueTest]) -> Adjustment:
        """The adjustment in the terms of the survey."""
        control = self.survey.observations.control
        total = sum(len(ties.view) for ties in self._parts.values()) + (0 if control is None else len(control.marks))
        if self.free_water:
            return self._on_ground(assemble_result(self.survey, done, total, unobservable=self._unobservable), done)
        placed, common = apply_level_datum(done)

        def hold(held: np.ndarray) -> RobustSolution:
            return apply_level_datum(observability.adjusted_with(done, held, self.prior.std))[0]

        used = {WATER_PARAMETERS.index(each.name) for each in contradictions} | (
            set() if common is None else {parameter_tests.LEVEL}
        )
        found = self._on_ground(assemble_result(self.survey, placed, total, contradicted=sorted(used), hold=hold), done)
        return found if common is None else with_common(found, common, placed.solution.state.water)

    def _on_ground(self, found: Adjustment, done: RobustSolution) -> Adjustment:
        """The result with how the block lies on the ground of an earlier survey, where there is one."""
        if done.on_ground is None:
            return found
        fit = ground_fit(
            done.on_ground,
            done.problem,
            done.solution,
            self.survey.views,
            str(self.survey.config.control.reference),
            is_against_positions=self._is_against_positions,
        )
        return replace(found, ground=fit, notes=(*found.notes, *fit.notes), warnings=(*found.warnings, *fit.warnings))


def restarted(prior: PriorKnowledge, done: RobustSolution) -> PriorKnowledge:
    """Priors that start from an adjusted state, with the std of positions that the adjustment estimated."""
    std = np.concatenate([prior.std[:NUM_WATER], done.prior.std[NUM_WATER:]])
    return replace(prior, state=done.solution.state.without_points(), std=std)
