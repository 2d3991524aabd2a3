"""The results of a run in a folder of their own: cloud, settings with the command that repeats it, plan and report."""

import shlex
import shutil
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

from fields.sweep.maps import HeightMap
from fields.sweep.photo_consistency import Consistency
from geo.las import is_withheld, write_cloud
from geo.ply import write_ply
from geo.shapes import ComputedColumn
from survey.adjust.applied import CAMERAS, MODEL_FOLDER
from survey.adjust.result.adjustment import ARRAYS, JSON, Adjustment, read_adjustment
from survey.compare.figures import Comparison
from survey.display.quantities import foot_m, length, lengths_in_feet
from survey.files.json_values import read_json_object, write_json
from survey.files.toml_table import table_of
from survey.photos.exif import read_exif
from survey.photos.texture import matched_light
from survey.plan.choices import option_of
from survey.plan.tiling import tile_warnings
from survey.report import NUM_STEPS, ReportFacts, write_report
from survey.report.checkpoints import checkpoint_warnings
from survey.report.facts import RunVerdict, WaveFigures, dry_warnings
from survey.report.gap_reasons import with_reasons
from survey.report.photographs import PhotographFigures, left_out_shares, photograph_warnings, photographs_of
from survey.report.seen_cells import SeenCells, cells_of
from survey.run.flight import save_flight
from survey.run.folder import GAPS, RunDir, stage_record, versions
from survey.run.gate import gates_of_aim, verdict_of
from survey.run.job import Job
from survey.run.stage_solver import SIGHTINGS, WAVES, load_surfaces
from survey.run.stage_sweep import CONSISTENCY, MAPS, SATURATED
from survey.run.stored import StoredBed, load_bed, save_arrays
from survey.run.stored_maps import Stored
from survey.settings.config import dump_config
from survey.settings.tables import ProcessConfig

# At which the report asks how complete the cloud is: that of the study which this work follows, and a finer one.
TOLERANCES_M = (0.2, 0.05)


def write_bed_las(
    path: Path,
    stored: StoredBed,
    classification: np.ndarray | None = None,
    total_uncertainty_m: tuple[np.ndarray, np.ndarray] | None = None,
) -> None:
    """The cloud as LAS, or LAZ or COPC by the suffix, with classes (N,) other than its own; see `geo.write_cloud`."""
    bed = stored.bed
    write_cloud(
        path,
        stored.points_crs,
        stored.crs,
        rgb=bed.rgb,
        depth_m=bed.depth,
        std_m=bed.std,
        num_views=bed.num_views,
        incidence_deg=ComputedColumn(np.degrees, bed.incidence),
        is_wet=bed.wet,
        std_common_m=stored.std_common,
        classification=classification,
        user_data=bed.origin,
        total_uncertainty_m=total_uncertainty_m,
    )


def write_bed_ply(path: Path, stored: StoredBed) -> None:
    """The cloud as PLY; see `geo.write_ply`."""
    bed = stored.bed
    scalars = {
        "depth_m": bed.depth,
        "std_m": bed.std,
        "std_common_m": np.full(len(bed), np.nan) if stored.std_common is None else stored.std_common,
        "num_views": bed.num_views,
        "incidence_deg": np.degrees(bed.incidence),
        "withheld": is_withheld(bed.std),
    }
    write_ply(path, stored.points_crs, rgb=bed.rgb, scalars=scalars, crs=stored.crs)


def options_of(job: Job, truth: Mapping[str, Path]) -> dict:
    """Effective options of a run by name, and under ``command`` the command that repeats it."""
    chosen, plan = job.chosen, job.plan
    return {
        "quality": plan.quality,
        "device": plan.device,
        "field": plan.field,
        "poses": plan.pose_choice,
        "image_scale": plan.image_scale,
        "calibrate_water": chosen.calibrate_water,
        "true_colour": chosen.true_colour,
        "tiles": 1 if job.plan.tiling is None else len(job.plan.tiling),
        **({"target_std_m": chosen.target_std_m, "time_budget_s": chosen.time_budget_s} if chosen.has_aim else {}),
        "command": command_of(job, truth),
    }


