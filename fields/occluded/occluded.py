"""Points of the bed that edges hide from the windows of the sweep, found in boxes beside depth steps."""

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, fields, replace

import numpy as np

from fields.occluded.agreement import FoundPoints, points_of_holes
from fields.occluded.holes import Holes, KnownBed, StepBox, boxes_about, step_places
from fields.occluded.sightings import Sighting, sighting_of
from fields.sweep.bed import BedPoints
from fields.sweep.block import Block
from fields.sweep.maps import HeightMap, views_of

_TOGETHER, _THREADS = 8, 2  # Boxes whose photographs are in memory together, of about 10 MB each, and threads
# Most boxes, beside one for each map: those with the most holes, so that they take a share of the time of the sweep.
_MOST_BOXES = 64
# Boxes of a sample from all over the ground, and the least share of those with holes that have points: where fewer
# have some, the objects there hide no bed (a closed hull), and those few points are doubtful.
_SAMPLE, _LEAST_SHARE = 32, 1.0 / 3.0
_FEWEST = 6  # Fewer boxes with holes do not speak for the others
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
    smooth layer; where three photographs show the same colours on it, it is seen, and its height over the layer is that
    at which they agree best. ``maps``: with the heights of the solver. ``photograph``: RGB (height, width, 3) uint8 of
    a view by its number. ``advance``: gets the share of the work that is done since the last call.
    """
    views = views_of(maps)
    places = (part for m in maps for part in step_places(block.cameras[m.view], block.water, m, known.gsd))
    boxes = boxes_about(places, known.gsd)
    # A sample from all over the ground, and the others.
    chosen = set(np.linspace(0, len(boxes) - 1, min(_SAMPLE, len(boxes))).astype(int).tolist())
    sample, others = [boxes[k] for k in sorted(chosen)], [each for k, each in enumerate(boxes) if k not in chosen]
    if sample:
        _ = known.tree
    with ThreadPoolExecutor(_THREADS) as pool:
        search = _Search(block, maps, views, photograph, known, pool)
        return search.search_boxes(sample, others, advance)


@dataclass(frozen=True)
class _Search:
    """Search of boxes for points: what it reads, and its threads."""

    block: Block
    maps: Sequence[HeightMap]
    views: list[int]  # of the maps
    photograph: Callable[[int], np.ndarray]
    known: KnownBed
    pool: Executor

    def search_boxes(
        self, sample: list[StepBox], others: list[StepBox], advance: Callable[[float], None]
    ) -> OccludedBed:
        """Points in the boxes of a sample and, where these show the bed, in the others with the most holes."""
        num_boxes = max(len(sample) + len(others), 1)
        found = self._holes_in(sample)
        points, num_searched = self._search_sample(found, advance, len(sample) / num_boxes)
        # Few boxes do not speak for others; without others they speak for themselves.
        is_telling = len(found) >= _FEWEST or not others
        if points is None or (is_telling and len(points) < _LEAST_SHARE * len(found)):
            return replace(_together(self.block, [], num_searched), is_no_bed=True)
        more = self._holes_in(others)
        most = max(_MOST_BOXES, len(self.views)) - len(found)
        points += self._points_in(more[:most], advance, len(others) / num_boxes)
        searched = _together(self.block, points, len(found) + len(more[:most]))
        return replace(searched, num_left_out=len(more[most:]))

    def _search_sample(
        self, found: list[Holes], advance: Callable[[float], None], share: float
    ) -> tuple[list[FoundPoints] | None, int]:
        """Points in the holes of a sample and the number of boxes searched; None where the first boxes show no bed."""
        first, later = found[:_TOGETHER], found[_TOGETHER:]
        share_of_box = share / max(len(found), 1)
        points = self._points_in(first, advance, share_of_box * len(first))
        if len(found) >= _FEWEST and not show_bed(first, points):
            return None, len(first)
        return points + self._points_in(later, advance, share_of_box * len(later)), len(found)

    def _holes_in(self, boxes: list[StepBox]) -> list[Holes]:
        """Holes in boxes, the most cells first."""
        found = [each for each in self.pool.map(lambda box: Holes.of(box, self.known), boxes) if each is not None]
        return sorted(found, key=lambda holes: -int(holes.are_holes.sum()))

    def _points_in(self, found: list[Holes], advance: Callable[[float], None], share: float) -> list[FoundPoints]:
        """Points in holes; all of them are a ``share`` of the work."""
        points: list[FoundPoints] = []
        for first in range(0, len(found), _TOGETHER):
            part = found[first : first + _TOGETHER]
            seen = _sightings(self.block, self.maps, self.views, self.photograph, part)
            points += [each for each in self.pool.map(points_of_holes, part, seen) if each is not None]
            advance(share * len(part) / len(found))
        return points


def show_bed(found: Sequence[Holes], points: Sequence[FoundPoints]) -> bool:
    """Whether points fill enough of the cells of holes to search more of them."""
    num_cells = sum(int(holes.are_holes.sum()) for holes in found)
    return sum(len(each.xyz) for each in points) >= _LEAST_FOUND * num_cells


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
        shown = [camera.sees(camera.project(holes.probe_points, block.water)).any() for holes in found]
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
    # A dry survey has depth NaN, and NaN > 0 is False: no point is wet.
    points = BedPoints(**columns, depth=depth.astype(np.float32), wet=depth > 0.0, origin=np.ones(len(xyz), np.uint8))
    return OccludedBed(points, view, num_boxes)
