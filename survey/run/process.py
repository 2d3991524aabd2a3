"""`bathynerf process`: from a survey folder to a run folder.

    check -> plan -> stages (survey.run.pipeline) -> cloud.las -> comparison -> report -> verdict

Stages leave their result in the run folder and are used again while what they depend on is the same. Cloud, report,
settings and plan are the result of a run and take the place of an earlier one together, at the end.
"""

from __future__ import annotations

import time
from contextlib import AbstractContextManager, nullcontext, suppress
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING

from survey.display.quantities import length
from survey.errors import SurveyError
from survey.files.outputs import ReadFiles, require_folder
from survey.files.remote import Remote, is_url, local_run
from survey.folder.found import Found, process_config, survey_inputs
from survey.folder.survey import Survey, load_survey
from survey.plan.check import Checked, require_processable
from survey.plan.choices import Choices, Device, choices_of
from survey.plan.decisions import Decision, require_placeable
from survey.plan.plan import device_decision
from survey.plan.run_plan import RunPlan, plan_run
from survey.plan.tile_choice import SHARED, require_dask
from survey.plan.workload import require_room, workload_of_images
from survey.progress import Progress, opened
from survey.run.folder import RunDir
from survey.run.repeat import Truth
from survey.run.result import Owner
from survey.settings.tables import ProcessConfig
from survey.sfm.distributed import computing_on

if TYPE_CHECKING:
    from survey.run.job import Job
    from survey.sfm.distributed import Workers

QUALITY_GATE_FAILED = 3


