"""The stage of the sweep: the bound of the bed, and a height map of each view that is needed to cover it.

In a run with an aim a later round goes on from the heights of the one before, in the views that need it.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from fields.sweep.fusion import remove_free_space_violations
from fields.sweep.maps import ByView, HeightMap
from fields.sweep.passes import PASSES, before_solver, in_area, passes_from
from fields.sweep.photo_consistency import photo_consistency
from fields.sweep.sweep import EarlierMaps, sweep
from fields.sweep.view_pass import SweepSettings
from fields.sweep.wide_windows import with_wide_windows
from survey.errors import SurveyError
from survey.files.json_values import write_json
from survey.plan.area import plane_name
from survey.plan.sweep_block import camera_of
from survey.progress import shares
from survey.run.clock import OutOfTimeError
from survey.run.stored import load_arrays
from survey.run.stored_maps import LiveMaps, Stored, map_store, save_maps

if TYPE_CHECKING:
    from fields.sweep.block import Block
    from fields.sweep.maps import OrderedMaps, StoreFactory
    from survey.run.aimed_run import AimedRun
    from survey.run.job import Job

MAPS, BOUND, SWEPT = "maps.npz", "bound.json", "swept.json"
# Of each photograph by its name: the share of white pixels, and whether it shows the bed that was found.
SATURATED, CONSISTENCY = "saturated.json", "consistency.json"
# Results of the round before, for the stages of the next; and the cells that need work by its assessment.
EARLIER_SWEEP, EARLIER_SOLVER, EARLIER_ASSESSMENT = "earlier sweep", "earlier solver", "earlier assessment"
CELLS = "cells.npz"
# In the folder of the stage, while it lasts: maps that are worked on.
SCRATCH = "scratch"
# A view goes on where more than this share of the ground that it sees needs work.
_LEAST_SHARE = 0.05


def sweep_views(job: Job, folder: Path, needs: Mapping[str, Path]) -> None:
    """Sweep the views that cover the bed, or go on with an earlier round of it.

    Raises
    ------
    SurveyError
        If the images do not match, or no two photographs overlap.
    """
    job.waits_for_kernels.set()
    if EARLIER_SWEEP in needs:
        _continue_round(job, folder, needs)
        return
    start = time.monotonic()
    block, images_s = job.block, time.monotonic() - start
    with job.progress.stage("Sweep", 1.0) as stage:
        low, high = job.bound
        block.set_overlap_height(0.5 * (low + high))
        chosen = job.views_to_match()
        heights = (low, high) if job.plan.skips.heights else job.limits
        passes = PASSES if job.aimed is None else passes_from(job.aimed.first_search)
        passes = before_solver(passes) if job.plan.refines_points_only else passes
        passes = passes if job.tiling is None else in_area(passes)
        start = time.monotonic()
        with map_store(folder / SCRATCH, HeightMap, show=_live(job, folder)) as make_store:
            settings = SweepSettings(heights, passes, job.swept_ground)
            maps = sweep(block, chosen, settings, shares(stage), make_store=make_store)
            if not maps and job.tiling is None:
                raise SurveyError("no two photographs overlap; check that the poses belong to the images")
            finished = _finished(block, maps, make_store)
            swept = with_wide_windows(block, finished, heights, job.swept_ground, make_store)
            took = _SweepCost(swept.views, job.plan.image_scale, time.monotonic() - start, images_s)
            _save(job, folder, swept, took, None)
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


def _continue_round(job: Job, folder: Path, needs: Mapping[str, Path]) -> None:
    """Continue from the heights of the round before, at the size of this one, in the views that need it."""
    bound = json.loads((needs[EARLIER_SWEEP] / BOUND).read_text(encoding="utf-8"))
    write_json(folder / BOUND, bound)
    before = Stored(needs[EARLIER_SWEEP] / MAPS, HeightMap)
    earlier_scale = _swept(needs[EARLIER_SWEEP])["image_scale"]
    if earlier_scale == job.plan.image_scale:
        _save(job, folder, before, _SweepCost(before.views, earlier_scale), earlier_scale)
        return
    start = time.monotonic()
    block, images_s = job.block, time.monotonic() - start
    restore_overlap_height(job, folder)
    continued = _views_to_sweep_again(job, before.views, needs)
    job.progress.note(f"sweep: {len(continued)} of {len(before)} views go on at image scale {job.plan.image_scale:g}")
    start, aimed = time.monotonic(), job.aimed
    try:
        scratch = map_store(folder / SCRATCH, HeightMap, show=_live(job, folder))
        with job.progress.stage("Sweep", 1.0) as stage, scratch as make_store:
            report = shares(stage)

            def advance(share: float) -> None:
                report(share)
                if aimed is not None and aimed.clock is not None:
                    aimed.clock.require(aimed.tail_s)

            maps = sweep(
                block,
                before.views,
                SweepSettings((bound["low_m"], bound["high_m"]), area=job.swept_ground),
                advance,
                earlier=EarlierMaps(ByView(before, before.views), continued),
                make_store=make_store,
            )
            swept = _finished(block, maps, make_store)
            took = _SweepCost(continued, job.plan.image_scale, time.monotonic() - start, images_s)
            _save(job, folder, swept, took, earlier_scale)
    except OutOfTimeError:
        job.progress.note("sweep: no time is left for this round; the heights of the previous round are kept")
        _save(job, folder, before, _SweepCost([], earlier_scale, images_s=images_s), earlier_scale)


def _views_to_sweep_again(job: Job, views: list[int], needs: Mapping[str, Path]) -> list[int]:
    """Views that see much ground that needs work; all where no standard deviation is asked for."""
    cells = needs[EARLIER_ASSESSMENT] / CELLS
    if job.aimed is None or job.aimed.aim.std_m is None:
        return views
    found = load_arrays(cells)
    needed = []
    for view in views:
        camera = camera_of(job.survey.views[view], job.plan)
        pixel = camera.project(found["xyz"], job.survey.water)
        seen = camera.sees(pixel)
        if seen.any() and found["above"][seen].mean() > _LEAST_SHARE:
            needed.append(view)
    return needed


@dataclass(frozen=True)
class _SweepCost:
    """Views that were swept, the scale of all maps, and the time that it took, for the images, too."""

    views: list[int]
    image_scale: float
    seconds: float = 0.0
    images_s: float = 0.0


def _save(job: Job, folder: Path, maps: Sequence[HeightMap], took: _SweepCost, before: float | None) -> None:
    """The maps, and what they took, from those of the scale ``before``."""
    save_maps(folder / MAPS, HeightMap, maps)
    share, scale = len(took.views) / max(len(maps), 1), took.image_scale
    num_samples = 0.0 if job.aimed is None else share * job.aimed.samples(scale, before)
    write_json(folder / SWEPT, asdict(took) | {"samples": num_samples})
    names = [view.name for view in job.survey.views]
    write_json(folder / SATURATED, dict(zip(names, job.block.saturated, strict=True)))
    found = photo_consistency(job.block, maps, job.whole_camera) if scale == job.plan.image_scale else []
    write_json(folder / CONSISTENCY, {name: asdict(each) for name, each in zip(names, found, strict=False)})


def _swept(folder: Path) -> dict:
    return json.loads((folder / SWEPT).read_text(encoding="utf-8"))


def views_swept(folder: Path) -> set[int]:
    """Views whose heights the sweep in a folder of its stage has found; the others kept those of a round before."""
    return set(_swept(folder)["views"])


def use_sweep(job: Job, folder: Path) -> None:
    """Set the scale of the maps (the previous one where no time was left) and the measured rates."""
    if job.aimed is None:
        return
    found = _swept(folder)
    _update_rates(job.aimed, found)
    if found["image_scale"] != job.plan.image_scale:
        job.aimed.number = next(
            number for number, scale in enumerate(job.aimed.scales)
            if scale == found["image_scale"] and job.aimed.solves(number) == (job.plan.field == "solver")
        )  # fmt: skip
        job.plan_again()


def _update_rates(aimed: AimedRun, found: dict) -> None:
    if found["seconds"] > 0.0 and found["samples"] > 0.0:
        aimed.rates = aimed.rates.after_sweep(found["seconds"], found["samples"], found["images_s"])


def restore_overlap_height(job: Job, folder: Path) -> None:
    """Set the height of the bed at which a block counts overlap to that at the end of the sweep in a folder."""
    bound = json.loads((folder / BOUND).read_text(encoding="utf-8"))
    job.block.set_overlap_height(0.5 * (bound["low_m"] + bound["high_m"]))
