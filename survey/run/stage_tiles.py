"""The stage before the tiles of a survey: what they share, the bound of the bed and the views that get height maps."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from survey.files.json_values import read_json_object, write_json
from survey.plan.tile_choice import SHARED
from survey.run.tile_job import TilePlan

if TYPE_CHECKING:
    from survey.run.job import Job


def find_shared(job: Job, folder: Path, _needs: Mapping[str, Path]) -> None:
    """Find the bound by thumbnails, and the views that cover the bed."""
    block = job.block
    with job.progress.stage("Range of heights"):
        low, high = job.bound
    block.judge_overlap_at(0.5 * (low + high))
    count = 1 if job.tiling is None else len(job.tiling)
    write_json(folder / SHARED, {"low_m": low, "high_m": high, "views": job.views_to_match(), "tiles": count})


def read_shared(folder: Path) -> TilePlan:
    """Result of `find_shared`."""
    found = read_json_object(folder / SHARED)
    return TilePlan((found["low_m"], found["high_m"]), found["views"])