def command_of(job: Job, truth: Mapping[str, Path]) -> str:
    """The command line of a run, without its run folder; ``truth`` has the files of its reference by their options."""
    words = ["bathynerf", "process", str(job.survey.folder)]
    for field in fields(ProcessConfig):
        name, value = option_of(field.name), getattr(job.chosen, field.name)
        if job.chosen.has_aim and field.name in ("quality", "image_scale"):
            continue
        # A default is stated too where survey.toml has another value.
        is_open = getattr(job.survey.config.process, field.name) in (None, value)
        if value is True or (value is False and not is_open):
            words.append(name if value else name.replace("--", "--no-", 1))
        elif value not in (None, False) and not (value == "auto" and is_open):
            words += [name, str(value)]
    for name, path in truth.items():
        words += [f"--{name}", str(path)]
    return shlex.join(words)


def settings_text(job: Job, options: dict) -> str:
    """The settings of a run as survey.toml has them, with its `options_of` as comments."""
    effect = ", ".join(f"{name} {value}" for name, value in options.items() if name != "command" and value is not None)
    head = (
        "# The settings in effect, with defaults and with what the run found of the water.\n"
        f"# Options in effect: {effect}\n"
        f"# The same run again: {options['command']}\n\n"
    )
    return head + dump_config(replace(job.survey.config, process=ProcessConfig()))


@dataclass(frozen=True)
class FinishedRun:
    run: RunDir
    job: Job
    stages: Mapping[str, Path]  # Their folders, by name
    truth: Mapping[str, Path]  # "reference" and "visible", where they are given
    result: Path  # Folder of the new result; it takes its place in the run afterwards
    seconds: float  # Of the run so far [s]


def write_products(finished: FinishedRun) -> RunVerdict:
    stored, cloud = load_bed(finished.stages["bed"]), finished.result / "cloud.las"
    # Beside the report, which reads it only to compare it.
    with ThreadPoolExecutor(1) as pool:
        written = pool.submit(write_bed_las, cloud, stored)
        if "reference" in finished.truth:
            written.result()
        with lengths_in_feet(foot_m(finished.job.survey.config.report.units, stored.crs)):
            verdict = _write_report(finished, stored)
        written.result()
    return verdict


def _write_report(finished: FinishedRun, stored: StoredBed) -> RunVerdict:
    """Write the report and all results but the cloud."""
    folder, job, progress = finished.result, finished.job, finished.job.progress
    options = options_of(job, finished.truth)
    (folder / "settings.toml").write_text(settings_text(job, options), encoding="utf-8")
    write_json(folder / "plan.json", job.plan.as_dict())
    save_flight(folder, job.survey)
    progress.note(f"{len(stored.bed):,} points of the bed")
    cells = cells_of(job.survey, stored.bed.xyz, job.plan.gsd_m)
    maps = Stored(finished.stages["sweep"] / MAPS, HeightMap)
    with progress.stage("Report", len(job.survey.views) + NUM_STEPS) as stage:
        cells = with_reasons(cells, job.survey, job.plan, maps, stage.advance)
        save_arrays(
            folder / GAPS, codes=cells.gaps, origin=np.array(cells.grid.origin), side=np.array(cells.grid.side_m)
        )
        verdict = verdict_of(job.survey, stored, job.plan.gsd_m, cells)
        verdict = RunVerdict((*verdict.gates, *gates_of_aim(job.chosen, stored, finished.seconds)))
        facts = _facts(finished, stored, options, cells, verdict)
        for text in (*dry_warnings(job.survey, stored.bed), *photograph_warnings(facts.photographs)):
            progress.warn(text)
        progress.detail(*(f"{label}: {share}" for label, share in left_out_shares(facts.photographs)))
        figures = write_report(folder, facts, stage.advance)
    for text in checkpoint_warnings(facts.checkpoints):
        progress.warn(text)
    if (std := figures["height_std_m"]) is not None:
        shared = "" if std.shared is None else f", of which {length(std.shared)} are shared by large parts of the cloud"
        progress.note(f"height, one sigma, all included: {length(std.whole)} (median){shared}")
    return verdict


