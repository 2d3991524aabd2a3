"""Points of the bed beside and under edges, added to those of the height maps."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from fields.occluded.occluded import find_occluded
from fields.solver.solver import SolvedMap
from fields.sweep.bed import BedPoints
from fields.sweep.maps import HeightMap
from survey.progress import shares

if TYPE_CHECKING:
    from survey.run.job import Job


class SolvedHeights(Sequence[HeightMap]):
    """Height maps with the heights of the solver, each made when it is asked for."""

    def __init__(self, maps: Sequence[HeightMap], solved: Sequence[SolvedMap]):
        self._maps, self._solved = maps, solved

    def __len__(self) -> int:
        return len(self._maps)

    def __getitem__(self, number):
        """The map at a place in the order."""
        return self._solved[number].over(self._maps[number])[0]

    def __iter__(self) -> Iterator[HeightMap]:
        return (self[number] for number in range(len(self)))


def with_occluded(
    job: Job, maps: Sequence[HeightMap], solved: Sequence[SolvedMap], bed: BedPoints, tide: np.ndarray
) -> tuple[BedPoints, np.ndarray]:
    """Points of the bed and their tides (N,) [m], and those that only boxes beside depth steps find."""
    views, scale = job.survey.views, job.plan.image_scale
    with job.progress.stage("Boxes beside edges", 1.0) as stage:
        found = find_occluded(
            job.block,
            SolvedHeights(maps, solved),
            lambda view: job.photographs.load(views[view], scale=scale),
            bed.xyz,
            job.plan.gsd_m,
            job.own_ground,
            shares(stage),
        )
    if not found.num_boxes:
        job.progress.note("boxes: none, the cloud has no holes beside depth steps")
        return bed, tide
    if found.is_no_bed:
        job.progress.note(
            f"boxes: of {found.num_boxes} beside depth steps hardly any show a bed in the holes of the cloud; none used"
        )
        return bed, tide
    left_out = f" ({found.num_left_out} with fewer left out)" if found.num_left_out else ""
    job.progress.note(
        f"boxes: {found.num_boxes} beside depth steps, where the cloud has holes{left_out}; {len(found.points):,} more "
        "points, on which three photographs or more agree"
    )
    tides = np.array([camera.tide for camera in job.block.cameras])
    return BedPoints.concatenate([bed, found.points]), np.concatenate([tide, tides[found.view]])
