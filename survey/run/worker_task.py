"""A task of a worker process: one stage of one tile, computed from what the run has saved of its job.

A worker keeps the job that it saw last. What it leaves is whole, in a folder of its own; so a task may be
computed twice, and a worker may end at any time.
"""

from __future__ import annotations

import pickle
import platform
import shutil
import time
import uuid
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, cast

from geo.files import reporting_disk_errors, write_whole
from survey.errors import SurveyError
from survey.progress import Progress
from survey.stage_key import code_hash

if TYPE_CHECKING:
    from fields.image_store import GreyImages
    from survey.folder.survey import Survey
    from survey.plan.choices import Choices
    from survey.plan.plan import Plan
    from survey.run.job import Job
    from survey.run.tile_job import TileJob
    from survey.run.windows import BedSearch

ANOTHER_VERSION = "another version of bathynerf than the run; install the same on all, and start the workers again"


@dataclass(frozen=True)
class Task:
    """Task of a worker: a stage of a tile."""

    name: str  # Of the stage
    tile: int
    # callable: as `survey.run.pipeline.Stage.compute`; cloudpickle carries it
    compute: Callable[[Job, Path, Mapping[str, Path]], None]
    needs: Mapping[str, Path]  # mapping: folders of the stages that it needs, by the names that ``compute`` knows
    cost: int = 0  # Expected, in pixels: the longest are to begin first


def save_job(job: Job, folder: Path, stage: str) -> Path:
    """Write what workers have to know of a job for a stage; its grey images lie in files already.

    Each file has a name of its own: workers of a cluster outlive a run, and keep the job by this name.
    """
    block = job.block
    path = folder / f"{stage}-{uuid.uuid4().hex}.pickle"
    # The working directory of workers may be another.
    survey = replace(with_paths(job.survey, Path.absolute), folder=job.survey.folder.absolute())
    parts = survey, job.chosen, job.plan, job.bed_search, block.images, block.saturated
    with write_whole(path) as stream:
        stream.write(pickle.dumps(parts))
    return path.absolute()


def with_paths(survey: Survey, place: Callable[[Path], Path]) -> Survey:
    """The survey with its photographs and masks elsewhere."""
    views = [
        replace(view, path=place(view.path), mask_path=None if view.mask_path is None else place(view.mask_path))
        for view in survey.views
    ]
    return replace(survey, views=tuple(views))


@lru_cache(maxsize=1)
def _job_of(path: Path) -> Job:
    """The job that `save_job` wrote."""
    return job_of_parts(*pickle.loads(path.read_bytes()))


def job_of_parts(
    survey: Survey, chosen: Choices, plan: Plan, search: BedSearch, images: GreyImages, saturated: Sequence[float]
) -> Job:
    """Job of a survey on a worker, with grey images of the whole photographs."""
    from fields.sweep.block import Block
    from survey.plan.plan import device_decision
    from survey.plan.sweep_block import backend
    from survey.run.job import Job

    # The device is that of the worker.
    plan = replace(plan, device=device_decision(chosen.device).choice)
    job = Job(survey, chosen, plan, _RecordedProgress())
    middle = 0.5 * sum(search.bound)
    job.bed_search = search
    job.__dict__["block"] = Block(backend(plan), job.cameras, images, survey.water, middle, saturated)
    return job


def tile_of(job: Job, number: int) -> TileJob:
    """A tile of a job on a worker; of all tiles their windows alone would take seconds."""
    from survey.run.tile_job import TileJob

    return TileJob(job, number, cast("BedSearch", job.bed_search))


def compute_task(job: Path, stages: Path, task: Task, code: str) -> tuple[Path, float, list[tuple[str, str]]]:
    """Compute a task on a worker: the folder of its result, its seconds, and what it had to say."""
    require_code(code)
    start = time.monotonic()
    tile = tile_of(_job_of(job), task.tile)
    folder = stages / f".{task.name}-{uuid.uuid4().hex[:8]}.part"
    with reporting_disk_errors(folder):
        folder.mkdir()
    try:
        lines = compute_into(tile, task, folder, task.needs)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    return folder, time.monotonic() - start, lines


def require_code(code: str) -> None:
    """Raise where the code of this process is another than that of the run, by its hash."""
    if code_hash() != code:
        raise SurveyError(f"a worker on {platform.node()} has {ANOTHER_VERSION}")


def compute_into(tile: TileJob, task: Task, folder: Path, needs: Mapping[str, Path]) -> list[tuple[str, str]]:
    """Compute a task into a folder, from folders of stages; what it had to say."""
    recorded = cast(_RecordedProgress, tile.survey_job.progress)
    recorded.lines.clear()
    try:
        task.compute(tile, folder, needs)
    finally:
        tile.release()
    return list(recorded.lines)


class _RecordedProgress(Progress):
    """Progress of a worker: it shows nothing, and keeps what is said for the process of the run."""

    def __init__(self) -> None:
        super().__init__(verbosity=-2)
        self.lines: list[tuple[str, str]] = []

    def detail(self, *texts: str) -> None:
        """Record a `Progress.detail`."""
        self.lines += [("detail", text) for text in texts]

    def note(self, *texts: str) -> None:
        """Record a `Progress.note`."""
        self.lines += [("note", text) for text in texts]

    def warn(self, text: str) -> None:
        """Record a `Progress.warn`."""
        self.lines.append(("warn", text))
