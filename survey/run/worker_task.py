"""A task of a worker process: one stage of one tile, computed from what the run has saved of its job.

A worker keeps the job that it saw last. What it leaves is whole, in a folder of its own; so a task may be computed
twice, and a worker may end at any time.

What a worker that shares no disk with the run needs comes from the URL of the run, and goes there. Photographs come
from where the survey has them, if that is a URL, else from the URL of the run, where the run has put them. Such a
worker keeps those of one tile, and decodes them itself.
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
from tempfile import TemporaryDirectory
from typing import cast

import numpy as np

from fields.image_store import GreyImages
from fields.sweep.block import Block
from geo.files import reporting_disk_errors
from survey.errors import SurveyError
from survey.files.remote import Remote, is_url
from survey.folder.survey import Survey
from survey.photos.cameras import View
from survey.photos.images import ImageStore, fetched_tags
from survey.plan.choices import Choices
from survey.plan.plan import Plan, device_decision
from survey.plan.sweep_block import backend, grey_image
from survey.progress import Progress
from survey.run.job import BedSearch, Job
from survey.run.remote_run import JOBS, PARTS, PHOTOGRAPHS
from survey.run.stored import ArrayFiles
from survey.run.tile_job import TileJob
from survey.stage_key import code_hash, content_hash

ANOTHER_VERSION = "another version of bathynerf than the run; install the same on all, and start the workers again"
# URL and name of a file, and its tag where it may change there; else an empty one.
Source = tuple[str, str, str]
# Kinds and texts of what a task has to say.
Messages = list[tuple[str, str]]


@dataclass(frozen=True)
class Task:
    """Task of a worker: a stage of a tile."""

    name: str  # Of the stage
    tile: int
    # callable: as `survey.run.stages.Stage.compute`; cloudpickle carries it
    compute: Callable[[Job, Path, Mapping[str, Path]], None]
    needs: Mapping[str, Path]  # mapping: folders of the stages that it needs, by the names that ``compute`` knows
    cost: int = 0  # Expected, in pixels: the longest are to begin first


def save_job(job: Job, folder: Path, stage: str, remote: Remote | None = None) -> str:
    """Write what workers have to know of a job for a stage, with what else they need at a URL; its path or name there.

    Each file has a name of its own: workers of a cluster outlive a run, and keep the job by this name.
    """
    path, sources = folder / f"{stage}-{uuid.uuid4().hex}.pickle", dict[str, Source]()
    if remote is None:
        # The working directory of workers may be another; grey images lie in files already.
        survey = replace(_with_paths(job.survey, Path.absolute), folder=job.survey.folder.absolute())
    else:
        places = _sources(job.survey, remote)
        survey = _with_paths(job.survey, lambda photograph: Path(_worker_name(places[photograph])))
        sources = {_worker_name(source): source for source in places.values()}
    images = job.block.images if remote is None else None
    parts = (survey, job.chosen, job.plan, job.bed_search, images, job.block.saturated), sources
    with reporting_disk_errors(path):
        path.write_bytes(pickle.dumps(parts))
    if remote is None:
        return str(path.absolute())
    remote.put({f"{JOBS}/{path.name}": path})
    path.unlink()
    return f"{JOBS}/{path.name}"


def _with_paths(survey: Survey, place: Callable[[Path], Path]) -> Survey:
    views = [
        replace(view, path=place(view.path), mask_path=None if view.mask_path is None else place(view.mask_path))
        for view in survey.views
    ]
    return replace(survey, views=tuple(views))


def _worker_name(source: Source) -> str:
    """Name of a file on a worker; its suffix tells the format."""
    return f"{uuid.uuid5(uuid.NAMESPACE_URL, '/'.join(source)).hex}{Path(source[1]).suffix}"


def _sources(survey: Survey, remote: Remote) -> dict[Path, Source]:
    """Places of photographs and masks for workers; those on this machine alone are put to the URL of the run."""
    images, root = survey.config.images, (survey.folder / survey.config.images.local_dir).absolute()
    paths = {path for view in survey.views for path in (view.path, view.mask_path) if path is not None}
    found, to_put, tags = {}, {}, fetched_tags(root)
    for path in sorted(paths):
        if is_url(images.dir) and path.absolute().is_relative_to(root):
            name = path.absolute().relative_to(root).as_posix()
            found[path] = images.dir, name, tags.get(name, "")
        else:
            name = f"{PHOTOGRAPHS}/{content_hash(path)[:32]}{path.suffix}"
            found[path], to_put[name] = (remote.url, name, ""), path
    # A put that was interrupted leaves half a file, where a store has folders.
    sizes_at_url = remote.sizes(PHOTOGRAPHS) if to_put else {}
    sizes = {name: sizes_at_url.get(name.removeprefix(f"{PHOTOGRAPHS}/")) for name in to_put}
    remote.put({name: path for name, path in to_put.items() if sizes[name] != path.stat().st_size})
    return found


def _job_of_parts(
    survey: Survey, chosen: Choices, plan: Plan, search: BedSearch, images: GreyImages, saturated: Sequence[float]
) -> Job:
    """Job of a survey on a worker, with grey images of the whole photographs."""
    # The device is that of the worker.
    plan = replace(plan, device=device_decision(chosen.device).choice)
    job = Job(survey, chosen, plan, _RecordedProgress())
    job.bed_search, middle = search, 0.5 * sum(search.bound)
    job.__dict__["block"] = Block(backend(plan), job.cameras, images, survey.water, middle, saturated)
    return job


@lru_cache(maxsize=1)
def _job_of(name: str, url: str | None) -> _WorkerJob:
    """The job that a worker saw last, as `save_job` wrote it."""
    content = Path(name).read_bytes() if url is None else Remote(url).read(name)
    if content is None:
        raise SurveyError(f"{url}/{name} is not there any more; run the same `bathynerf process` again")
    return _WorkerJob(*pickle.loads(content))


def compute_task(name: str, place: Path | str, task: Task, code: str) -> tuple[str, float, Messages]:
    """Compute a task of a job by its name on a worker: the place of its result, its seconds, and what it had to say.

    ``place`` is the folder of the stages of a run, or its URL: there the result is, too, and of the folders that the
    task needs only the names count.
    """
    if code_hash() != code:
        raise SurveyError(f"a worker on {platform.node()} has {ANOTHER_VERSION}")
    start = time.monotonic()
    if isinstance(place, Path):
        job, folder = _job_of(name, None).job, place / f".{task.name}-{uuid.uuid4().hex[:8]}.part"
        with reporting_disk_errors(folder):
            folder.mkdir()
        try:
            messages = _compute_into(_tile(job, task), task, folder, task.needs)
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        return str(folder), time.monotonic() - start, messages
    kept, remote, result = _job_of(name, place), Remote(place), f"{PARTS}/{task.name}-{uuid.uuid4().hex}"
    tile = _tile(kept.job, task)
    with TemporaryDirectory(prefix="bathynerf-") as scratch:
        folder, needs = Path(scratch) / "result", {}
        folder.mkdir()
        for stage, path in task.needs.items():
            needs[stage] = Path(scratch) / path.name
            remote.fetch_folder(f"stages/{path.name}", needs[stage])
        kept.fetch_photographs(tile)
        messages = _compute_into(tile, task, folder, needs)
        remote.put_folder(folder, result)
    return result, time.monotonic() - start, messages


def _tile(job: Job, task: Task) -> TileJob:
    # Of all tiles their windows alone would take seconds.
    return TileJob(job, task.tile, cast("BedSearch", job.bed_search))


def _compute_into(tile: TileJob, task: Task, folder: Path, needs: Mapping[str, Path]) -> Messages:
    """Compute a task into a folder, from folders of stages; what it had to say."""
    recorded = cast(_RecordedProgress, tile.survey_job.progress)
    recorded.lines.clear()
    try:
        task.compute(tile, folder, needs)
    finally:
        tile.release()
    return list(recorded.lines)


class _WorkerJob:
    """A job on a worker; where photographs have sources, they are fetched and decoded for one tile at a time."""

    def __init__(self, parts: tuple, sources: Mapping[str, Source]):
        self._sources, (survey, chosen, plan, search, images, saturated) = sources, parts
        if images is None:
            self._scratch = TemporaryDirectory(prefix="bathynerf-")
            self._folder = Path(self._scratch.name)
            survey = _with_paths(survey, lambda path: self._folder / path)
            images = self._images = _Decoded(survey.views, self._folder / "grey")
        self.job = _job_of_parts(survey, chosen, plan, search, images, saturated)
        if isinstance(images, _Decoded):
            images.scale, camera = self.job.plan.image_scale, self.job.cameras[0]
            images.size = camera.width, camera.height

    def fetch_photographs(self, tile: TileJob) -> None:
        """Fetch those that show a tile, and their masks; remove those of others."""
        views = [tile.survey_job.survey.views[window.view] for window in tile.windows]
        paths = {path.name: path for view in views for path in (view.path, view.mask_path) if path is not None}
        for path in self._folder.iterdir():
            if path.is_file() and path.name not in paths:
                path.unlink()
        self._images.keep([window.view for window in tile.windows])
        missing = [name for name, path in paths.items() if not path.is_file()]
        for url in {self._sources[name][0] for name in missing}:
            names = [name for name in missing if self._sources[name][0] == url]
            remote = Remote(url)
            remote.fetch({self._sources[name][1]: paths[name] for name in names})
            for name in names:
                _require_same(remote, self._sources[name], paths[name])


def _require_same(remote: Remote, source: Source, path: Path) -> None:
    """Raise where a photograph that was fetched is another than the run saw."""
    _, name, tag = source
    if tag and (found := remote.tag(name)) != tag:
        path.unlink()
        raise SurveyError(
            f"{remote.url}/{name} has changed since the run began (size and tag {found}, expected {tag}); leave "
            "photographs as they are while a run is at work, and run the same `bathynerf process` again"
        )


class _Decoded(GreyImages):
    """Grey images of photographs, decoded when a window of them is asked for, and kept in files; windows alone."""

    def __init__(self, views: Sequence[View], folder: Path):
        self._views, self._folder = views, folder
        self.scale, self.size = 1.0, (0, 0)
        self._decoded: dict[int, GreyImages] = {}

    def __len__(self) -> int:
        return len(self._views)

    def window(self, view: int, rows: slice, columns: slice) -> np.ndarray:
        if view not in self._decoded:
            grey, _ = grey_image(self._views[view], self.scale, self.size, ImageStore(0))
            self._folder.mkdir(exist_ok=True)
            self._decoded[view] = GreyImages([grey], ArrayFiles(self._folder / str(view)))
        return self._decoded[view].window(0, rows, columns)

    def keep(self, views: Sequence[int]) -> None:
        for view in set(self._decoded) - set(views):
            del self._decoded[view]
            shutil.rmtree(self._folder / str(view), ignore_errors=True)


class _RecordedProgress(Progress):
    """Progress of a worker: it shows nothing, and keeps what is said for the process of the run."""

    def __init__(self) -> None:
        super().__init__(verbosity=-2)
        self.lines: Messages = []

    def detail(self, *texts: str) -> None:
        self.lines += [("detail", text) for text in texts]

    def note(self, *texts: str) -> None:
        self.lines += [("note", text) for text in texts]

    def warn(self, text: str) -> None:
        self.lines.append(("warn", text))
