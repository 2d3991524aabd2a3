"""`bathynerf process`: from a survey folder to a run folder.

    check -> stages (survey.run.pipeline) -> cloud.las -> comparison -> report -> verdict

Stages leave their result in the run folder and are used again while what they depend on is the same. Cloud, report,
settings and plan are the result of a run and take the place of an earlier one together, at the end.
"""

from __future__ import annotations

import json
import time
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from survey.errors import SurveyError
from survey.folder.config import dump_config
from survey.folder.inputs import survey_inputs
from survey.folder.survey import Survey, load_survey
from survey.outputs import Inputs, require_folder
from survey.plan.check import require_processable
from survey.plan.plan import Plan, make_plan
from survey.plan.workload import require_room, workload_of
from survey.progress import Progress, current
from survey.run.folder import RunDir, seconds_of, versions

if TYPE_CHECKING:
    from survey.compare.result import Comparison
    from survey.report.verdict import Verdict
    from survey.run.job import Job

QUALITY_GATE_FAILED = 3
# Where poses that had to be found are kept, in the run folder.
SFM = "sfm"
# At which the report asks how complete the cloud is: that of the study which this work follows, and a finer one.
TOLERANCES_M = (0.2, 0.05)


def process(
    survey_folder: Path,
    run_folder: Path | None = None,
    *,
    quality: str = "standard",
    device: str = "auto",
    resume: bool = True,
    field: str = "auto",
    calibrate_water: bool = False,
    true_colour: bool = False,
    reference: Path | None = None,
    visible: Path | None = None,
) -> int:
    """Make the point cloud of the bed, with a report, in a run folder.

    Parameters
    ----------
    survey_folder : Path
    run_folder : Path, optional
        Default ``survey_folder/bathynerf``.
    quality : "draft", "standard" or "fine"
    device : "auto", "cpu" or "cuda"
    field : "auto", "on" or "off"
        Whether the tensor field refines the sweep; "auto" leaves it to the plan.
    resume : bool
        Use what an earlier run in this folder finished, where nothing that it depends on has changed.
    calibrate_water : bool
        First estimate level, slopes and index of the water from the photographs; what they cannot tell stays as given.
    true_colour : bool
        Give the points the bed's own colour, the water taken away, instead of the photographs'.
    reference, visible : Path, optional
        True surface and the points of it that cameras see, for the report; the reconstruction never reads them.

    Returns
    -------
    int
        0, or 3 where a quality gate failed; all outputs are written either way.

    Raises
    ------
    SurveyError, GeoError
        Where the input is at fault.
    """
    progress = current()
    run_folder = survey_folder / "bathynerf" if run_folder is None else run_folder
    for name, path in (("--reference", reference), ("--visible", visible)):
        if path is not None and not path.exists():
            raise SurveyError(f"{name} {path} does not exist; give the path of a PLY, OBJ, LAS or LAZ file")
    require_folder("-o", run_folder, survey_inputs(survey_folder) + Inputs.of(reference, visible))
    checked = require_processable(survey_folder)
    if true_colour and checked.found.config.water is None:
        raise SurveyError(
            "--true-colour takes the water away, but the survey has none; leave the option out, or give [water]"
        )
    survey = checked.survey or load_survey(
        survey_folder, found=checked.found, workspace=run_folder / SFM, report=progress.note
    )
    plan_of = partial(make_plan, quality=quality, device=device, field=field)
    plan = plan_of(survey)
    workload = workload_of(survey, plan)
    shortages = require_room(workload, run_folder)
    # Starts torch and Dr.Jit: only after everything that the user may have to mend was looked at.
    from survey.run.job import Job

    with RunDir(run_folder) as run:
        progress.log_to(run.log_path)
        _announce(progress, survey, plan)
        progress.note(f"workload: {workload}")
        for text in shortages:
            progress.warn(text)
        job = Job(survey, plan_of, progress, calibrate_water=calibrate_water, true_colour=true_colour)
        return _to_the_end(run, job, resume, reference, visible)


