"""`bathynerf process`: from a survey folder to a run folder.

    check -> stages (survey.run.pipeline) -> cloud.las -> comparison -> report -> verdict

Stages leave their result in the run folder and are used again while what they depend on is the same. Cloud, report,
settings and plan are the result of a run and take the place of an earlier one together, at the end.
"""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING

from survey import machine
from survey.display.quantities import length
from survey.errors import SurveyError
from survey.files.outputs import ReadFiles, require_folder
from survey.files.remote import Remote, is_url, local_run
from survey.folder.found import Found, process_config, survey_inputs
from survey.folder.survey import Survey, load_survey
from survey.forecast import Forecast
from survey.plan.check import Checked, require_processable
from survey.plan.choices import Choices, Device
from survey.plan.decisions import require_placeable
from survey.plan.plan import device_decision, make_plan
from survey.plan.rates import parts_in_tiles, parts_s
from survey.plan.recipe import aim_and_choices
from survey.plan.tile_choice import SHARED, TileChoice, choose_tiles, require_dask, with_free_cores
from survey.plan.tiling import tile_warnings
from survey.plan.workload import (
    amounts_of_run,
    parts_of_found,
    require_room,
    survey_amounts,
    workload_of,
    workload_of_found,
)
from survey.progress import Progress, opened
from survey.run.aimed_run import AimedRun
from survey.run.clock import Clock
from survey.run.feasibility import begin_aimed_run, require_some_time
from survey.run.folder import RunDir
from survey.run.repeat import Truth
from survey.run.result import Owner
from survey.settings.tables import ProcessConfig
from survey.sfm.distributed import computing_on

if TYPE_CHECKING:
    from survey.run.job import Job
    from survey.sfm.distributed import Workers

