"""The stage of the field: a tensor field trained inside the bound of the sweep."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from fields.sweep.maps import HeightMap
from survey.plan.area import AREA_MARGIN_M, grown, local_area
from survey.plan.sweep_block import backend
from survey.progress import shares
from survey.run.stage_sweep import MAPS
from survey.run.stored_maps import Stored

if TYPE_CHECKING:
    from fields.slab.tensor_field import FieldFigures, TensorField
    from survey.run.job import Job


def train_field(job: Job, folder: Path, needs: Mapping[str, Path]) -> None:
    """Train the field on the photographs that have a height map."""
    # Imported where it is needed, as below: it takes torch, whose import takes seconds.
    from survey.run.stored_field import save_field, save_place

    maps = Stored(needs["sweep"] / MAPS, HeightMap)
    with job.progress.stage("Field", 1.0) as stage:
        field, figures = trained(job, maps, shares(stage))
    job.progress.note(f"field: {figures.psnr_db:.1f} dB after {figures.rays:,} rays")
    save_field(folder, field, figures)
    save_place(folder, job.survey.frame, job.survey.water)


def trained(job: Job, maps: Sequence[HeightMap], progress: Callable[[float], None]) -> tuple[TensorField, FieldFigures]:
    """The field inside the bound of the sweep, and the figures of its training."""
    from fields.slab.rays import slab_of
    from fields.slab.tensor_field import FieldSettings, Schedule, train

    plan, area = job.plan, local_area(job.survey)
    sources = job.sources(maps)
    slab = slab_of(sources, plan.gsd_m, None if area is None else grown(area, AREA_MARGIN_M))
    return train(sources, slab, FieldSettings(), Schedule(plan.recipe.rays_per_cell), backend(plan), progress)
