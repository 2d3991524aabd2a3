"""Pairs of photographs that are matched: those whose footprints on the ground may overlap, never all against all.

Positions, attitudes and heights are those of EXIF and XMP, good to some metres and degrees: enough to tell neighbours.
Water hardly moves a footprint: a ray 20 degrees off nadir meets the bed 2 m deep 0.2 m nearer than in air.

Photographs whose place is not known are matched with those that look alike. No vocabulary is trained or fetched: each
large feature votes for the photographs with the most similar ones. That compares all photographs with each other, by a
hundredth of what it takes to match them: the pairs that are then matched grow with the number of photographs, the votes
with its square (`VOTING` features each).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.spatial import cKDTree

# Up to so many images every pair is tried, beyond it each image with its nearest neighbours.
ALL_PAIRS_UP_TO, NEIGHBOURS = 40, 20
# Of two neighbours, most have each other: so many pairs come of a neighbour.
_PAIRS_OF_NEIGHBOUR = 0.65
# Directions in which partners are sought in turn, so that dense photographs of a strip do not displace those of the
# strips beside it. So many of the nearest are looked at, four times as many while a direction has none, and most.
_SECTORS = 8
_LOOKED_AT, _MORE, _MOST_LOOKED_AT = 200, 4, 3200
# Footprints of axes closer to the horizon than this reach no further.
_MOST_TILT_DEG = 60.0
# Two photographs are not partners if the distance of their middles is more than this share of both radii: corners of
# the footprints touch, and positions and heights are a little off.
_TOUCHING = 1.1
# So many are taken at least, the nearest, whatever heights say of footprints.
_LEAST = 6
# Nobody flies lower [m]; below, heights are wrong.
LEAST_HEIGHT_M = 2.0
# Features of a photograph that vote, those of the largest scale: they are found again in most photographs of a place.
VOTING = 100
# Photographs that are compared with one at a time.
_AT_ONCE = 500


@dataclass(frozen=True)
class Place:
    """Place of a photograph before structure from motion, as far as it is known."""

    position: np.ndarray  # (3,) [m], in any one frame with z up
    cam_from_local: np.ndarray | None = None  # (3, 3): None is taken to look straight down
    spread: float | None = None  # Half of the longer side of the photograph over its focal length
    height_m: float | None = None  # Over the ground or water, about

    @property
    def axis(self) -> np.ndarray:
        """Viewing direction (3,); down where attitude or height are unknown."""
        down = np.array([0.0, 0.0, -1.0])
        return down if self.cam_from_local is None or self.height_m is None else self.cam_from_local[2]


@dataclass(frozen=True)
class _Footprints:
    """Footprints of V photographs on level ground."""

    centres: np.ndarray  # (V, 2) [m]
    radii: np.ndarray  # (V,) [m]: half of the longer side; infinite where it is not known
    looks: np.ndarray  # (V, 3) [m]: axes times heights, so that opposite views are a height or more apart

    @classmethod
    def of(cls, places: Sequence[Place]) -> _Footprints:
        positions = np.array([place.position for place in places], dtype=np.float64)
        axes = np.array([place.axis for place in places])
        heights = np.array([place.height_m or 0.0 for place in places])
        falling = np.maximum(-axes[:, 2], math.cos(math.radians(_MOST_TILT_DEG)))
        unknown = [place.spread is None or place.height_m is None for place in places]
        reach = np.where(unknown, math.inf, [(place.spread or 0.0) * (place.height_m or 0.0) for place in places])
        centres = positions[:, :2] + (heights / falling)[:, None] * axes[:, :2]
        return cls(centres, reach / falling, heights[:, None] * axes)


def pairs_about(num: int) -> int:
    """Approximate number of pairs that are matched of so many images."""
    return num * (num - 1) // 2 if num <= ALL_PAIRS_UP_TO else round(_PAIRS_OF_NEIGHBOUR * NEIGHBOURS * num)


def image_pairs(names: Sequence[str], places: Mapping[str, Place]) -> list[tuple[str, str]]:
    """Pairs of images that may overlap: all of a small survey, else neighbours; those with a place only."""
    if len(names) <= ALL_PAIRS_UP_TO:
        return list(combinations(sorted(names), 2))
    placed = sorted(name for name in names if name in places)
    found = _partners(_Footprints.of([places[name] for name in placed])) if len(placed) > 1 else ()
    return sorted({(placed[min(i, j)], placed[max(i, j)]) for i, j in found})


def _partners(ground: _Footprints) -> Iterator[tuple[int, int]]:
    """Partners of each photograph, at most `NEIGHBOURS`, by numbers."""
    tree = cKDTree(np.column_stack([ground.centres, ground.looks]))
    for number in range(len(ground.radii)):
        near, offsets, touches = _looked_at(ground, tree, number)
        chosen = near[touches][_by_direction(offsets[touches])[:NEIGHBOURS]]
        # Heights may be too low, so that nothing touches.
        others = near[~touches][: max(_LEAST - len(chosen), 0)]
        for other in (*chosen, *others):
            yield number, int(other)


def _looked_at(ground: _Footprints, tree: cKDTree, number: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The nearest (K,) to a photograph, in all directions if there are; offsets (K, 2) [m]; which footprints touch."""
    most, count = min(_MOST_LOOKED_AT, len(ground.radii) - 1), _LOOKED_AT
    farthest = _TOUCHING * (ground.radii[number] + ground.radii.max())
    while True:
        distance, near = tree.query(tree.data[number], k=min(count, most) + 1)
        offsets = ground.centres[near] - ground.centres[number]
        touches = np.hypot(*offsets.T) <= _TOUCHING * (ground.radii[near] + ground.radii[number])
        others = near != number
        filled = len(np.unique(_sector(offsets[touches & others]))) == _SECTORS
        if filled or count >= most or distance[-1] > farthest:
            return near[others], offsets[others], touches[others]
        count *= _MORE


