"""Tests of a survey before its adjustment: poses that are given as exact, and `bathynerf check --deep`.

Poses, lens and water that are exact leave residuals with no mean over a photograph. Errors of a pose move all that its
photograph shows in one direction; what points can follow of them does no harm to the bed. Points follow a
wrong level, and the bed with them: this is tested on its own (`survey.adjust.parameter_tests`).
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fields.sweep.block import Block
from survey.adjust import parameter_tests
from survey.adjust.block.bundle import solve
from survey.adjust.block.observed import WINDOW, observed
from survey.adjust.block.priors import FREE_WATER, prior_of
from survey.adjust.block.state import HELD_SHARE
from survey.adjust.block.windows import load_photographs, measure_loaded_windows
from survey.adjust.refine import adjust_survey
from survey.adjust.result.adjustment import Adjustment
from survey.errors import GivenValueTest, SurveyError
from survey.folder.survey import Survey, load_survey
from survey.machine import require_memory
from survey.photos.poses import TiePoints
from survey.plan.check import CheckSection
from survey.plan.choices import Choices
from survey.plan.plan import MOST_MISFIT_PX, Plan, make_plan
from survey.progress import current

# So many photographs of the middle of the block are looked at; with fewer in all there is nothing to sample.
SAMPLE = 10
# Of the angle to the plumb line: level views look farther than any place that others see.
_LEAST_COSINE = 0.5


@dataclass(frozen=True)
class PoseCheck:
    """Test result for given poses, lens and water."""

    # [px] or None: reprojection misfit per coordinate: the root mean square over photographs of the mean residual of
    # their windows, less what the scatter of the windows explains. None where too little matches to tell.
    misfit_px: float | None
    # Tests of water and lens, where the misfit confirms the poses. It is taken under the level
    # that fits best, since a wrong level causes a misfit of oblique photographs, too.
    tests: tuple[GivenValueTest, ...] = ()
    # The level that photographs show, where the given one leaves all of the bed dry
    flooded: GivenValueTest | None = None

    @property
    def contradiction(self) -> GivenValueTest | None:
        """The most contradicted parameter, if any."""
        return parameter_tests.most_contradicted(self.tests)

    def require_water(self) -> None:
        """Raise `SurveyError` where photographs show water over a bed that the given level leaves dry."""
        if (level := self.flooded) is not None:
            raise parameter_tests.dry_bed_error(level, "give --poses fixed to use it as it is")


def check_of_windows(
    survey: Survey, plan: Plan, block: Block, bound: tuple[float, float], advance: Callable[[float], None]
) -> PoseCheck:
    """The check by windows of a sample of photographs.

    The block has all photographs at the scale of the plan; its bed lies between ``bound`` [m] over the water plane.
    """
    chosen = _of_middle(survey, plan.height_m)
    sample = replace(survey, views=tuple(survey.views[i] for i in chosen))
    windows = measure_loaded_windows(sample, plan, block.part(chosen), bound, advance, sparse=True)
    return check_of_ties(sample, plan, WINDOW, windows)


def check_of_ties(survey: Survey, plan: Plan, kind: int, ties: TiePoints) -> PoseCheck:
    """The check by tie points of a kind: windows of a sample, or the matches of all photographs, wherever they lie."""
    if not len(ties):
        return PoseCheck(None)
    # Poses of structure from motion would not count as given.
    survey = replace(survey, observations=replace(survey.observations, ties=None))
    prior = prior_of(survey, plan.gsd_m)
    seen = observed([(kind, ties)], None, survey, prior)
    held = replace(prior, std=np.full_like(prior.std, HELD_SHARE))
    state = replace(prior.state, points=seen.ties.start)
    problem = seen.problem(held, state)
    solution = solve(replace(problem, holds_parameters=True), state)
    found = parameter_tests.misfit(solution.residuals, seen.ties)
    flooded = parameter_tests.check_dry_bed(survey, problem, solution.state, plan.gsd_m)
    if flooded is not None:
        return PoseCheck(found, flooded=flooded)
    of_poses = found
    if found is not None and found > MOST_MISFIT_PX and kind == WINDOW:
        # Under the level that fits best.
        best = parameter_tests.solve_with_level(problem, solution.state, FREE_WATER[0])
        of_poses = None if best is None else parameter_tests.misfit(best.residuals, seen.ties)
    if of_poses is None or of_poses > MOST_MISFIT_PX:
        # Errors of poses look like those of the water; all is adjusted together then.
        return PoseCheck(found)
    return PoseCheck(
        found, tuple(parameter_tests.check_given_values(survey, problem, solution.state, of_poses, plan.gsd_m))
    )


def _of_middle(survey: Survey, height: float) -> list[int]:
    """Numbers, ascending, of views that look at the middle from a height [m]; those above it tell little of water."""
    centres = np.array([view.camera.centre[:2] for view in survey.views])
    axes = np.array([view.camera.cam_from_local[2] for view in survey.views])
    seen = centres + height * axes[:, :2] / np.maximum(-axes[:, 2:], _LEAST_COSINE)
    distance = np.linalg.norm(seen - np.median(seen, axis=0), axis=1)
    return np.sort(np.argsort(distance, kind="stable")[:SAMPLE]).tolist()


def deep_check(folder: Path, *, device: str = "auto") -> list[CheckSection]:
    """Test of poses, lens and water against the photographs, without a point cloud; poses that are found are kept."""
    require_memory()
    progress = current()
    survey = load_survey(folder, report=progress.note)
    plan, checked = make_plan(survey, Choices(device=device)), PoseCheck(None)
    if plan.pose_choice == "check":
        with progress.stage("Poses", 1.0) as stage, suppress(SurveyError):
            checked = check_of_windows(survey, plan, *load_photographs(survey, plan), stage.advance)
        checked.require_water()
        survey = replace(survey, provenance=replace(survey.provenance, contradiction=checked.contradiction))
    with progress.stage("Adjustment", 1.0) as stage:
        found = adjust_survey(survey, device=device, advance=stage.advance)
    sections = [CheckSection("photographs", _rows(checked, found))]
    if found.warnings:
        sections.append(CheckSection("contradicted by the photographs", tuple(("", text) for text in found.warnings)))
    return sections


def _rows(checked: PoseCheck, found: Adjustment) -> tuple[tuple[str, str], ...]:
    rows = []
    if checked.misfit_px is not None:
        message = f"reprojection misfit {checked.misfit_px:.2f} px with the given poses"
        rows.append(("poses", message if checked.contradiction is None else f"{message}, and {checked.contradiction}"))
    rows += [(row.name, row.verdict) for row in found.parameters]
    for name, count in found.statistics.num_observations.items():
        rows.append((name, f"{count:,}, good to {found.statistics.std_px[name]:.2f} px"))
    for point in found.control:
        east, north, up = (f"{1000.0 * miss:.0f}" for miss in point.residual_m)
        rows.append((point.name, f"{east}, {north} and {up} mm east, north and up; {point.num_marks} marks"))
    return tuple(rows)
