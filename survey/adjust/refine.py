"""Poses, lens and water of a survey together, from its photographs, positions, control and readings.

matches of structure from motion (`Survey.ties`), where there are any -> a first adjustment, which removes the bending;
poses of a file that are too far off for windows get such matches first (`survey.adjust.starts`)
windows matched to a fraction of a pixel on the adjusted block (`survey.adjust.block.windows`) -> the final adjustment
windows matched under poses before an adjustment, over waves: again on the adjusted block
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from threadpoolctl import threadpool_limits

from survey.adjust.applied import at_state
from survey.adjust.block.observed import KINDS, MATCH, WINDOW
from survey.adjust.block.priors import PriorKnowledge, prior_of
from survey.adjust.block.windows import measure_windows
from survey.adjust.common_height import apply_level_datum, height_warnings
from survey.adjust.focal_lengths import FocalDrift, with_square_pixels
from survey.adjust.observability import dry_or_within_bounds, name_open_roll, roll_notes, water_std, within_bounds
from survey.adjust.parameter_tests import LEVEL_NAME
from survey.adjust.result.adjustment import MOST_SIGMAS_OF_FOUR, MOST_STD_LEVEL_M, Adjustment, Status
from survey.adjust.result.std_of_block import parts_warning
from survey.adjust.rounds import RobustSolution
from survey.adjust.stages import StagedAdjustment, restarted
from survey.adjust.starts import PoseRecovery, better_of_two_starts, windows_or_recovered_poses
from survey.adjust.unnamed_water import unnamed_water_warning
from survey.errors import GivenValueTest, SurveyError
from survey.folder.survey import Survey
from survey.photos.poses import TiePoints
from survey.plan.check import DOWN_DEG, GIVE_LEVEL, tilts_deg
from survey.plan.choices import gsd_m

# Of the time of an adjustment, about: of matches, of windows, and of all.
_SHARES = (0.3, 0.4, 0.3)
# Windows under water that scatter by more [px], as the solver finds surfaces from: measured under poses before the
# adjustment, they bend the block (docs/decisions.md).
_WAVES_PX = 0.1
# Windows are measured up to four times as well as matches, and are as many.
_MOST_GAIN = 6.0


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
    """
    survey, note = with_square_pixels(survey)
    prior = prior_of(survey, gsd_m(survey), free_water=free_water)

    def from_start(other: Survey, start: PriorKnowledge, windows: TiePoints | None, *, silent: bool) -> Adjustment:
        staged = StagedAdjustment(other, start, free_water)
        return _adjust_in_stages(staged, windows, device, (lambda _share: None) if silent else advance, use_windows)

    if survey.observations.ties is not None or not use_windows:
        with name_open_roll(prior.rolls):
            first = from_start(survey, prior, None, silent=False)
            found = better_of_two_starts(
                survey, prior, first, lambda other, start: from_start(other, start, None, silent=True)
            )
    else:
        windows = windows_or_recovered_poses(
            survey,
            lambda: measure_windows(survey, device=device, advance=lambda part: advance(0.9 * part)),
            search,
        )
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
    device: str,
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
        done = staged.first_ties(MATCH, dry_or_within_bounds(survey, ties) if free_water else ties)
        if use_windows and not survey.provenance.is_level_known and not free_water:
            std = float(water_std(survey, done)[0])
            # Windows cannot tell it either.
            if not std <= _MOST_GAIN * MOST_STD_LEVEL_M:
                raise _level_error(survey, std)
        advance(shares[0])
    if use_windows:
        if windows is None:
            windows = _windows_at(survey, done, device, lambda part: advance(shares[1] * part))
        while True:
            before, windows = done, within_bounds(survey, windows) if free_water else windows
            if done is None:
                done = staged.first_ties(WINDOW, windows)
            else:
                done = staged.with_ties(WINDOW, windows, restarted(staged.prior, done))
            if before is not None or not _show_waves(done):
                break
            windows = _windows_at(survey, done, device, lambda _share: None)
        advance(shares[2])
    assert done is not None
    contradictions: list[GivenValueTest] = []
    drift: FocalDrift | None = None
    if not free_water:
        done, drift = staged.with_focals(done)
        done, contradictions = staged.without_contradictions(done)
    water = None if survey.water is not None else unnamed_water_warning(done)
    notes = roll_notes(survey, done, gsd_m(survey)) if done.prior.rolls and not free_water else []
    found = staged.result(done, contradictions)
    if not survey.provenance.is_level_known and found.parameter("level_m").status == Status.UNKNOWN:
        raise _level_error(survey, found.parameter("level_m").std)
    warnings = [*(_contradiction_text(found, each) for each in contradictions), *height_warnings(survey, done)]
    warnings += parts_warning(found, survey.water) + ([] if water is None else [water])
    warnings += [] if drift is None else [str(drift)]
    if not free_water:
        warnings += staged.against_control()
    contradiction = survey.provenance.contradiction
    if contradiction is not None and contradiction.is_of_lens:
        warnings.append(f"{contradiction}: the lens is estimated again under the given poses; correct it")
    return replace(found, notes=(*found.notes, *notes), warnings=(*found.warnings, *warnings))


def _show_waves(done: RobustSolution) -> bool:
    """Whether windows under water scatter as over waves."""
    kind = done.problem.kind
    wet = kind[(kind >= len(KINDS)) & (kind % len(KINDS) == WINDOW)]
    return len(wet) > 0 and bool(np.mean(done.problem.given_std_px[wet] ** 2) > _WAVES_PX**2)


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
    survey: Survey, done: RobustSolution | None, device: str, advance: Callable[[float], None]
) -> TiePoints:
    """Windows measured on an adjusted block, or on the survey as given where there is none."""
    if done is None:
        return measure_windows(survey, device=device, advance=advance)
    placed, common = apply_level_datum(done)
    windows = measure_windows(at_state(survey, done.prior, placed.solution.state), device=device, advance=advance)
    up = np.array([0.0, 0.0, 0.0 if common is None else common.error])
    return replace(windows, start=windows.start + up)


def _contradiction_text(found: Adjustment, each: GivenValueTest) -> str:
    """A contradiction in words, with both numbers."""
    row, unit, digits = found.parameter(each.name), *((" m", 3) if each.name == LEVEL_NAME else ("", 4))
    return (
        f"{row.name} is given as {row.given:.{digits}f} +- {each.given_std:.2g}{unit}, and the photographs say "
        f"{row.value:.{digits}f} +- {row.std:.2g}{unit}: the two contradict each other by more than "
        f"{MOST_SIGMAS_OF_FOUR:.1f} standard deviations; what the photographs say is used. Correct the value, its "
        "vertical datum, or its standard deviation"
    )
