"""The stage of the sweep: the bound of the bed, and a height map of each view that is needed to cover it."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from fields.sweep.fusion import remove_free_space_violations
from fields.sweep.maps import HeightMap
from fields.sweep.passes import PASSES, before_solver, in_area
from fields.sweep.photo_consistency import photo_consistency
from fields.sweep.sweep import sweep
from fields.sweep.view_pass import SweepSettings
from fields.sweep.wide_windows import with_wide_windows
from survey.errors import SurveyError
from survey.files.json_values import write_json
from survey.plan.area import plane_name
from survey.progress import shares
from survey.run.stored_maps import LiveMaps, map_store, save_maps

if TYPE_CHECKING:
    from fields.sweep.block import Block
    from fields.sweep.maps import OrderedMaps, StoreFactory
    from survey.run.job import Job

MAPS, BOUND = "maps.npz", "bound.json"
# Of each photograph by its name: the share of white pixels, and whether it shows the bed that was found.
SATURATED, CONSISTENCY = "saturated.json", "consistency.json"
# In the folder of the stage, while it lasts: maps that are worked on.
SCRATCH = "scratch"


def sweep_views(job: Job, folder: Path, _needs: Mapping[str, Path]) -> None:
    """Sweep the views that cover the bed."""
    job.waits_for_kernels.set()
    block = job.block
    with job.progress.stage("Sweep", 1.0) as stage:
        low, high = job.bound
        block.set_overlap_height(0.5 * (low + high))
        chosen = job.views_to_match()
        heights = (low, high) if job.plan.skips.heights else job.limits
        passes = before_solver(PASSES) if job.plan.refines_points_only else PASSES
        passes = passes if job.tiling is None else in_area(passes)
        with map_store(folder / SCRATCH, HeightMap, show=_live(job, folder)) as make_store:
            settings = SweepSettings(heights, passes, job.swept_ground)
            maps = sweep(block, chosen, settings, shares(stage), make_store=make_store)
            if not maps and job.tiling is None:
                raise SurveyError("no two photographs overlap; check that the poses belong to the images")
            finished = _finished(block, maps, make_store)
            _save(job, folder, with_wide_windows(block, finished, heights, job.swept_ground, make_store))
    job.progress.note(f"bound: bed between {low:.2f} and {high:.2f} m over the {plane_name(job.survey)}")
    write_json(folder / BOUND, {"low_m": low, "high_m": high})


def _live(job: Job, folder: Path) -> Callable[[HeightMap], None]:
    """Callback that writes maps for the viewers of a run; ``folder`` is that of the stage."""
    return LiveMaps(folder.parent.parent, job, folder.stem.strip(".")).show


def _finished(block: Block, maps: OrderedMaps, make_store: StoreFactory) -> OrderedMaps:
    """Maps of a sweep without heights that other views contradict."""
    found = remove_free_space_violations(block, maps, make_store)
    maps.clear()
    return found


def _save(job: Job, folder: Path, maps: Sequence[HeightMap]) -> None:
    save_maps(folder / MAPS, HeightMap, maps)
    names = [view.name for view in job.survey.views]
    write_json(folder / SATURATED, dict(zip(names, job.block.saturated, strict=True)))
    found = photo_consistency(job.block, maps, job.whole_camera)
    write_json(folder / CONSISTENCY, {name: asdict(each) for name, each in zip(names, found, strict=False)})


def restore_overlap_height(job: Job, folder: Path) -> None:
    """Set the height of the bed at which a block counts overlap to that at the end of the sweep in a folder."""
    bound = json.loads((folder / BOUND).read_text(encoding="utf-8"))
    job.block.set_overlap_height(0.5 * (bound["low_m"] + bound["high_m"]))