def _facts(
    finished: FinishedRun, stored: StoredBed, options: dict, cells: SeenCells, verdict: RunVerdict
) -> ReportFacts:
    """The inputs of the report; compares the cloud, and copies the files of the adjustment."""
    survey, plan, done = finished.job.survey, finished.job.plan, finished.stages
    start = time.monotonic()
    comparison = _comparison(finished)
    # Of reused stages the versions of the libraries that computed them, as "torch (sweep)".
    now = versions()
    earlier = {
        f"{name} ({stage})": version
        for stage, place in done.items()
        for name, version in stage_record(place)["versions"].items()
        if version != now.get(name)
    }
    timings = {name: stage_record(place)["seconds"] for name, place in done.items()}
    if survey.config.cameras.poses is None:
        from survey.sfm.poses import seconds_of_solve

        seconds = seconds_of_solve(finished.run.sfm_path)
        timings = timings if seconds is None else {"structure from motion": seconds} | timings
    if comparison is not None:
        timings["comparison"] = time.monotonic() - start
    return ReportFacts(
        survey=survey,
        plan=plan,
        # What [process] asks is in the options in effect.
        settings={name: value for name, value in table_of(survey.config).items() if name != "process"} | options,
        timings=timings,
        bed=stored.bed,
        points_crs=stored.points_crs,
        height_maps=Stored(done["sweep"] / MAPS, HeightMap),
        comparison=comparison,
        versions=now | earlier,
        verdict=verdict,
        adjustment=adjustment_of(finished.result, done),
        std_common=stored.std_common,
        photographs=_photographs(done),
        light=None if survey.water is None else matched_light(survey.views),
        waves=WaveFigures(**read_json_object(done["solver"] / WAVES)) if "solver" in done else None,
        surfaces=load_surfaces(done["solver"], survey) if "solver" in done else None,
        cells=cells,
        headers={view.name: read_exif(view.path) for view in survey.views},
        warnings=tile_warnings(survey, plan),
    )


def _photographs(done: Mapping[str, Path]) -> tuple[PhotographFigures, ...]:
    """Left-out share of each photograph, with that of the solver where it ran."""
    sightings = read_json_object(done["solver"] / SIGHTINGS) if "solver" in done else {}
    consistency = {name: Consistency(**found) for name, found in read_json_object(done["sweep"] / CONSISTENCY).items()}
    return photographs_of(read_json_object(done["sweep"] / SATURATED), sightings, consistency)


def adjustment_of(folder: Path, done: Mapping[str, Path]) -> Adjustment | None:
    """Adjustment of the run, its files copied into the result; None where there was none."""
    if "adjust" not in done:
        return None
    for name in (JSON, ARRAYS, CAMERAS):
        shutil.copyfile(done["adjust"] / name, folder / name)
    # Whole: some models have binary files beside the text.
    shutil.copytree(done["adjust"] / MODEL_FOLDER, folder / MODEL_FOLDER, dirs_exist_ok=True)
    return read_adjustment(folder)


def _comparison(finished: FinishedRun) -> Comparison | None:
    """The cloud against the reference; None where there is none."""
    job, reference = finished.job, finished.truth.get("reference")
    if reference is None:
        return None
    # Loads what compares images too; most runs have nothing to compare with.
    from survey.compare.comparison import CompareOptions, compare_surfaces

    options = CompareOptions(tolerances_m=TOLERANCES_M, visible=finished.truth.get("visible"), bounds=job.survey.bounds)
    job.progress.note(f"comparison of the cloud with {reference.name}")
    found = compare_surfaces(finished.result / "cloud.las", reference, options)
    # The final path, not that of the folder in which the result is written.
    found.figures.circumstances["cloud"] = str(finished.run.cloud_path)
    return found