def _sector(offsets: np.ndarray) -> np.ndarray:
    """Directions (K,) of offsets (K, 2), by number."""
    return np.floor(np.arctan2(offsets[:, 1], offsets[:, 0]) / (2.0 * math.pi) * _SECTORS).astype(int) % _SECTORS


def _by_direction(offsets: np.ndarray) -> np.ndarray:
    """Order of offsets (K, 2), sorted by distance: the nearest of each direction, then the second of each, ..."""
    sector = _sector(offsets)
    rank = np.zeros(len(offsets), dtype=int)
    for each in range(_SECTORS):
        rank[sector == each] = np.arange((sector == each).sum())
    return np.lexsort([np.arange(len(offsets)), rank])


def similar_images(descriptors: Iterable[np.ndarray], num: int, of: Sequence[int]) -> Iterator[tuple[int, int]]:
    """Pairs of photographs, by number: some (``of``) with those that look most like them, the best first.

    Descriptors (F, 128) uint8 of all photographs, those of the largest scale first, are read one by one.
    """
    every = np.zeros((num, VOTING, 128), np.float32)
    for number, own in enumerate(descriptors):
        own = own[:VOTING].astype(np.float32)
        every[number, : len(own)] = own / np.maximum(np.linalg.norm(own, axis=1, keepdims=True), 1.0)
    for number in of:
        votes = _votes(every, number)
        votes[number] = 0.0
        best = np.argsort(-votes, kind="stable")[:NEIGHBOURS]
        for other in best[votes[best] > 0.0]:
            yield number, int(other)


def _votes(every: np.ndarray, number: int) -> np.ndarray:
    """Votes (V,) of a photograph's features for all, by how much more similar these are than those of most."""
    ours, parts = every[number].T, np.array_split(every, -(-len(every) // _AT_ONCE))
    likeness = np.concatenate([(part.reshape(-1, 128) @ ours).reshape(len(part), VOTING, -1).max(1) for part in parts])
    likeness[number] = 0.0
    count = min(NEIGHBOURS + 1, len(every) - 1)
    usual = np.partition(likeness, -count, axis=0)[-count]
    return np.maximum(likeness - usual, 0.0).sum(axis=1)
