"""The stage before the sweep: the bound of the bed, and the views that get height maps."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

from survey.errors import SurveyError
from survey.files.json_values import read_json_object, write_json
from survey.plan.area import local_area
from survey.plan.choices import required_views
from survey.plan.tiling import SHARED
from survey.run.job import BedSearch
from survey.run.tile_job import TileJob, has_own_ranges

if TYPE_CHECKING:
    from survey.run.job import Job


def find_range(job: Job, folder: Path, _needs: Mapping[str, Path]) -> None:
    """Find the bound by thumbnails, and the views that cover the bed; tile by tile in a large survey."""
    tiles = 1 if job.plan.tiling is None else len(job.plan.tiling)
    water = None if job.survey.water is None else asdict(job.survey.water)
    if job.plan.tiling is not None and has_own_ranges(job.plan.tiling):
        with job.progress.stage("Range of heights", tiles) as stage:
            bounds, views = _of_tiles(job, stage.advance)
        write_json(folder / SHARED, {"bounds": bounds, "views": views, "tiles": tiles, "water": water})
        return
    with job.progress.stage("Range of heights"):
        low, high = job.bound
    job.block.set_overlap_height(0.5 * (low + high))
    times = required_views(job.block.saturated, job.plan.recipe.times_seen)
    views = job.block.cover(*times, local_area(job.survey))
    write_json(folder / SHARED, {"low_m": low, "high_m": high, "views": views, "tiles": tiles, "water": water})


def _of_tiles(job: Job, advance: Callable[[float], None]) -> tuple[list[tuple[float, float]], list[int]]:
    """Bound of the bed in each tile over its own plane [m], and the views that cover it in any.

    A tile with too few matches takes the bound of all others.
    """
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
