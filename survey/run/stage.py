"""A stage of a run, as data: inputs, outputs, dependencies, and the function that computes it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from survey.run.folder import RunDir
from survey.run.keys import Key
from survey.stage_key import code_hash

if TYPE_CHECKING:
    from survey.run.job import Job

# What gives the photographs to all stages.
LOADING = ("survey.plan.sweep_block", "survey.photos.images", "survey.run.windows")

Compute = Callable[["Job", Path, Mapping[str, Path]], None]


@dataclass(frozen=True)
class Stage:
    """Step from photographs to points, whose result is kept in the run folder."""

    name: str
    needs: tuple[str, ...]  # Stages whose results it reads; those that a run leaves out are left out here too
    depends_on: tuple[str, ...]  # Parts of the job that decide its result; see `Job.hash_of_part`
    files: tuple[str, ...]  # Files in its folder
    # callable: gets the job, the folder to write to, and the folders of the stages that it needs, by name. The code
    # that this function's module reaches by imports is a part of what the stage depends on.
    compute: Compute
    is_on: Callable[[Job], bool] = lambda _job: True  # callable: whether a job has this stage
    # callable, optional: changes the job by the result in a folder, whether computed now or earlier
    apply: Callable[[Job, Path], None] | None = None

    def key(self, job: Job, done: Mapping[str, Path]) -> Key:
        """Dependencies of the result, given the folders of the stages before."""
        parts = {name: job.hash_of_part(name) for name in self.depends_on}
        # The name of a stage's folder ends in the hash of all that it depends on.
        parts |= {name: done[name].name for name in self.needs if name in done}
        return Key(parts | {"code": code_hash(self.compute.__module__, *LOADING)})


def run_stage(
    stage: Stage, job: Job, run: RunDir, done: Mapping[str, Path], *, resume: bool, explains: bool = True
) -> Path:
    """The folder of a stage: the one in the run where it is still right, else computed now.

    ``explains`` says why it is computed again where the run has results of it.
    """
    key = stage.key(job, done)
    folder = finished(stage, key, job, run, resume=resume, explains=explains)
    if folder is None:
        temp = run.open_stage(stage.name)
        stage.compute(job, temp, {name: done[name] for name in stage.needs if name in done})
        folder = finish(stage, key, run, temp)
        job.release()
    if stage.apply is not None:
        stage.apply(job, folder)
    return folder


def finished(stage: Stage, key: Key, job: Job, run: RunDir, *, resume: bool, explains: bool = True) -> Path | None:
    """The folder of a stage in the run where it is still right; None, and why, where it has to be computed."""
    folder = run.finished_stage(stage.name, key, stage.files) if resume else None
    if folder is not None:
        job.progress.note(f"{stage.name}: used again, nothing that it depends on has changed")
        return folder
    why = run.why_again(stage.name, key) if resume else "--no-resume"
    if explains and why is not None:
        job.progress.note(f"{stage.name}: computed again: {why}")
    return None


def finish(stage: Stage, key: Key, run: RunDir, temp: Path, seconds: float | None = None) -> Path:
    """Give what a stage has left in a folder its place in the run; ``seconds`` where a worker made it."""
    missing = [name for name in stage.files if not (temp / name).is_file()]
    if missing:
        raise RuntimeError(f"the stage {stage.name} left no {', '.join(missing)}")
    return run.finish_stage(stage.name, key, temp, seconds)