def _announce(progress: Progress, survey: Survey, plan: Plan) -> None:
    progress.note(f"{survey.name}: {len(survey.views)} views")
    for text in survey.assumptions:
        progress.note(f"assumed: {text}")
    for text in survey.warnings:
        progress.warn(text)
    for decision in plan.decisions:
        progress.note(f"plan: {decision.name}: {decision.choice} ({decision.reason})")


def _to_the_end(run: RunDir, job: Job, resume: bool, reference: Path | None, visible: Path | None) -> int:
    """Stages, result and verdict; the exit code."""
    from survey.run.pipeline import BED_OF_SWEEP, STAGES
    from survey.run.stage import run_stage

    result = run.open_result()
    stages = [*STAGES, BED_OF_SWEEP] if reference is not None else STAGES
    done: dict[str, Path] = {}
    for stage in stages:
        if stage.is_on(job):
            done[stage.name] = run_stage(stage, job, run, done, resume=resume)
    verdict = _write_result(result, job, done, _timings(run, job.survey, done), reference, visible)
    run.publish(result, quality=job.plan.quality, stages=done)
    job.progress.detail(f"report: {run.report_html_path}")
    for gate in verdict.gates:
        if not gate.passed:
            job.progress.warn(f"quality gate: {gate.sentence}; all outputs are written")
    return 0 if verdict.passed else QUALITY_GATE_FAILED


def _timings(run: RunDir, survey: Survey, done: dict[str, Path]) -> dict[str, float]:
    """Seconds of the search for poses, where there was one, and of the stages, each when it was computed [s]."""
    timings = {name: seconds_of(place) for name, place in done.items()}
    if survey.config.cameras.poses is not None:
        return timings
    from survey.sfm.poses import seconds_of_solve

    seconds = seconds_of_solve(run.path / SFM)
    return timings if seconds is None else {"structure from motion": seconds} | timings


def _write_result(
    folder: Path,
    job: Job,
    done: dict[str, Path],
    timings: dict[str, float],
    reference: Path | None,
    visible: Path | None,
) -> Verdict:
    """Everything that the user gets, in the folder of a new result."""
    from survey.report import NUM_STEPS, ReportFacts, write_report
    from survey.run.export import write_bed_las
    from survey.run.gate import verdict_of
    from survey.run.stage_sweep import MAPS
    from survey.run.stored import load_bed, load_depth_maps

    survey, plan, progress = job.survey, job.plan, job.progress
    (folder / "settings.toml").write_text(dump_config(survey.config), encoding="utf-8")
    (folder / "plan.json").write_text(json.dumps(plan.as_dict(), indent=2), encoding="utf-8")
    stored = load_bed(done["bed"])
    cloud = folder / "cloud.las"
    write_bed_las(cloud, stored)
    progress.note(f"{len(stored.bed):,} points of the bed")
    start = time.monotonic()
    comparison = _compare(cloud, survey, reference, visible)
    of_sweep = None
    if "bed_of_sweep" in done:
        cloud_of_sweep = folder / "sweep.las"
        write_bed_las(cloud_of_sweep, load_bed(done["bed_of_sweep"]))
        of_sweep = _compare(cloud_of_sweep, survey, reference, visible)
        cloud_of_sweep.unlink()
    if comparison is not None:
        timings = timings | {"comparison": time.monotonic() - start}
    verdict = verdict_of(survey, stored.bed, plan.gsd_m)
    facts = ReportFacts(
        survey=survey,
        plan=plan,
        settings={**asdict(survey.config), "quality": plan.quality, "device": plan.device},
        timings=timings,
        bed=stored.bed,
        points_crs=stored.points_crs,
        depth_maps=load_depth_maps(done["sweep"] / MAPS),
        comparison=comparison,
        sweep_comparison=of_sweep,
        versions=versions(),
        verdict=verdict,
    )
    with progress.stage("Report", NUM_STEPS) as stage:
        write_report(folder, facts, stage.advance)
    return verdict


def _compare(cloud: Path, survey: Survey, reference: Path | None, visible: Path | None) -> Comparison | None:
    if reference is None:
        return None
    from survey.compare.comparison import CompareOptions, compare_surfaces

    options = CompareOptions(tolerances_m=TOLERANCES_M, visible=visible, bounds=survey.bounds)
    return compare_surfaces(cloud, reference, options)
