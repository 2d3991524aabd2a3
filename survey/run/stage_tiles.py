"""The stage before the tiles of a survey: what they share, the bound of the bed and the views that get height maps."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from survey.errors import SurveyError
from survey.files.json_values import read_json_object, write_json
from survey.plan.recipe import required_views
from survey.plan.tile_choice import SHARED
from survey.run.tile_job import TileJob, TilePlan
from survey.run.windows import has_frames

if TYPE_CHECKING:
    from survey.run.job import Job


def find_shared(job: Job, folder: Path, _needs: Mapping[str, Path]) -> None:
    """Find the bound by thumbnails, and the views that cover the bed; tile by tile where these have local frames."""
    block = job.block
    if job.tiling is not None and has_frames(job.tiling):
        with job.progress.stage("Range of heights", len(job.tiling)) as stage:
            bounds, views = _of_tiles(job, stage.advance)
        write_json(folder / SHARED, {"bounds": bounds, "views": views, "tiles": len(job.tiling)})
        return
    with job.progress.stage("Range of heights"):
        low, high = job.bound
    block.set_overlap_height(0.5 * (low + high))
    count = 1 if job.tiling is None else len(job.tiling)
    write_json(folder / SHARED, {"low_m": low, "high_m": high, "views": job.views_to_match(), "tiles": count})


def _of_tiles(job: Job, advance: Callable[[float], None]) -> tuple[list[tuple[float, float]], list[int]]:
    """Bound of the bed in each tile over its own plane [m], and the views that cover it in any.

    A tile with too few matches takes the bound of all others.
    """
    found: dict[int, tuple[float, float]] = {}
    views: set[int] = set()
    why: SurveyError | None = None
    count = len(job.tiling or ())
    for number in range(count):
        tile = TileJob(job, number, TilePlan.of_search(job))
        if not tile.is_void:
            try:
                found[number] = tile.range_of_heights()
                tile.block.set_overlap_height(0.5 * sum(found[number]))
            except SurveyError as error:
                why = error
            times = required_views(tile.block.saturated, job.plan.recipe.times_seen)
            views |= {tile.windows[view].view for view in tile.block.cover(*times)}
            tile.drop()
        advance(1.0)
    if not found:
        raise why or SurveyError("no two photographs overlap; check that the poses belong to the images")
    of_all = min(low for low, _ in found.values()), max(high for _, high in found.values())
    return [found.get(number, of_all) for number in range(count)], sorted(views)


def read_shared(folder: Path) -> TilePlan:
    """Result of `find_shared`."""
    found = read_json_object(folder / SHARED)
    if "bounds" not in found:
        return TilePlan((found["low_m"], found["high_m"]), found["views"])
    bounds = tuple((low, high) for low, high in found["bounds"])
    return TilePlan((min(low for low, _ in bounds), max(high for _, high in bounds)), found["views"], bounds)


def tiles_of(job: Job, folder: Path) -> tuple[list[TileJob], TilePlan]:
    """The tiles of a job by the result of `find_shared`, and what they share."""
    shared = read_shared(folder)
    tiles = [TileJob(job, number, shared) for number in range(len(job.tiling or ()))]
    # To find the windows takes workers as long as this process.
    return tiles, replace(shared, windows=tuple(tile.windows for tile in tiles))