def process(
    survey_folder: str | Path,
    run_folder: str | Path | None = None,
    *,
    quality: str | None = None,
    device: str | None = None,
    resume: bool = True,
    field: str | None = None,
    target_std_m: float | None = None,
    time_budget_s: float | None = None,
    chooses_workers: bool = False,
    poses: str | None = None,
    image_scale: float | None = None,
    calibrate_water: bool | None = None,
    true_colour: bool | None = None,
    tiles: int | None = None,
    memory: str | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    reference: str | Path | None = None,
    visible: str | Path | None = None,
) -> int:
    """Compute the point cloud of the bed, with a report, in a run folder.

    Parameters that are not given are those in [process] of survey.toml, else the defaults. Raises SurveyError or
    GeoError where the input is at fault.

    Parameters
    ----------
    survey_folder : str or Path
    run_folder : str or Path, optional
        Default ``survey_folder/bathynerf``. A URL, as "s3://bucket/run": results are put there, what is finished there
        is taken up, and the run works in a hidden folder of the survey.
    quality : "draft", "standard" or "fine", optional
        Default "standard", unless it is chosen by one of the next two.
    device : "auto", "cpu" or "cuda", optional
    field : "auto", "solver", "boxes", "off" or a model of `fields.models.IN_LAYER`, optional
        What refines the heights of the sweep: least squares over all photographs, with boxes or alone, nothing, or a
        field trained in a layer about them, for ``render --field``; "auto" leaves it to the plan.
    target_std_m : [m], optional
        Standard deviation that is wanted on 95 % of the ground: the least work that is foreseen to reach it.
    time_budget_s : [s], optional
        What the run may take until the report: the best that is foreseen to fit.
    chooses_workers : bool
        Choose ``workers`` by tiles, cores and memory where no number is given, as the command line does.
    poses : "auto", "fixed" or "refine", optional
        Whether poses and lens are adjusted together with the water; "auto" leaves it to the plan.
    image_scale : float, optional
        At which photographs are worked on: 1, a half, a quarter, ...; default by their size and the quality.
    resume : bool
        Use what an earlier run in this folder finished, where nothing that it depends on has changed.
    calibrate_water : bool, optional
        First estimate level, slopes and index of the water from the photographs; those that are not observable keep
        their given values.
    true_colour : bool, optional
        Give the points the bed's own colour, the water taken away, instead of the photographs'.
    tiles : int, optional
        Rectangles of the ground that are worked on one after the other; default: as the memory asks for.
    memory : str, optional
        Memory that the run may take, as "8GB"; default: most of what is free.
    workers : int, optional
        Processes that compute tiles; default one, unless ``chooses_workers``. Of a scheduler those that are waited
        for. A script that gives more than one needs ``if __name__ == "__main__":``, as each process loads it again.
    scheduler : str, optional
        Address of a Dask scheduler whose workers compute tiles, features and matches, as "tcp://host:8786".
    reference, visible : str or Path, optional
        True surface and the points of it that cameras see, for the report; the reconstruction never reads them.

    Returns
    -------
    int
        0, or 3 where a quality gate failed; all outputs are written either way.
    """
    began = time.monotonic()
    survey_folder = Path(survey_folder)
    url = str(run_folder) if is_url(run_folder) else None
    run_folder = local_run(survey_folder, run_folder)
    truth = Truth(*(None if path is None else Path(path) for path in (reference, visible)))
    _require_inputs(survey_folder, run_folder, truth)
    asked = ProcessConfig(
        quality=quality,
        target_std_m=target_std_m,
        time_budget_s=time_budget_s,
        device=device,
        field=field,
        poses=poses,
        image_scale=image_scale,
        calibrate_water=calibrate_water,
        true_colour=true_colour,
        tiles=tiles,
        memory=memory,
        workers=workers,
        scheduler=scheduler,
    )
    chosen = choices_of(asked.over(process_config(survey_folder)))
    checked = _require_possible(survey_folder, chosen)
    with opened() as progress, progress.run(), _run_in(run_folder, url) as run:
        _claim(run, checked.found)
        progress.log_to(run.log_path)
        if checked.level_warning is not None:
            progress.warn(checked.level_warning)
        survey = checked.survey or _with_poses(checked, chosen, run, progress)
        aim = None
        if chosen.aim is not None:
            chosen, aim = _for_aim(
                survey, chosen, time.monotonic() - began, progress, refuses=checked.survey is not None
            )
        earlier = run.latest_stage_json(SHARED).get("tiles")
        planned = plan_run(survey, chosen, aim=aim, chooses_workers=chooses_workers, earlier_tiles=earlier)
        _announce(survey, planned, run, progress)
        # Starts torch and Dr.Jit: only after everything that the user may have to fix was checked.
        from survey.run.job import Job

        job = Job(survey, chosen, progress, planned=planned, workspace=run.sfm_path, scratch=run.scratch_path)
        return _to_the_end(run, job, truth, began, resume=resume)


def _require_inputs(survey_folder: Path, run_folder: Path, truth: Truth) -> None:
    """Raise where a reference is missing, or the run would overwrite one of its inputs."""
    for name, path in (("--reference", truth.reference), ("--visible", truth.visible)):
        if path is not None and not path.exists():
            raise SurveyError(f"{name} {path} does not exist; give the path of a PLY, OBJ, LAS or LAZ file")
    require_folder("-o", run_folder, survey_inputs(survey_folder) + ReadFiles.of(truth.reference, truth.visible))


def _run_in(folder: Path, url: str | None) -> RunDir:
    if url is None:
        return RunDir(folder)
    from survey.run.remote_run import RemoteRun

    return RemoteRun(folder, Remote(url))


def _claim(run: RunDir, found: Found) -> None:
    """Raise where the run folder belongs to another survey."""
    name = found.config.name or found.folder.resolve().name
    is_inside = run.path.resolve().is_relative_to(found.folder.resolve())
    run.claim(Owner.of(name, found.images), is_inside=is_inside)


def _require_possible(survey_folder: Path, chosen: Choices) -> Checked:
    """Contents of the survey folder; raise where it cannot be processed with the chosen options."""
    if chosen.device == Device.cuda:
        device_decision(chosen.device)
    require_dask(chosen)
    checked = require_processable(survey_folder)
    if checked.found.config.water is None and (chosen.true_colour or chosen.calibrate_water):
        option = "--true-colour takes the water away" if chosen.true_colour else "--calibrate-water estimates the water"
        raise SurveyError(f"{option}, but the survey has none; leave the option out, or give [water]")
    require_placeable(checked.found.config.control.reference, chosen.poses)
    return checked


