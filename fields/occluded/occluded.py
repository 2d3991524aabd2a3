"""Points of the bed that edges hide from the windows of the sweep, found in boxes beside depth steps."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace

import numpy as np

from fields.occluded.agreement import FoundPoints, points_of_holes
from fields.occluded.holes import Holes, KnownBed, StepBox, boxes_about, step_places
from fields.occluded.sightings import Sighting, sighting_of
from fields.sweep.bed import BedPoints
from fields.sweep.block import Block
from fields.sweep.maps import HeightMap

# Boxes whose photographs are in memory together, of about 10 MB each, and threads.
_TOGETHER, _THREADS = 8, 2
# Most boxes, beside one for each map: those with the most holes, so that they take a share of the time of the sweep.
_MOST_BOXES = 64
# Boxes of a sample from all over the ground, and the least share of those with holes that have points: where fewer
# have some, the objects there hide no bed (a closed hull), and those few points are doubtful.
_SAMPLE, _LEAST_SHARE = 32, 1.0 / 3.0
# Fewer boxes with holes do not speak for the others.
_FEWEST = 6
# The boxes of the sample with the most holes are searched first; where points are found in less than this share of
# their holes, the others are not searched.
_LEAST_FOUND = 0.03


@dataclass(frozen=True)
class OccludedBed:
    """Points of the bed beside and under edges, and the boxes that were searched."""

    points: BedPoints
    view: np.ndarray  # (N,): that shows each steepest
    # num_boxes, num_left_out: In which the cloud has holes, and how many more do; see `_MOST_BOXES`
    num_boxes: int
    num_left_out: int = 0
    is_no_bed: bool = False  # Whether too few boxes of a sample have points, so that none are given


def find_occluded(
    block: Block,
    maps: Sequence[HeightMap],
    photograph: Callable[[int], np.ndarray],
    known: KnownBed,
    advance: Callable[[float], None] = lambda _share: None,
) -> OccludedBed:
    """Points of the bed in holes of a cloud beside depth steps.

    There the windows of the sweep cover both the edge and the bed beside it. The bed about a hole is carried on as a
    smooth layer; where three photographs show the same colours on it, it is seen, and its height over the layer is
    that at which they agree best.

    Parameters
    ----------
    maps : sequence of HeightMap
        With the heights of the solver.
    photograph : callable
        RGB (height, width, 3) uint8 of a view by its number.
    advance : callable
        Gets the share of the work that is done since the last call.
    """
    views = []

    def places() -> Iterator[np.ndarray]:
        for m in maps:
            views.append(m.view)
            yield from step_places(block.cameras[m.view], block.water, m, known.gsd)

    sample, others = _sample(boxes_about(places(), known.gsd))
    if sample:
        known.sort()
    with ThreadPoolExecutor(_THREADS) as pool:

        def holes_in(boxes: list[StepBox]) -> list[Holes]:
            return [holes for holes in pool.map(lambda box: Holes.of(box, known), boxes) if holes is not None]

        def most_first(found: list[Holes]) -> list[Holes]:
            return sorted(found, key=lambda holes: -int(holes.are_holes.sum()))

        def points_in(found: list[Holes], share: float) -> list[FoundPoints]:
            points: list[FoundPoints] = []
            for first in range(0, len(found), _TOGETHER):
                part = found[first : first + _TOGETHER]
                seen = _sightings(block, maps, views, photograph, part)
                points += [each for each in pool.map(points_of_holes, part, seen) if each is not None]
                advance(share * len(part) / len(found))
            return points

        found, share = most_first(holes_in(sample)), len(sample) / max(len(sample) + len(others), 1)
        first, later = found[:_TOGETHER], found[_TOGETHER:]
        points = points_in(first, share * len(first) / max(len(found), 1))
        if len(found) >= _FEWEST and not show_bed(first, points):
            return replace(_together(block, [], len(first)), is_no_bed=True)
        points += points_in(later, share * len(later) / max(len(found), 1))
        if (len(found) >= _FEWEST or not others) and len(points) < _LEAST_SHARE * len(found):
            return replace(_together(block, [], len(found)), is_no_bed=True)
        more = most_first(holes_in(others))
        most = max(_MOST_BOXES, len(views)) - len(found)
        points += points_in(more[:most], len(others) / (len(sample) + max(len(others), 1)))
    return replace(_together(block, points, len(found) + len(more[:most])), num_left_out=len(more[most:]))


def show_bed(found: Sequence[Holes], points: Sequence[FoundPoints]) -> bool:
    """Whether points fill enough of the cells of holes to search more of them."""
    num_cells = sum(int(holes.are_holes.sum()) for holes in found)
    return sum(len(each.xyz) for each in points) >= _LEAST_FOUND * num_cells


def _sample(boxes: list[StepBox]) -> tuple[list[StepBox], list[StepBox]]:
    """Boxes from all over the ground, and the others."""
    chosen = set(np.linspace(0, len(boxes) - 1, min(_SAMPLE, len(boxes))).astype(int).tolist())
    return [boxes[k] for k in sorted(chosen)], [each for k, each in enumerate(boxes) if k not in chosen]


def _sightings(
    block: Block,
    maps: Sequence[HeightMap],
    views: Sequence[int],
    photograph: Callable[[int], np.ndarray],
    found: Sequence[Holes],
) -> list[list[Sighting]]:
    """Sightings of holes, read photograph by photograph."""
    seen: list[list[Sighting]] = [[] for _ in found]
    for number, view in enumerate(views):
        camera = block.cameras[view]
        shown = [camera.sees(camera.project(holes.corners, block.water)).any() for holes in found]
        if not any(shown):
            continue
        rgb, known, height_map = photograph(view), np.isfinite(block.images[view]), maps[number]
        for target, holes, is_shown in zip(seen, found, shown, strict=True):
            if is_shown:
                sighting = sighting_of(block, height_map, rgb, known, holes)
                target += [] if sighting is None else [sighting]
    return seen


def _together(block: Block, parts: Iterable[FoundPoints], num_boxes: int) -> OccludedBed:
    parts = list(parts)
    if not parts:
        return OccludedBed(BedPoints.empty(), np.empty(0, dtype=np.int32), num_boxes)
    columns = {f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(FoundPoints)}
    xyz, view, water = columns["xyz"], columns.pop("view").astype(np.int32), block.water
    depth = np.full(len(xyz), np.nan) if water is None else water.height(xyz[:, 0], xyz[:, 1]) - xyz[:, 2]
    # Of those that are not, NaN compares false.
    points = BedPoints(**columns, depth=depth.astype(np.float32), wet=depth > 0.0, origin=np.ones(len(xyz), np.uint8))
    return OccludedBed(points, view, num_boxes)
