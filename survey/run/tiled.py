"""The stages of a run in tiles.

    pose_check, adjust -> tiles -> sweep of each tile -> sweep -> figures -> solver of each tile -> solver
    -> water_colour -> bed of each tile -> bed

The block is adjusted as a whole; the bound, the views with a height map and the figures of the solver are found once
for all tiles. What tiles find is put together in the form that a run in one piece leaves: all that follows is the same.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import wraps
from pathlib import Path

from survey.plan.tile_choice import SHARED
from survey.run.folder import RunDir
from survey.run.job import Job
from survey.run.merged import merge_points, merge_solved, merge_sweeps
from survey.run.pipeline import STAGES
from survey.run.stage import Stage, run_stage
from survey.run.stage_of_tile import FIGURES, POINTS, find_points, learn_figures, solve_tile, sweep_tile
from survey.run.stage_sweep import MAPS
from survey.run.stage_tiles import find_shared, read_shared
from survey.run.tile_job import MASKS, TileJob
from survey.run.tile_workers import TileWorkers

# Gets the job, the folder to write to, the tiles, the folders of their stages by name, and those of other stages.
Merge = Callable[[Job, Path, Sequence[TileJob], Mapping[str, list[Path]], Mapping[str, Path]], None]

_OF = {stage.name: stage for stage in STAGES}
_TILES = Stage("tiles", (), (*_OF["sweep"].depends_on, "tiles"), (SHARED,), find_shared)
# Of one tile, by the name of what they are a part of.
_SWEEP = replace(_OF["sweep"], needs=(), files=(MAPS, MASKS), compute=sweep_tile, apply=None)
_SOLVER = replace(_OF["solver"], needs=("sweep", "figures"), compute=solve_tile)
_BED = replace(_OF["bed"], needs=("sweep", "solver"), files=(POINTS,), compute=find_points)


def run_tiled(job: Job, run: RunDir, *, resume: bool) -> dict[str, Path]:
    """Run the stages of a job with a tiling; the folders of the stages by name."""
    if job.tiling is None or job.tiles is None:
        raise ValueError("expected a job with tiles")
    done: dict[str, Path] = {}
    tiles: list[TileJob] = []

    def step(stage: Stage, of: Job = job) -> None:
        if stage.is_on(of):
            done[stage.name] = run_stage(stage, of, run, done, resume=resume)

    with ExitStack() as stack:
        workers = TileWorkers(job, run, stack) if job.tiles.workers > 1 or job.chosen.scheduler is not None else None

        def step_of_tiles(stage: Stage) -> None:
            if workers is not None:
                parts = [(_of_tile(stage, tile), tile) for tile in tiles]
                done.update(workers.run(stage, parts, done, shared, resume=resume))
                return
            for tile in tiles:
                step(_of_tile(stage, tile), tile)
                tile.drop()

        for stage in STAGES:
            if stage.name == "sweep":
                step(_TILES)
                shared = read_shared(done["tiles"])
                tiles += [TileJob(job, number, shared) for number in range(len(job.tiling))]
                step_of_tiles(_SWEEP)
                step(_over(stage, merge_sweeps, tiles, ("sweep",)))
            elif stage.name == "solver" and stage.is_on(job):
                step(_over(replace(stage, name="figures", files=(FIGURES,)), learn_figures, tiles, ("sweep",)))
                step_of_tiles(_SOLVER)
                step(_over(stage, merge_solved, tiles, ("sweep", "solver")))
            elif stage.name == "bed":
                step_of_tiles(_BED)
                step(_over(stage, merge_points, tiles, ("bed",)))
            elif stage.name != "solver":
                step(stage)
    return done


def _name(stage: str, tile: TileJob) -> str:
    return f"{stage}_tile{tile.number + 1}"


def _of_tile(stage: Stage, tile: TileJob) -> Stage:
    """The stage of one tile, which needs those of the same tile and what all share."""
    own = {_name(name, tile): name for name in stage.needs if name in ("sweep", "solver")}
    shared = tuple(name for name in stage.needs if name not in own.values())

    @wraps(stage.compute)
    def compute(of: Job, folder: Path, needs: Mapping[str, Path]) -> None:
        stage.compute(of, folder, {own.get(name, name): place for name, place in needs.items()})

    return replace(stage, name=_name(stage.name, tile), needs=(*own, *shared), compute=compute)


def _over(stage: Stage, merge: Merge, tiles: Sequence[TileJob], of_tiles: tuple[str, ...]) -> Stage:
    """A stage of the whole survey that puts stages of tiles together."""
    names = {name: [_name(name, tile) for tile in tiles] for name in of_tiles}
    own = tuple(each for of_name in names.values() for each in of_name)

    @wraps(merge)
    def compute(job: Job, folder: Path, needs: Mapping[str, Path]) -> None:
        found = {name: [needs[each] for each in of_name] for name, of_name in names.items()}
        merge(job, folder, tiles, found, {name: place for name, place in needs.items() if name not in own})

    shared = ("adjust",) if "adjust" in stage.needs else ()
    return replace(stage, needs=(*own, *shared), compute=compute)
