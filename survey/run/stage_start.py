"""The stages before the sweep: a test of given poses, the adjustment, the bound of the bed, and views with a map."""

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, replace
from itertools import count
from pathlib import Path
from typing import Any

from survey.adjust import pose_check, refine
from survey.adjust.applied import CAMERAS, MODEL, apply_adjustment, write_cameras
from survey.adjust.block.observed import MATCH
from survey.adjust.pose_check import PoseCheck
from survey.adjust.result.adjustment import ARRAYS, JSON, read_adjustment, write_adjustment
from survey.errors import Findings, GivenValueTest, SurveyError
from survey.files.json_values import read_json_object, write_json
from survey.folder.survey import Survey
from survey.photos.poses import TiePoints
from survey.plan.area import local_area
from survey.plan.choices import required_views
from survey.plan.tiling import SHARED
from survey.run.job import BedSearch, Job
from survey.run.stored import load_arrays, save_arrays
from survey.run.tile_job import TileJob, has_own_ranges

MISFIT = "misfit.json"
FILES = (JSON, ARRAYS, CAMERAS, *MODEL)


def check_poses(job: Job, folder: Path, _needs: Mapping[str, Path]) -> None:
    """Measure the reprojection misfit under the given poses, and test the given water and lens."""
    found = PoseCheck(None)
    with suppress(SurveyError):
        bound, block = job.bound, job.block
        with job.progress.stage("Poses", 1.0) as stage:
            found = pose_check.check_of_windows(job.survey, job.plan, block, bound, stage.advance)
    # Photographs without texture do not match in the sweep either, which reports it.
    if found.misfit_px is None and job.search is not None:
        with suppress(SurveyError):
            found = pose_check.check_of_ties(job.survey, job.plan, MATCH, job.search(job.survey).ties)
    tests, flooded = [asdict(each) for each in found.tests], found.flooded
    record = {"misfit_px": found.misfit_px, "contradictions": tests}
    write_json(folder / MISFIT, {**record, "flooded": None if flooded is None else asdict(flooded)})


def use_misfit(job: Job, folder: Path) -> None:
    """Update the plan by the result; raise where the level leaves dry what photographs show under water."""
    values = read_json_object(folder / MISFIT)
    misfit, flooded = values["misfit_px"], values["flooded"]
    tests = tuple(GivenValueTest(**each) for each in values["contradictions"])
    found = PoseCheck(misfit, tests, None if flooded is None else GivenValueTest(**flooded))
    found.require_water()
    misfit_px = -1.0 if misfit is None else misfit
    provenance = replace(job.survey.provenance, pose_misfit_px=misfit_px, contradiction=found.contradiction)
    job.use_survey(replace(job.survey, provenance=provenance))
    job.progress.detail(f"plan: poses: {job.plan.pose_choice} ({job.plan.pose_reason})")


def adjust_block(job: Job, folder: Path, _needs: Mapping[str, Path]) -> None:
    """Adjust the survey, with the windows of an earlier adjustment where they count; they are kept in the folder."""
    number = count()

    def measure(survey: Survey, **options: Any) -> TiePoints:
        name = f"windows{next(number)}.npz"
        if job.adjusted_before and (job.adjusted_before[0] / name).is_file():
            kept = load_arrays(job.adjusted_before[0] / name)
            found = TiePoints(kept["start"], kept["point"], kept["view"], kept["pixel"], int(kept["least"]))
        else:
            found = refine.measure_windows(survey, **options)
        save_arrays(folder / name, **vars(found))
        return found

    with job.progress.stage("Adjustment", 1.0) as stage:
        found = refine.adjust_survey(
            job.survey,
            device=job.plan.device_asked,
            advance=stage.advance,
            free_water=job.chosen.calibrate_water,
            search=job.search,
            measure=measure,
        )
    write_adjustment(folder, found)
    write_cameras(folder, apply_adjustment(job.survey, found), found)


def use_adjustment(job: Job, folder: Path) -> None:
    """Replace poses, lenses and water of the job by the adjusted ones."""
    found = read_adjustment(folder)
    survey = apply_adjustment(job.survey, found)
    sentences = [f"{row.name} {row.verdict}" for row in found.parameters]
    for text in (*sentences, *found.notes):
        job.progress.detail(f"adjustment: {text}")
    for text in found.warnings:
        job.progress.warn(text)
    job.use_survey(replace(survey, findings=survey.findings + Findings(found.notes, found.warnings)))


def find_range(job: Job, folder: Path, _needs: Mapping[str, Path]) -> None:
    """Find the bound by thumbnails, and the views that cover the bed; tile by tile in a large survey."""
    tiles = 1 if job.plan.tiling is None else len(job.plan.tiling)
    level_m = None if job.survey.config.water is None else job.survey.config.water.level_m
    if job.plan.tiling is not None and has_own_ranges(job.plan.tiling):
        with job.progress.stage("Range of heights", tiles) as stage:
            bounds, views = _of_tiles(job, stage.advance)
        write_json(folder / SHARED, {"bounds": bounds, "views": views, "tiles": tiles, "level_m": level_m})
        return
    with job.progress.stage("Range of heights"):
        low, high = job.bound
    job.block.set_overlap_height(0.5 * (low + high))
    times = required_views(job.block.saturated, job.plan.recipe.times_seen)
    views = job.block.cover(*times, local_area(job.survey))
    write_json(folder / SHARED, {"low_m": low, "high_m": high, "views": views, "tiles": tiles, "level_m": level_m})


def _of_tiles(job: Job, advance: Callable[[float], None]) -> tuple[list[tuple[float, float]], list[int]]:
    """Bound of the bed in each tile over its own plane [m], of all others where too little matches, and its views."""
    found: dict[int, tuple[float, float]] = {}
    views: set[int] = set()
    why: SurveyError | None = None
    count = len(job.plan.tiling or ())
    for number in range(count):
        tile = TileJob(job, number, BedSearch(job.limits, list(range(len(job.survey.views)))))
        if not tile.is_void:
            try:
                found[number] = tile.range_within(tile.bound)
                tile.block.set_overlap_height(0.5 * sum(found[number]))
            except SurveyError as error:
                why = error
            times = required_views(tile.block.saturated, job.plan.recipe.times_seen)
            views |= {tile.windows[view].view for view in tile.block.cover(*times)}
            tile.release()
        advance(1.0)
    if not found:
        raise why or SurveyError("no two photographs overlap; check that the poses belong to the images")
    of_all = min(low for low, _ in found.values()), max(high for _, high in found.values())
    return [found.get(number, of_all) for number in range(count)], sorted(views)


def use_range(job: Job, folder: Path) -> None:
    """Let the parts of the job search the bed there."""
    found = read_json_object(folder / SHARED)
    bounds = found.get("bounds") or [(found["low_m"], found["high_m"])]
    search = BedSearch(
        (min(low for low, _ in bounds), max(high for _, high in bounds)),
        found["views"],
        tuple((low, high) for low, high in bounds) if "bounds" in found else None,
    )
    if job.plan.tiling is None:
        job.search_bed(search)
        return
    tiles = [TileJob(job, number, search) for number in range(len(job.plan.tiling))]
    # To find the windows takes workers as long as this process.
    job.search_bed(replace(search, windows=tuple(tile.windows for tile in tiles)), tiles)