def _with_poses(checked: Checked, chosen: Choices, run: RunDir, progress: Progress) -> Survey:
    """The survey with poses from structure from motion, on the workers of a scheduler where there is one."""
    found = checked.found
    workload = workload_of_images([header.size_px for header in found.headers.values()], chosen)
    progress.note(f"workload: {workload}")
    progress.expect(workload.parts_s)

    def workers() -> AbstractContextManager[Workers]:
        from survey.run.start_workers import WorkerNeeds, workers_for

        needs = WorkerNeeds(run.stages_path, next(iter(found.images.values())))
        return workers_for(chosen.workers or 1, chosen.scheduler, needs, progress.note)

    # By the URL of a run workers do not see the photographs before a task names them.
    spreads = chosen.scheduler is not None and type(run) is RunDir
    with computing_on(workers) if spreads else nullcontext():
        return load_survey(found.folder, found=found, workspace=run.sfm_path, report=progress.note)


def _for_aim(
    survey: Survey, chosen: Choices, gone_s: float, progress: Progress, *, refuses: bool
) -> tuple[Choices, Decision]:
    """The choices with quality and image scale for their aim, and the decision on these."""
    # Loads the adjustment, which most runs do not need before their stages.
    from survey.run.aim import plan_for_aim

    aimed = plan_for_aim(survey, chosen, gone_s=gone_s, refuses=refuses)
    progress.note(f"asked: {chosen.aim}")
    for text in aimed.warnings:
        progress.warn(text)
    return aimed.chosen, aimed.decision


def _announce(survey: Survey, planned: RunPlan, run: RunDir, progress: Progress) -> None:
    """Print plan and workload; raise where memory or disk cannot suffice."""
    plan, workload = planned.plan, planned.workload
    progress.note(f"{survey.name}: {len(survey.views)} views, a pixel covers {length(plan.gsd_m)} of the ground")
    for text in survey.findings.assumptions:
        progress.note(f"assumed: {text}")
    for text in survey.findings.warnings:
        progress.warn(text)
    for decision in plan.decisions:
        progress.note(f"plan: {decision.name}: {decision.choice} ({decision.reason})")
    progress.note(f"workload: {workload}")
    for text in (*planned.warnings, *require_room(workload, run.path)):
        progress.warn(text)
    progress.expect(workload.parts_s)


def _import_products(job: Job) -> None:
    # Before, each read releases the GIL to this thread, which holds it for 5 ms (sys.getswitchinterval).
    job.waits_for_kernels.wait()
    with suppress(Exception):
        import survey.run.products  # noqa: F401


def _to_the_end(run: RunDir, job: Job, truth: Truth, began: float, *, resume: bool) -> int:
    """Stages, result and verdict; the exit code."""
    from survey.run.execution import run_stages, workers_of

    # The report takes half a second to import, beside the kernels of the sweep; if it fails, it does so below.
    Thread(target=_import_products, args=(job,), daemon=True).start()
    result = run.open_result(job.plan.quality)
    with workers_of(job, run) as workers:
        done = run_stages(job, run, workers, resume=resume, compares_sweep=truth.reference is not None)
    from survey.run.products import FinishedRun, write_products

    verdict = write_products(FinishedRun(run, job, done, truth, result, time.monotonic() - began))
    run.publish(result, quality=job.plan.quality, stages=done)
    job.progress.detail(f"report: {run.report_html_path}")
    for gate in verdict.gates:
        if not gate.passed:
            job.progress.warn(f"quality gate: {gate.sentence}; all outputs are written")
    return 0 if verdict.passed else QUALITY_GATE_FAILED
