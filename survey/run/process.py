"""`bathynerf process`: from a survey folder to a run folder.

    check -> plan -> stages (survey.run.stages) -> cloud.las -> comparison -> report -> verdict

Stages leave their result in the run folder and are used again while what they depend on is the same. Cloud, report,
settings and plan are the result of a run and take the place of an earlier one together, at the end.
"""

import time
from contextlib import nullcontext, suppress
from functools import partial
from pathlib import Path
from threading import Thread
from typing import Any

from survey.display.quantities import length
from survey.errors import SurveyError
from survey.files.paths import ReadFiles, require_folder
from survey.files.remote import Remote, is_url, local_run
from survey.folder.found import survey_inputs
from survey.folder.survey import Survey, load_survey
from survey.machine import require_memory
from survey.plan.check import Checked, require_processable
from survey.plan.choices import Choices, choices_of
from survey.plan.plan import Plan
from survey.plan.tiling import SHARED, plan_run
from survey.plan.workload import Workload, room_warnings, workload_of_images
from survey.progress import Progress, opened
from survey.run.aim import plan_for_aim
from survey.run.edits import edits_of_others
from survey.run.folder import Owner, RunDir
from survey.run.job import Job
from survey.run.remote_run import RemoteRun
from survey.run.stages import run_stages
from survey.run.workers import WorkerNeeds, workers_for
from survey.settings.config import SurveyConfig, settings_of
from survey.settings.tables import ProcessConfig
from survey.sfm.features import computing_on
from survey.words import Quality

QUALITY_GATE_FAILED = 3


def process(
    survey_folder: str | Path,
    run_folder: str | Path | None = None,
    *,
    resume: bool = True,
    reference: str | Path | None = None,
    visible: str | Path | None = None,
    chooses_workers: bool = False,
    **options: Any,
) -> int:
    """Compute the point cloud of the bed, with a report, in a run folder.

    Raises SurveyError or GeoError where the input is at fault.

    Parameters
    ----------
    survey_folder : str or Path
    run_folder : str or Path, optional
        Default ``survey_folder/bathynerf``. A URL, as "s3://bucket/run": results are put there, what is finished there
        is taken up, and the run works in a hidden folder of the survey.
    resume : bool
        Use what an earlier run in this folder finished, where nothing that it depends on has changed.
    reference, visible : str or Path, optional
        True surface and the points of it that cameras see, for the report; the reconstruction never reads them.
    chooses_workers : bool
        Choose ``workers`` by tiles, cores and memory where no number is given, as the command line does.
    options :
        Those of `bathynerf.Choices`, e.g. ``quality="draft"``; of those that are not given the ones in [process] of
        survey.toml count, else the defaults.

    Returns
    -------
    int
        0, or 3 where a quality gate failed; all outputs are written either way.
    """
    began = time.monotonic()
    require_memory()
    survey_folder, folder = Path(survey_folder), local_run(Path(survey_folder), run_folder)
    truth = {
        option: Path(path) for option, path in (("reference", reference), ("visible", visible)) if path is not None
    }
    for option, path in truth.items():
        if not path.exists():
            raise SurveyError(f"--{option} {path} does not exist; give the path of a PLY, OBJ, LAS or LAZ file")
    settings = settings_of(survey_folder)
    require_folder("-o", folder, survey_inputs(survey_folder, settings) + ReadFiles.of(*truth.values()))
    chosen = choices_of(ProcessConfig(**options).over((settings or SurveyConfig()).process))
    checked = require_processable(survey_folder, chosen, settings)
    run = RemoteRun(folder, Remote(str(run_folder))) if is_url(run_folder) else RunDir(folder)
    with opened() as progress, progress.run(), run:
        owner = Owner.of(checked.found.name, checked.found.images)
        run.claim(owner, is_inside=folder.resolve().is_relative_to(survey_folder.resolve()))
        progress.log_to(run.log_path)
        if checked.level_warning is not None:
            progress.warn(checked.level_warning)
        survey = checked.survey or _with_poses(checked, chosen, run, progress)
        gone_s = time.monotonic() - began
        aimed = plan_for_aim(survey, chosen, gone_s=gone_s, refuses=checked.survey is not None)
        chosen, earlier = aimed.chosen, run.latest_stage_json(SHARED).get("tiles")
        plan, workload, warnings = plan_run(
            survey, chosen, aim=aimed.decision, chooses_workers=chooses_workers, earlier_tiles=earlier
        )
        if chosen.has_aim:
            progress.note(f"asked: {chosen.aim}")
        _announce(survey, plan, workload, progress)
        for text in (*aimed.warnings, *warnings, *room_warnings(workload, run.path, refuses=True)):
            progress.warn(text)
        job = Job(survey, chosen, plan, progress, workspace=run.sfm_path, scratch=run.scratch_path)
        # The report takes half a second to import, beside the kernels of the sweep; if it fails, it does so below.
        Thread(target=_import_products, args=(job,), daemon=True).start()
        result = run.open_result(job.plan.quality)
        stages = run_stages(job, run, resume=resume)
        from survey.run.products import FinishedRun, write_products

        verdict = write_products(FinishedRun(run, job, stages, truth, result, time.monotonic() - began))
        run.publish(result, quality=job.plan.quality, stages=stages)
        progress.detail(f"report: {run.report_html_path}")
        if (of_others := edits_of_others(run)) is not None:
            progress.warn(of_others)
        for gate in verdict.gates:
            if not gate.passed:
                kind = "a draft, for a first look" if job.plan.quality == Quality.draft else "quality gate"
                progress.warn(f"{kind}: {gate.sentence}; all outputs are written")
    return 0 if verdict.passed else QUALITY_GATE_FAILED


def _with_poses(checked: Checked, chosen: Choices, run: RunDir, progress: Progress) -> Survey:
    """The survey with poses from structure from motion, on the workers of a scheduler where there is one."""
    found = checked.found
    workload = workload_of_images([header.size_px for header in found.headers.values()], chosen)
    progress.note(f"workload: {workload}")
    progress.expect(workload.parts_s)
    needs = WorkerNeeds(run.stages_path, next(iter(found.images.values())))
    # By the URL of a run workers do not see the photographs before a task names them.
    spreads = chosen.scheduler is not None and type(run) is RunDir
    workers = partial(workers_for, chosen.workers or 1, chosen.scheduler, needs, progress.note)
    with computing_on(workers) if spreads else nullcontext():
        return load_survey(found.folder, found=found, workspace=run.sfm_path, report=progress.detail)


def _announce(survey: Survey, plan: Plan, workload: Workload, progress: Progress) -> None:
    progress.note(f"{survey.name}: {len(survey.views)} views, a pixel covers {length(plan.gsd_m)} of the ground")
    progress.detail(*(f"assumed: {text}" for text in survey.findings.assumptions))
    for text in survey.findings.warnings:
        progress.warn(text)
    progress.detail(*(f"plan: {decision.name}: {decision.choice} ({decision.reason})" for decision in plan.decisions))
    # Without a file of poses it was said before structure from motion.
    (progress.detail if survey.config.cameras.poses is None else progress.note)(f"workload: {workload}")
    progress.expect(workload.parts_s)


def _import_products(job: Job) -> None:
    # Before, each read releases the GIL to this thread, which holds it for 5 ms (sys.getswitchinterval).
    job.waits_for_kernels.wait()
    with suppress(Exception):
        import survey.run.products  # noqa: F401
