"""`bathynerf check --deep`: the survey adjusted, and survey.toml tested against the photographs."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from survey.adjust.block.windows import loaded
from survey.adjust.pose_check import PoseCheck, check_of_windows
from survey.adjust.refine import adjust_survey
from survey.adjust.result.adjustment import Adjustment
from survey.errors import SurveyError
from survey.folder.survey import load_survey
from survey.plan.check import Section
from survey.plan.choices import Choices
from survey.plan.plan import make_plan
from survey.progress import current


def deep_check(folder: Path, *, device: str = "auto") -> list[Section]:
    """Test of poses, lens and water against the photographs, without a point cloud.

    Poses that structure from motion has to find are kept in ``folder/bathynerf``, for `process` to use.

    Raises
    ------
    SurveyError, GeoError
        Where the survey cannot be used, its photographs do not match, or they show water over a bed that is dry.
    """
    progress = current()
    survey = load_survey(folder, report=progress.note)
    plan, checked = make_plan(survey, Choices(device=device)), PoseCheck(None)
    if plan.poses[0] == "check":
        with progress.stage("Poses", 1.0) as stage, suppress(SurveyError):
            checked = check_of_windows(survey, plan, *loaded(survey, plan), stage.advance)
        checked.require_water()
        survey = replace(survey, provenance=replace(survey.provenance, contradiction=checked.contradiction))
    with progress.stage("Adjustment", 1.0) as stage:
        found = adjust_survey(survey, device=device, advance=stage.advance)
    sections = [Section("photographs", (*_rows_of_check(checked), *_rows(found)))]
    if found.warnings:
        sections.append(Section("contradicted by the photographs", tuple(("", text) for text in found.warnings)))
    return sections


def _rows_of_check(checked: PoseCheck) -> tuple[tuple[str, str], ...]:
    if checked.misfit_px is None:
        return ()
    said = f"reprojection misfit {checked.misfit_px:.2f} px with the given poses"
    return (("poses", said if checked.contradiction is None else f"{said}, and {checked.contradiction}"),)


def _rows(found: Adjustment) -> tuple[tuple[str, str], ...]:
    rows = [(row.name, row.verdict) for row in found.parameters]
    for name, count in found.statistics.num_observations.items():
        rows.append((name, f"{count:,}, good to {found.statistics.std_px[name]:.2f} px"))
    for point in found.control:
        east, north, up = (f"{1000.0 * miss:.0f}" for miss in point.residual_m)
        rows.append((point.name, f"{east}, {north} and {up} mm east, north and up; {point.num_marks} marks"))
    return tuple(rows)
