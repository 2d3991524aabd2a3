"""An octree of points for COPC: each point in one node, coarse nodes holding a thinned cloud, leaves the rest.

Integer arithmetic throughout, on the stored steps of LAS, so that no point lies on the wrong side of a node.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

# Cells along a side of a node, of which each gives one point to it: the spacing of a node is its side by this.
CELLS = 128
_CELL_BITS = 7
# A node with so few points below it keeps them all. The two together make nodes of some 20,000 points on a bed.
_LEAF = 30_000
# Levels of the finest cells: three numbers of 21 bits fill 63.
_MOST_BITS = 21
_SEED = 0
_MOST_UINT32 = 2**32


@dataclass(frozen=True)
class Octree:
    """Node of each point."""

    corner: np.ndarray  # (3,) int64: lowest corner of the cube, in steps: the lowest coordinates
    side: int  # Of the cube, in steps: the largest extent
    order: np.ndarray  # (N,) uint32, or int64 where there are more than those count: the points, node after node
    keys: np.ndarray  # (M, 4) int32: Level, x, y, z of the nodes; a node comes after its parent
    counts: np.ndarray  # (M,) int64: points of each node, one at least


def build_octree(columns: Sequence[np.ndarray], per_unit: Sequence[int] = (1, 1, 1)) -> Octree:
    """The octree over points.

    Parameters
    ----------
    columns : three of (N,) int, N at least 1
        x, y and z. They are copied one after the other.
    per_unit : three of int
        Steps of one unit of each; steps are equal along all axes.
    """
    axes = tuple(zip(columns, (int(number) for number in per_unit), strict=True))
    corner = [int(column.min()) * number for column, number in axes]
    side = max(*(int(column.max()) * number - low for (column, number), low in zip(axes, corner, strict=True)), 1)
    bits = min(side.bit_length(), _MOST_BITS)
    code = np.zeros(len(columns[0]), dtype=np.int64)
    for axis, ((column, number), low) in enumerate(zip(axes, corner, strict=True)):
        cell = column.astype(np.int64)
        cell *= number
        cell -= low
        cell <<= bits
        cell //= side
        # The highest point lies on the wall of the cube, and belongs to the last cell.
        np.minimum(cell, 2**bits - 1, out=cell)
        _spread(cell)
        cell <<= axis
        code |= cell
    del cell
    rest = np.argsort(code, kind="stable").astype(np.uint32 if len(code) <= _MOST_UINT32 else np.int64)
    code.sort()
    rng = np.random.default_rng(_SEED)
    order, keys, counts = [], [], []
    for level in range(bits + 1):
        taken = _taken(code, bits, level, rng)
        nodes = code[taken] >> 3 * (bits - level)
        first = _starts(nodes)
        order.append(rest[taken])
        keys.append(_keys(nodes[first], level))
        counts.append(np.diff(np.append(first, len(nodes))))
        rest, code = rest[~taken], code[~taken]
        if not len(rest):
            break
    return Octree(np.array(corner), side, np.concatenate(order), np.concatenate(keys), np.concatenate(counts))


def _taken(code: np.ndarray, bits: int, level: int, rng: np.random.Generator) -> np.ndarray:
    """Sorted points (N,) bool that the nodes of a level take: one of each cell, or all that are left."""
    if level == bits:
        return np.ones(len(code), dtype=bool)
    node = _starts(code >> 3 * (bits - level))
    sizes = np.diff(np.append(node, len(code)))
    taken = np.repeat(sizes <= _LEAF, sizes)
    cell = _starts(code >> 3 * max(bits - level - _CELL_BITS, 0))
    # A random one of the cell: the lowest one would lie on a grid.
    taken[cell + (rng.random(len(cell)) * np.diff(np.append(cell, len(code)))).astype(np.int64)] = True
    return taken


def _starts(sorted_values: np.ndarray) -> np.ndarray:
    """Starts of runs of equal values."""
    return np.flatnonzero(np.append(True, sorted_values[1:] != sorted_values[:-1]))


def _keys(nodes: np.ndarray, level: int) -> np.ndarray:
    """Level, x, y, z (M, 4) of nodes by their codes (M,)."""
    return np.stack([np.full(len(nodes), level), *(_gather(nodes >> axis) for axis in range(3))], axis=1).astype("<i4")


_SPREADING = (
    (32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F), (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)  # fmt: skip


def _spread(values: np.ndarray) -> None:
    """Move the lower 21 bits of values (N,) int64 to every third place of 63: Morton codes of three sort by octree."""
    for shift, mask in _SPREADING:
        values |= values << shift
        values &= mask


def _gather(codes: np.ndarray) -> np.ndarray:
    """The inverse of `_spread`; the other two thirds of the bits are ignored."""
    masks = [0x1FFFFF, *(mask for _, mask in _SPREADING)]
    codes = codes & masks[-1]
    for (shift, _), mask in zip(reversed(_SPREADING), reversed(masks[:-1]), strict=True):
        codes = (codes | (codes >> shift)) & mask
    return codes
