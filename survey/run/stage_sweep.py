"""The stage of the sweep: a height map of each view that is needed to cover the bed, and its pixels that become points.

A survey in tiles has a sweep for each; their maps are joined to those of whole photographs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from fields.image_store import Masks
from fields.solver.solver import count_in_squares
from fields.sweep.bed import unique_pixels
from fields.sweep.fusion import remove_free_space_violations
from fields.sweep.map_points import places_in_plan
from fields.sweep.maps import HeightMap, views_of
from fields.sweep.passes import PASSES, before_solver, in_area
from fields.sweep.photo_consistency import photo_consistency
from fields.sweep.sweep import sweep
from fields.sweep.view_pass import SweepSettings
from fields.sweep.wide_windows import wet_pairs, with_wide_windows
from survey.errors import SurveyError
from survey.files.json_values import write_json
from survey.plan.area import grown, inside, plane_name
from survey.progress import shares
from survey.run.stored_maps import IN_MEMORY, LiveMaps, Stored, map_store, save_maps, save_masks

if TYPE_CHECKING:
    from fields.sweep.block import Block
    from fields.sweep.maps import OrderedMaps, StoreFactory
    from survey.run.job import Job

MAPS = "maps.npz"
# Of each photograph by its name: the share of white pixels, and whether it shows the bed that was found.
SATURATED, CONSISTENCY = "saturated.json", "consistency.json"
# Masks of each map: pixels that become points, of a tile also those beside it; and in tiles all that show the tile.
KEPT, OWN = "kept.npz", "own.npz"
# Pixels that the solver may learn from, in squares of each map.
SQUARES = "squares.json"
FILES = (MAPS, KEPT, SQUARES, SATURATED, CONSISTENCY)
# In the folder of the stage, while it lasts: maps that are worked on.
SCRATCH = "scratch"
# Points so far beyond a tile count as neighbours of its own [ground sampling distances].
_BESIDE_GSD = 6.0


def sweep_views(job: Job, folder: Path, _needs: Mapping[str, Path]) -> None:
    """Sweep the views that cover the bed, and choose the pixels that become points."""
    job.waits_for_kernels.set()
    if job.is_void:
        save_maps(folder / MAPS, HeightMap, [])
        for name in (KEPT, OWN):
            save_masks(folder / name, [])
        _save_of_photographs(folder, {}, {}, [])
        return
    block, bound = job.block, job.bound
    with job.progress.stage("Sweep", 1.0) as stage:
        passes = before_solver(PASSES) if job.plan.solves else PASSES
        passes = passes if job.cell is None else in_area(passes)
        with map_store(folder / SCRATCH, HeightMap, show=_live(job, folder)) as make_store:
            settings = SweepSettings(bound, passes, job.swept_ground)
            swept = sweep(block, job.views_to_match, settings, shares(stage), make_store=make_store)
            if not swept and job.cell is None:
                raise SurveyError("no two photographs overlap; check that the poses belong to the images")
            finished = _finished(block, swept, make_store)
            finished = with_wide_windows(block, finished, bound, job.swept_ground, make_store)
            save_maps(folder / MAPS, HeightMap, finished)
            consistency = photo_consistency(block, finished, job.whole_camera)
    job.progress.detail(f"bound: bed between {bound[0]:.2f} and {bound[1]:.2f} m over the {plane_name(job.survey)}")
    names = [view.name for view in job.survey.views]
    _save_of_photographs(
        folder,
        dict(zip(names, block.saturated, strict=True)),
        {name: asdict(each) for name, each in zip(names, consistency, strict=False)},
        _choose_pixels(job, folder),
    )


def _live(job: Job, folder: Path) -> Callable[[HeightMap], None]:
    """Callback that writes maps for the viewers of a run; ``folder`` is that of the stage."""
    return LiveMaps(folder.parent.parent, job, folder.stem.strip(".")).show


def _finished(block: Block, maps: OrderedMaps, make_store: StoreFactory) -> OrderedMaps:
    """Maps of a sweep without heights that other views contradict."""
    found = remove_free_space_violations(block, maps, make_store)
    maps.clear()
    return found


def _choose_pixels(job: Job, folder: Path) -> list[list[int]]:
    """Write the pixels of the maps that become points; those of them that the solver may learn from, in squares."""
    block, maps = job.block, Stored(folder / MAPS, HeightMap, IN_MEMORY)
    kept = unique_pixels(block, maps, job.plan.gsd_m)
    save_masks(folder / KEPT, kept)
    if job.cell is None:
        return count_in_squares(block, maps, solvable(block, maps, kept))
    own, around = kept.copy(), grown(job.cell, _BESIDE_GSD * job.plan.gsd_m)
    for number, m in enumerate(maps):
        places = places_in_plan(block, m, job.in_survey if job.has_frame else None)
        kept[number] = kept[number] & inside(places, around)
        own[number] = inside(places, job.cell)
    save_masks(folder / KEPT, kept)
    save_masks(folder / OWN, own)
    for number in range(len(maps)):
        kept[number] = kept[number] & own[number]
    return count_in_squares(block, maps, solvable(block, maps, kept))


def solvable(block: Block, maps: Sequence[HeightMap], kept: Masks) -> Masks:
    """The kept pixels of maps that are solved: single pixels of two photographs show ripples, which moved."""
    found, views = kept.copy(), views_of(maps)
    pairs = wet_pairs(block, views)
    for number, view in enumerate(views):
        if view in pairs:
            found[number] = found[number] & (maps[number].height >= 0.0)
    return found


def _save_of_photographs(
    folder: Path, saturated: Mapping[str, float], consistency: Mapping[str, dict], squares: list[list[int]]
) -> None:
    write_json(folder / SATURATED, saturated)
    write_json(folder / CONSISTENCY, consistency)
    write_json(folder / SQUARES, {"pixels": squares})
