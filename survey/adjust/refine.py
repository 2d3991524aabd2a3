"""Poses, lens and water of a survey together, from its photographs, positions, control and readings.

matches of structure from motion (`Survey.ties`), where there are any -> a first adjustment, which removes the bending;
poses of a file that are too far off for windows get such matches first (`survey.adjust.starts`)
windows matched to a fraction of a pixel on the adjusted block (`survey.adjust.block.windows`) -> the final adjustment
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from survey import machine
from survey.adjust.applied import at_state
from survey.adjust.assembling import assemble_result
from survey.adjust.block.bundle import NotConvergedError
from survey.adjust.block.control_check import contradicted_points, contradiction_warning, has_unchecked_control
from survey.adjust.block.observed import CELLS, MATCH, PER_CELL, WINDOW, Observed, observed, sizes_of, thinned
from survey.adjust.block.on_ground import moved_by, shift_onto
from survey.adjust.block.priors import PriorKnowledge, prior_of
from survey.adjust.block.state import POSE, WATER, WATER_PARAMETERS
from survey.adjust.block.windows import measure_windows
from survey.adjust.common_height import apply_level_datum, drop_common_height, height_warnings, water_start, with_common
from survey.adjust.focal_lengths import FocalDrift, with_focal_std, with_focals, with_square_pixels
from survey.adjust.given_values import LEVEL, LEVEL_NAME, check_dry_block, dry_bed_error, release, worst_contradiction
from survey.adjust.observability import (
    Unobservable,
    adjust_free,
    adjusted_with,
    dry_or_within_bounds,
    name_open_roll,
    roll_notes,
    water_std,
    within_bounds,
)
from survey.adjust.result.adjustment import MOST_SIGMAS, MOST_SIGMAS_OF_FOUR, MOST_STD_LEVEL_M, UNKNOWN, Adjustment
from survey.adjust.result.ground_fit import ground_fit
from survey.adjust.result.std_of_block import parts_warning
from survey.adjust.rounds import Adjusted, adjust
from survey.adjust.starts import PoseRecovery, better_of_two_starts, windows_or_recovered_poses
from survey.adjust.unnamed_water import find_unnamed_water
from survey.control.points import StableGround
from survey.errors import GivenValueTest, SurveyError
from survey.folder.pose_priors import GPS_STD_M
from survey.folder.survey import Survey
from survey.photos.poses import TiePoints
from survey.plan.check_inputs import DOWN_DEG, GIVE_LEVEL, tilts_deg
from survey.plan.choices import Choices
from survey.plan.plan import make_plan
from survey.plan.rates import adjustment_s
from survey.plan.workload import amounts_of_run

# Windows are measured up to four times as well as matches, and are as many.
_MOST_GAIN = 6.0
# Of the shift onto the ground before the adjustment.
_START_STD_M = 0.1


def adjust_survey(
    survey: Survey,
    *,
    device: str = "auto",
    advance: Callable[[float], None] = lambda _share: None,
    use_windows: bool = True,
    free_water: bool = False,
    search: PoseRecovery | None = None,
) -> Adjustment:
    """Adjust a survey.

    Parameters
    ----------
    device : "auto", "cpu" or "cuda"
    advance : callable
        Called with the increment; increments sum to 1.
    use_windows : bool
        Measure windows too, not matches alone.
    free_water : bool
        Find the water as if nothing were known of it.
    search : callable, optional
        Estimates poses of a file again that are too inaccurate for windows; without it they are refused.

    Raises
    ------
    SurveyError
        If the photographs do not match, or the adjustment does not converge.
    """
    survey, note = with_square_pixels(survey)
    found = _adjust(survey, _Request(device, advance, use_windows, free_water), search)
    return found if note is None else replace(found, notes=(note, *found.notes))


@dataclass(frozen=True)
class _Request:
    """Parameters of `adjust_survey`."""

    device: str
    advance: Callable[[float], None]
    use_windows: bool
    free_water: bool


def _adjust(survey: Survey, asked: _Request, search: PoseRecovery | None) -> Adjustment:
    """See `adjust_survey`."""
    prior = prior_of(survey, make_plan(survey).gsd_m, free_water=asked.free_water)
    if survey.observations.ties is not None or not asked.use_windows:
        with name_open_roll(prior.rolls):
            found = _adjusted(survey, prior, None, asked)
            silent = replace(asked, advance=lambda _share: None)
            return better_of_two_starts(
                survey, prior, found, lambda other, start: _adjusted(other, start, None, silent)
            )
    windows = windows_or_recovered_poses(
        survey,
        lambda: measure_windows(survey, device=asked.device, advance=lambda part: asked.advance(0.9 * part)),
        search,
    )
    if isinstance(windows, TiePoints):
        return _adjusted(survey, prior, windows, asked)
    survey = replace(survey, observations=replace(survey.observations, ties=windows.ties))
    prior = windows.start(prior_of(survey, make_plan(survey).gsd_m, free_water=asked.free_water))
    found = _adjusted(survey, prior, None, replace(asked, advance=lambda _share: None))
    return replace(found, warnings=(windows.warning, *found.warnings))


def _adjusted(survey: Survey, prior: PriorKnowledge, windows: TiePoints | None, asked: _Request) -> Adjustment:
    """See `adjust_survey`; with the windows, where they were measured already."""
    device, advance, use_windows, free_water = asked.device, asked.advance, asked.use_windows, asked.free_water
    gathered = _BlockAdjustment(survey, prior, free_water)
    done: Adjusted | None = None
    shares = [0.0, 0.9, 0.1]
    if survey.observations.ties is not None:
        shares = _shares(survey, device) if use_windows else [1.0, 0.0, 0.0]
        done = gathered.add_ties(
            MATCH,
            dry_or_within_bounds(survey, survey.observations.ties) if free_water else survey.observations.ties,
            prior,
        )
        if use_windows and not survey.provenance.is_level_known and not free_water:
            _require_level(survey, done)
        advance(shares[0])
    if use_windows:
        if windows is None:
            windows = _windows_at(survey, done, device, lambda part: advance(shares[1] * part))
        start = prior if done is None else _restarted(gathered.prior, done)
        done = gathered.add_ties(WINDOW, within_bounds(survey, windows) if free_water else windows, start)
        advance(shares[2])
    assert done is not None
    contradictions: list[GivenValueTest] = []
    drift: FocalDrift | None = None
    if not free_water:
        done, drift = gathered.with_focals(done)
        done, contradictions = gathered.without_contradictions(done)
    water = None if survey.water is not None else find_unnamed_water(done)
    notes = roll_notes(survey, done, make_plan(survey).gsd_m) if done.prior.rolls and not free_water else []
    found = gathered.result(done, contradictions)
    if not survey.provenance.is_level_known and found.parameter("level_m").status == UNKNOWN:
        raise _level_error(survey, found.parameter("level_m").std)
    warnings = [*(_contradiction_text(found, each) for each in contradictions), *height_warnings(survey, done)]
    warnings += parts_warning(found, survey.water) + ([] if water is None else [str(water)])
    warnings += [] if drift is None else [str(drift)]
    if not free_water:
        warnings += gathered.against_control()
    contradiction = survey.provenance.contradiction
    if contradiction is not None and contradiction.is_of_lens:
        warnings.append(f"{contradiction}: the lens is estimated again under the given poses; correct it")
    return replace(found, notes=(*found.notes, *notes), warnings=(*found.warnings, *warnings))


def _shares(survey: Survey, device: str) -> list[float]:
    """Shares of the time of an adjustment: of matches, of windows, and of the adjustment of all."""
    amounts = amounts_of_run(survey, make_plan(survey, Choices(device=device)))
    seconds = adjustment_s(amounts, machine.num_cores())
    return [each / sum(seconds) for each in seconds]


def _require_level(survey: Survey, done: Adjusted) -> None:
    """Raise where an adjustment of matches leaves the level so uncertain that windows cannot determine it either."""
    std = float(water_std(survey, done)[0])
    if not std <= _MOST_GAIN * MOST_STD_LEVEL_M:
        raise _level_error(survey, std)


def _level_error(survey: Survey, std: float) -> SurveyError:
    tilts = tilts_deg(np.array([view.camera.cam_from_local for view in survey.views]))
    down = int((tilts <= DOWN_DEG).sum())
    kept = "" if survey.config.cameras.poses is not None else ". The poses that were found are kept for the next run"
    return SurveyError(
        f"the level of the water is not given, and the photographs do not determine it ({down} of {len(tilts)} look "
        f"straight down): one sigma is {std:.2g} m, and at most {MOST_STD_LEVEL_M:g} m would be of use; "
        f"{GIVE_LEVEL}{kept}"
    )


def _windows_at(survey: Survey, done: Adjusted | None, device: str, advance: Callable[[float], None]) -> TiePoints:
    """Windows measured on an adjusted block, or on the survey as given where there is none."""
    if done is None:
        return measure_windows(survey, device=device, advance=advance)
    placed, common = apply_level_datum(done)
    windows = measure_windows(at_state(survey, done.prior, placed.solution.state), device=device, advance=advance)
    up = np.array([0.0, 0.0, 0.0 if common is None else common.error])
    return replace(windows, start=windows.start + up)


class _BlockAdjustment:
    """Adjustment of a survey in stages: observations are added, and all of them adjusted again."""

    def __init__(self, survey: Survey, prior: PriorKnowledge, free_water: bool):
        self._survey, self.prior, self._free_water = survey, prior, free_water
        self._parts: list[tuple[int, TiePoints]] = []
        self._unobservable: dict[str, Unobservable] = {}
        self._is_against_positions = False

    @property
    def _observed(self) -> Observed:
        return observed(self._parts, self._survey.observations.control, self._survey, self.prior)

    def add_ties(self, kind: int, ties: TiePoints, start: PriorKnowledge) -> Adjusted:
        """Add tie points, thinned to those that are needed, and adjust."""
        needed = ties.only(np.isin(ties.point, thinned(ties, sizes_of(self._survey), CELLS, PER_CELL)))
        ground = self._survey.observations.ground
        if ground is not None and not self._parts:
            start, needed = self._shift_onto_ground(ground, kind, needed, start)
        self._parts.append((kind, needed))
        if self._free_water:
            done, self._unobservable = adjust_free(self._survey, start, self._observed)
            return done
        if start.common_up_std > 0.0 and len(self._parts) == 1:
            return self._at_level(start)
        done = adjust(start, self._observed)
        if len(self._parts) == 1 and self._survey.provenance.is_level_known:
            level = check_dry_block(self._survey, start, self._observed, done)
            if level is not None:
                raise dry_bed_error(level, "leave out [water] if the bed is dry")
        return done

    def _shift_onto_ground(
        self, ground: StableGround, kind: int, ties: TiePoints, start: PriorKnowledge
    ) -> tuple[PriorKnowledge, TiePoints]:
        """Start and tie points shifted onto the ground, after an adjustment without it; positions too, where it shows.

        Positions of unknown accuracy may share an error of metres, those of a stated one an error as large as that,
        unless the ground contradicts it.
        """
        stated = start.std[start.layout.first_pose :].reshape(-1, POSE)[~start.unknown_positions, :3]
        stated = stated[np.isfinite(stated).all(axis=1)]
        are_stated = len(stated) > 0 and not start.unknown_positions.any()
        shared = np.median(stated, axis=0) if are_stated else np.full(3, GPS_STD_M)
        start = replace(start, shared_std=shared)
        alone = replace(observed([(kind, ties)], self._survey.observations.control, self._survey, start), ground=None)
        try:
            done = adjust(start, alone)
            state, points = replace(done.solution.state, points=np.zeros((0, 3))), done.solution.state.points
            points = points[: len(done.used.ties) - len(done.used.control)]
        except NotConvergedError:
            state, points = start.state, ties.start
        shift = shift_onto(ground, points)
        off = np.median(state.centres - start.mean.centres, axis=0) + shift
        horizontal, vertical = ground.std_m
        of_both = np.sqrt(shared**2 + np.square([horizontal, horizontal, vertical]) + _START_STD_M**2)
        self._is_against_positions = are_stated and bool((np.abs(off) > MOST_SIGMAS * of_both).any())
        if not are_stated or self._is_against_positions:
            shared = np.maximum(shared, GPS_STD_M)
            start = replace(start, mean=replace(start.mean, centres=start.mean.centres + off))
        self.prior = replace(self.prior, mean=start.mean, shared_std=shared)
        start = replace(start, shared_std=shared, state=replace(state, centres=state.centres + shift))
        return start, replace(ties, start=ties.start + shift)

    def _at_level(self, start: PriorKnowledge) -> Adjusted:
        """Adjust a block whose height the level of the water determines, or else the positions."""
        start, points = water_start(start, self._observed)
        kind, ties = self._parts[0]
        # Without those of check points, which come last.
        self._parts[0] = (kind, replace(ties, start=points[: len(ties)]))
        done = adjust(start, self._observed)
        held = None if self._has_stated_positions else drop_common_height(self.prior, done)
        if held is None:
            return done
        self.prior = replace(held, state=self.prior.state)
        return adjust(held, self._observed)

    @property
    def _has_stated_positions(self) -> bool:
        """Whether the accuracy of any position is stated."""
        return any(prior.position_std is not None for prior in self._survey.observations.priors.values())

    def with_focals(self, done: Adjusted) -> tuple[Adjusted, FocalDrift | None]:
        """Adjust with a focal length for each photograph, where they differ."""
        if self._survey.observations.ground is not None:
            return done, None
        seen = self._observed
        done, drift = with_focals(self.prior, done, lambda start: adjust(start, seen))
        if drift is not None:
            self.prior = with_focal_std(self.prior, done, drift.std)
        return done, drift

    def without_contradictions(self, done: Adjusted) -> tuple[Adjusted, list[GivenValueTest]]:
        """Adjust with contradicted parameters of the water free, the worst first; also returns the contradictions."""
        contradictions: list[GivenValueTest] = []
        while len(contradictions) < WATER:
            each = (_contradiction_of_sample(self._survey) if not contradictions else None) or worst_contradiction(
                self._survey, done
            )
            if each is None:
                break
            contradictions.append(each)
            start = release(_restarted(done.prior, done), each)
            done = adjust(start, self._observed)
        return done, contradictions

    def against_control(self) -> list[str]:
        """A warning where positions and water contradict control that is too little to check itself."""
        control = self._survey.observations.control
        if control is None or not has_unchecked_control(self._survey):
            return []
        alone = replace(self._survey, observations=replace(self._survey.observations, control=None, ground=None))
        prior = prior_of(alone, make_plan(alone).gsd_m)
        # A block with an undetermined roll cannot test control.
        if prior.rolls:
            return []
        kind, ties = self._parts[0]
        try:
            free = apply_level_datum(_BlockAdjustment(alone, prior, free_water=False).add_ties(kind, ties, prior))[0]
        except NotConvergedError:
            return []
        contradictions = contradicted_points(control, self._survey.views, free.prior, free.solution)
        return [contradiction_warning(contradictions)] if contradictions else []

    def result(self, done: Adjusted, contradictions: Sequence[GivenValueTest]) -> Adjustment:
        """The adjustment in the terms of the survey."""
        control = self._survey.observations.control
        total = sum(len(ties.view) for _, ties in self._parts) + (0 if control is None else len(control.marks))
        if self._free_water:
            return self._on_ground(assemble_result(self._survey, done, total, unobservable=self._unobservable), done)
        placed, common = apply_level_datum(done)

        def hold(held: np.ndarray) -> Adjusted:
            return apply_level_datum(adjusted_with(done, held, self.prior.std))[0]

        used = {WATER_PARAMETERS.index(each.name) for each in contradictions} | (set() if common is None else {LEVEL})
        found = self._on_ground(
            assemble_result(self._survey, placed, total, contradicted=sorted(used), hold=hold), done
        )
        return found if common is None else with_common(found, common, placed.solution.state.water)

    def _on_ground(self, found: Adjustment, done: Adjusted) -> Adjustment:
        """The result with how the block lies on the ground of an earlier survey, where there is one."""
        if done.alignment is None:
            return found
        moved = moved_by(self._survey.views, done.solution.state, done.alignment.middle)
        reference = str(self._survey.config.control.reference)
        fit = ground_fit(done.alignment, moved, reference, is_against_positions=self._is_against_positions)
        return replace(found, ground=fit, notes=(*found.notes, *fit.notes), warnings=(*found.warnings, *fit.warnings))


def _contradiction_of_sample(survey: Survey) -> GivenValueTest | None:
    """GivenValueTest by a sample under the given poses; the test of a block with free poses may have less power."""
    found = survey.provenance.contradiction
    return None if found is None or found.is_of_lens else found


def _contradiction_text(found: Adjustment, each: GivenValueTest) -> str:
    """A contradiction in words, with both numbers."""
    row, unit, digits = found.parameter(each.name), *((" m", 3) if each.name == LEVEL_NAME else ("", 4))
    return (
        f"{row.name} is given as {row.given:.{digits}f} +- {each.given_std:.2g}{unit}, and the photographs say "
        f"{row.value:.{digits}f} +- {row.std:.2g}{unit}: the two contradict each other by more than "
        f"{MOST_SIGMAS_OF_FOUR:.1f} standard deviations; what the photographs say is used. Correct the value, its "
        "vertical datum, or its standard deviation"
    )


def _restarted(prior: PriorKnowledge, done: Adjusted) -> PriorKnowledge:
    """Priors that start from an adjusted state, with the std of positions that the adjustment estimated."""
    none = np.zeros((0, 3))
    std = np.concatenate([prior.std[:WATER], done.prior.std[WATER:]])
    return replace(prior, state=replace(done.solution.state, points=none), std=std)
