"""Points from solved candidates: those whose surroundings are one surface that no height map sees through.

Fusion by visibility, as in P. Merrell et al., Real-time visibility-based fusion of depth maps, ICCV 2007, where the
sweep could not decide.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fields.image_store import LazyImages, Masks
from fields.solver.solver import SolvedMap
from fields.sweep.block import Block
from fields.sweep.candidates import REACH_GSD, Selection
from fields.sweep.kernels.stack import ViewStack, largest
from fields.sweep.map_points import MapPoints, num_within, points_about, thin_out
from fields.sweep.maps import DepthMap

# Least number of points within `REACH_GSD`, where a surface sampled once per ground sampling distance has twelve, and
# of pixels of the same map whose heights differ by less than that distance, in a square of this side [px].
_LEAST_NEIGHBOURS, _LEAST_AROUND, _AROUND_PX = 4, 8, 5


def take_candidates(
    block: Block, maps: Sequence[DepthMap], solved: Sequence[SolvedMap], chosen: Selection, gsd: float
) -> Masks:
    """Pixels of the maps that become points by their solved heights: the kept ones, and some candidates.

    Of candidates those whose height was solved, that no map sees through, and that lie in a surface: they have
    neighbours in space and in their map. They become points once per ``gsd`` [m], the ground sampling distance.
    """
    kept = chosen.kept.copy()
    if not len(maps):
        return kept
    cameras = [block.cameras[m.view] for m in maps]
    heights = LazyImages(lambda number: solved[number].over(maps[number])[0].height, len(maps), largest(cameras), 1)
    stack, reach = ViewStack.build(block.device, cameras, heights, block.water), REACH_GSD * gsd
    is_solved = [_mask(each, (c.height, c.width)) for each, c in zip(solved, cameras, strict=True)]
    fit = [mask & known for mask, known in zip(chosen.candidates, is_solved, strict=True)]
    new = MapPoints.of(stack, fit)
    _, through = new.votes(stack, chosen.sure, reach)
    new = new[through == 0]
    new = new[_num_around(new, heights, gsd) >= _LEAST_AROUND]
    if not len(new.number):
        return kept
    both = (keep | mask for keep, mask in zip(kept, fit, strict=True))
    # Each is a neighbour of itself.
    new = new[num_within(points_about(stack, both, new.xyz, reach), new.xyz, reach) > _LEAST_NEIGHBOURS]
    new[thin_out(new.xyz.T, gsd)].mark(kept, True)
    return kept


def _mask(solved: SolvedMap, shape: tuple[int, int]) -> np.ndarray:
    """Solved pixels of a map (height, width) bool."""
    mask = np.zeros(shape, dtype=bool)
    mask.flat[solved.pixels] = True
    return mask


def _num_around(points: MapPoints, heights: Sequence[np.ndarray], within: float) -> np.ndarray:
    """Number (N,) of pixels around each, in its map, whose heights differ by less than ``within`` [m] from its own."""
    found, radius = np.zeros(len(points.number), dtype=np.int64), _AROUND_PX // 2
    for number in np.unique(points.number):
        height, mine = heights[number], points.number == number
        row, column = np.divmod(points.pixel[mine], height.shape[1])
        padded, own = np.pad(height, radius, mode="edge"), height[row, column]
        for down, across in np.ndindex(_AROUND_PX, _AROUND_PX):
            found[mine] += np.abs(padded[row + down, column + across] - own) < within
    return found - 1