QUALITY_GATE_FAILED = 3
# Load of the machine from which the forecast of the time counts it.
_BUSY = 1.3


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
    time_gone_s: float = 0.0,
    chooses_workers: bool = False,
    poses: str | None = None,
    plan: str | None = None,
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

    Parameters that are not given are those in [process] of survey.toml, else the defaults.

    Parameters
    ----------
    survey_folder : str or Path
    run_folder : str or Path, optional
        Default ``survey_folder/bathynerf``. A URL, as "s3://bucket/run": results are put there, what is finished there
        is taken up, and the run works in a hidden folder of the survey.
    quality : "draft", "standard" or "fine", optional
        Default "standard", unless an aim is set by one of the next two.
    device : "auto", "cpu" or "cuda", optional
    field : "auto", "solver", "slab" or "off", optional
        What refines the heights of the sweep: least squares over all photographs, a tensor field trained in a slab,
        for ``render --field``, or nothing; "auto" leaves it to the plan.
    target_std_m : [m], optional
        Standard deviation that is wanted on 95 % of the ground: as little work as reaches it.
    time_budget_s : [s], optional
        What the whole run may take, but for the comparison with a reference: the best that fits.
    time_gone_s : [s]
        How much of that is gone already, with the start of the program.
    chooses_workers : bool
        Choose ``workers`` by tiles, cores and memory where no number is given, as the command line does.
    poses : "auto", "fixed" or "refine", optional
        Whether poses and lens are adjusted together with the water; "auto" leaves it to the plan.
    plan : "auto" or "full", optional
        Leave out what the scene does not need, or nothing: what that costs, docs/plan.md has.
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

    Raises
    ------
    SurveyError, GeoError
        Where the input is at fault.
    """
    survey_folder = Path(survey_folder)
    url = str(run_folder) if is_url(run_folder) else None
    run_folder = local_run(survey_folder, run_folder)
    truth = Truth(*(None if path is None else Path(path) for path in (reference, visible)))
    _require_inputs(survey_folder, run_folder, truth)
    given = ProcessConfig(
        quality=quality,
        target_std_m=target_std_m,
        time_budget_s=time_budget_s,
        device=device,
        field=field,
        poses=poses,
        plan=plan,
        image_scale=image_scale,
        calibrate_water=calibrate_water,
        true_colour=true_colour,
        tiles=tiles,
        memory=memory,
        workers=workers,
        scheduler=scheduler,
    )
    aim, chosen = aim_and_choices(given.over(process_config(survey_folder)))
    require_some_time(aim)
    clock = None if aim is None or aim.seconds is None else Clock(aim.seconds, time_gone_s)
    checked = _require_possible(survey_folder, chosen)
    with opened() as progress, _run_in(run_folder, url) as run:
        _claim(run, checked.found)
        progress.log_to(run.log_path)
        if checked.level_warning is not None:
            progress.warn(checked.level_warning)
        if aim is None:
            _forecast(progress, checked, chosen)
        # By the URL of a run workers do not see the photographs before a task names them.
        spreads = computing_on(partial(_workers_of_sfm, chosen, run, checked.found, progress))
        with spreads if chosen.scheduler is not None and url is None else nullcontext():
            survey = checked.survey or load_survey(
                survey_folder, found=checked.found, workspace=run.sfm_path, report=progress.note
            )
        aimed = None
        if aim is not None:
            aimed = begin_aimed_run(aim, survey, chosen, clock, progress, refuses=checked.survey is not None)
        tiles_chosen = _announce(progress, survey, chosen, aimed, run, chooses_workers)
        # Starts torch and Dr.Jit: only after everything that the user may have to fix was checked.
        from survey.run.job import Job

        job = Job(survey, chosen, progress, aimed=aimed, workspace=run.sfm_path, scratch=run.scratch_path)
        job.take_tiles(tiles_chosen)
        return _to_the_end(run, job, resume, truth)


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


def _workers_of_sfm(chosen: Choices, run: RunDir, found: Found, progress: Progress) -> AbstractContextManager[Workers]:
    """Workers of the scheduler, for features and matches."""
    from survey.run.start_workers import WorkerNeeds, workers_for

    needs = WorkerNeeds(run.stages_path, next(iter(found.images.values())))
    return workers_for(chosen.workers or 1, chosen.scheduler, needs, progress.note)


def _forecast(progress: Progress, checked: Checked, chosen: Choices) -> None:
    """Initialise the remaining time by stated rates and the load of the machine."""
    progress.forecast = Forecast(machine.measure_load().slowdown)
    if checked.survey is not None:
        return
    workload = workload_of_found(checked.found, chosen)
    progress.forecast.expect(parts_of_found(checked.found, chosen))
    if (slowdown := progress.forecast.slowdown) >= _BUSY:
        workload = workload.on_loaded_cores(slowdown)
    progress.note(f"workload: {workload}")


def _announce(
    progress: Progress,
    survey: Survey,
    chosen: Choices,
    aimed: AimedRun | None,
    run: RunDir,
    chooses_workers: bool,
) -> TileChoice:
    """Print plan and cost; raise where memory or disk cannot suffice. Returns the tiles."""
    plan = make_plan(survey, chosen, recipe=None if aimed is None else aimed.recipe)
    progress.note(f"{survey.name}: {len(survey.views)} views, a pixel covers {length(plan.gsd_m)} of the ground")
    for text in survey.findings.assumptions:
        progress.note(f"assumed: {text}")
    for text in survey.findings.warnings:
        progress.warn(text)
    earlier = run.latest_stage_json(SHARED).get("tiles")
    counted = survey_amounts(survey, plan)
    in_one = workload_of(survey, plan, counted)
    is_aimed = aimed is not None
    tiles = choose_tiles(survey, plan, chosen, in_one, is_aimed=is_aimed, earlier=earlier, counted=counted)
    tiles = with_free_cores(tiles, chosen) if chooses_workers else tiles
    for decision in (*plan.decisions, *tiles.decisions):
        progress.note(f"plan: {decision.name}: {decision.choice} ({decision.reason})")
    if aimed is not None:
        # An aim may come to need its largest recipe.
        top = make_plan(survey, chosen, recipe=aimed.recipes[-1])
        workload = workload_of(survey, top).on_loaded_cores(aimed.rates.slowdown)
    else:
        workload = replace(in_one, memory_bytes=int(tiles.memory_bytes))
        if progress.forecast is not None and plan.device == "llvm":
            parts = parts_s(amounts_of_run(survey, plan, counted), machine.num_cores())
            progress.forecast.expect(parts if tiles.tiling is None else parts_in_tiles(parts, len(tiles.tiling)))
            slowdown = progress.forecast.slowdown
            workload = workload if slowdown < _BUSY else workload.on_loaded_cores(slowdown)
    progress.note(f"workload: {'' if aimed is None else 'with the largest recipe, '}{workload}")
    for text in (*tile_warnings(survey, plan, tiles.tiling), *require_room(workload, run.path)):
        progress.warn(text)
    return tiles


def _import_products(job: Job) -> None:
    # Before, each read releases the GIL to this thread, which holds it for 5 ms (sys.getswitchinterval).
    job.waits_for_kernels.wait()
    with suppress(Exception):
        import survey.run.products  # noqa: F401


def _to_the_end(run: RunDir, job: Job, resume: bool, truth: Truth) -> int:
    """Stages, result and verdict; the exit code."""
    from survey.run.execution import run_stages, workers_of

    # The report takes half a second to import, beside the kernels of the sweep; if it fails, it does so below.
    Thread(target=_import_products, args=(job,), daemon=True).start()
    result = run.open_result(job.plan.quality)
    with workers_of(job, run) as workers:
        done = run_stages(job, run, workers, resume=resume, compares_sweep=truth.reference is not None)
        from survey.run.products import FinishedRun, write_products

        finished = FinishedRun(run, job, done, truth, result)
        verdict = write_products(finished, None if workers is None else workers.started)
    run.publish(result, quality=job.plan.quality, stages=done)
    job.progress.detail(f"report: {run.report_html_path}")
    for gate in verdict.gates:
        if not gate.passed:
            job.progress.warn(f"quality gate: {gate.sentence}; all outputs are written")
    return 0 if verdict.passed else QUALITY_GATE_FAILED
