"""Stages of tiles in worker processes: missing results are computed there and moved into the run folder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING

from survey.plan.rates import part_name
from survey.run.stage import Stage, finish, finished
from survey.run.workers import Task, Workers, loaded_code, save_job, workers_for

if TYPE_CHECKING:
    from survey.run.folder import RunDir
    from survey.run.job import Job
    from survey.run.tile_job import TileJob, TilePlan


class TileWorkers:
    """Workers of a run, which are started when there is something to compute.

    Parameters
    ----------
    job : Job
        Of the whole survey.
    run : RunDir
    stack : ExitStack
        At whose end the workers end.
    """

    def __init__(self, job: Job, run: RunDir, stack: ExitStack):
        self._job, self._run, self._stack = job, run, stack
        self._workers: Workers | None = None
        loaded_code()

    def run(
        self,
        whole: Stage,
        parts: Sequence[tuple[Stage, TileJob]],
        done: Mapping[str, Path],
        shared: TilePlan,
        *,
        resume: bool,
    ) -> dict[str, Path]:
        """Run the stages of tiles that a stage of the survey consists of; their folders by name.

        Results are stored as tasks end; messages follow in the order of the tiles.
        """
        found: dict[str, Path] = {}
        left, keys, tasks = [], [], []
        for stage, tile in parts:
            if not stage.is_on(tile):
                continue
            key = stage.key(tile, done)
            folder = finished(stage, key, tile, self._run, resume=resume)
            if folder is not None:
                found[stage.name] = folder
                continue
            needs = {name: done[name].absolute() for name in stage.needs if name in done}
            left.append((stage, tile))
            keys.append(key)
            tasks.append(Task(stage.name, tile.number, stage.compute, needs))
        if not tasks:
            return found
        workers = self._started()
        saved = save_job(self._job, shared, self._run.scratch_path, whole.name)
        said: dict[int, list[tuple[str, str]]] = {}
        title = whole.name.capitalize()
        names = [part_name(title, tile.number, len(parts)) for _, tile in parts]
        title = f"{title} of {len(tasks)} tiles"
        if (forecast := self._job.progress.forecast) is not None:
            forecast.join(names, title, len(tasks) / len(parts))
        with (
            self._job.progress.stage(title, len(tasks)) as step,
            closing(workers.computed(saved, tasks)) as computed,
        ):
            for number, place, seconds, lines in computed:
                stage, _ = left[number]
                found[stage.name] = finish(stage, keys[number], self._run, place, seconds)
                said[number] = lines
                step.advance()
        for number in sorted(said):
            for kind, text in said[number]:
                getattr(self._job.progress, kind)(text)
        return found

    def _started(self) -> Workers:
        if self._workers is None:
            chosen, tiles = self._job.chosen, self._job.tiles
            number = 1 if tiles is None else tiles.workers
            number = (chosen.workers or 1) if chosen.scheduler is not None else number
            photograph = self._job.survey.views[0].path
            with self._job.progress.stage("Workers"):
                self._workers = self._stack.enter_context(
                    workers_for(number, chosen.scheduler, self._run.stages_path, photograph, self._job.progress.note)
                )
        return self._workers
