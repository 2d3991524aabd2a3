"""Cloud-optimised LAZ (COPC 1.0, https://copc.io): an octree of points, and a LAZ 1.4 file whose chunks are its nodes.

No library for Python both keeps the descriptors of extra bytes and writes a cloud without an object for each point: the
octree and the two records of COPC are made here, lazrs compresses. Integer arithmetic throughout, on the stored steps
of LAS, so that no point lies on the wrong side of a node.
"""

import struct
from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import BinaryIO

import laspy
import lazrs
import numpy as np

# Cells along a side of a node. Each contributes one point, so the point spacing of a node is its side over this number.
CELLS = 128
_CELL_BITS = 7
# A node with no more points than this keeps them all. With CELLS, nodes on a bed get some 20,000 points each.
_LEAF = 30_000
# The most levels: three numbers of 21 bits fill 63.
_MOST_BITS = 21
_SEED = 0
_MOST_UINT32 = 2**32
SUFFIX = ".copc.laz"
_INFO, _HIERARCHY = ("copc", 1), ("copc", 1000)
# Centre, half side, spacing, root page (offset and size), first and last GPS time, reserved.
_INFO_LAYOUT = "<3d2d2Q2d88x"
_EXTENDED_HEAD = "<2x16sHQ32s"
# Nodes compressed at a time, on all cores; points converted to records at a time otherwise.
_BATCH, _PORTION = 16, 500_000
_CHUNK_TABLE_OFFSET = 8

Records = Callable[[slice | np.ndarray], laspy.LasData]


@dataclass(frozen=True)
class Octree:
    """Node of each point."""

    corner: np.ndarray  # (3,) int64: lowest corner of the cube, in steps
    side: int  # Of the cube, in steps
    order: np.ndarray  # (N,) uint32, or int64 where there are more than those count: the points, node after node
    keys: np.ndarray  # (M, 4) int32: Level, x, y, z of the nodes; a node comes after its parent
    counts: np.ndarray  # (M,) int64: points of each node, one at least


def build_octree(columns: Sequence[np.ndarray], per_unit: Sequence[int] = (1, 1, 1)) -> Octree:
    """The octree over points of columns x, y, z (N,) int, N at least 1, with so many equal steps in a unit of each."""
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
        # The highest point lies on the face of the cube, and belongs to the last cell.
        np.minimum(cell, 2**bits - 1, out=cell)
        _spread(cell)
        cell <<= axis
        code |= cell
    del cell
    remaining = np.argsort(code, kind="stable").astype(np.uint32 if len(code) <= _MOST_UINT32 else np.int64)
    code.sort()
    rng = np.random.default_rng(_SEED)
    order, keys, counts = [], [], []
    for level in range(bits + 1):
        taken = _taken(code, bits, level, rng)
        nodes = code[taken] >> 3 * (bits - level)
        first = _starts(nodes)
        order.append(remaining[taken])
        places = (_gather(nodes[first] >> axis) for axis in range(3))
        keys.append(np.stack([np.full(len(first), level), *places], axis=1).astype("<i4"))
        counts.append(np.diff(np.append(first, len(nodes))))
        remaining, code = remaining[~taken], code[~taken]
        if not len(remaining):
            break
    return Octree(np.array(corner), side, np.concatenate(order), np.concatenate(keys), np.concatenate(counts))


def _taken(code: np.ndarray, bits: int, level: int, rng: np.random.Generator) -> np.ndarray:
    """Mask (N,) of the sorted points that the nodes of a level take: one of each cell, or all that are left."""
    if level == bits:
        return np.ones(len(code), dtype=bool)
    node = _starts(code >> 3 * (bits - level))
    sizes = np.diff(np.append(node, len(code)))
    taken = np.repeat(sizes <= _LEAF, sizes)
    cell = _starts(code >> 3 * max(bits - level - _CELL_BITS, 0))
    # A random point of each cell: the first ones would form a grid.
    taken[cell + (rng.random(len(cell)) * np.diff(np.append(cell, len(code)))).astype(np.int64)] = True
    return taken


def _starts(sorted_values: np.ndarray) -> np.ndarray:
    """Starts of runs of equal values."""
    return np.flatnonzero(np.append(True, sorted_values[1:] != sorted_values[:-1]))


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


def write_copc(
    header: laspy.LasHeader, records: Records, count: int, stream: BinaryIO, portion: int = _PORTION
) -> None:
    """Write ``count`` points, one at least, of format 6, 7 or 8 as COPC; the stream can be read and sought in.

    ``records`` makes records of some rows (a slice, or indices) under the header, ``portion`` at a time for the places
    of the points, and node by node to be written.
    """
    # laspy adds the points of each portion of records to the counts in their header.
    header = deepcopy(header)
    header.partial_reset()
    tree = _octree_of(header, records, count, portion)
    header.are_points_compressed = True
    laz = lazrs.LazVlr.new_for_compression(
        header.point_format.id, header.point_format.num_extra_bytes, use_variable_size_chunks=True
    )
    info = laspy.VLR(*_INFO, "COPC info", bytes(struct.calcsize(_INFO_LAYOUT)))
    # COPC requires its record at byte 375, before all others.
    header.vlrs.insert(0, info)
    header.vlrs.insert(1, laspy.VLR("laszip encoded", 22204, "lazrs", laz.record_data()))
    start = stream.tell()
    header.write_to(stream)
    _write_chunks(stream, laz, records, tree)
    end = stream.tell()
    page = _page(stream, laz, header.offset_to_point_data, tree)
    stream.seek(end)
    stream.write(struct.pack(_EXTENDED_HEAD, _HIERARCHY[0].encode(), _HIERARCHY[1], len(page), b"EPT hierarchy"))
    page_at = stream.tell()
    stream.write(page)
    header.start_of_first_evlr, header.number_of_evlrs = end, 1
    half = 0.5 * tree.side * header.scales.min()
    centre = header.offsets + tree.corner * header.scales.min() + half
    times = header.min_gps_time, header.max_gps_time
    info.record_data = struct.pack(_INFO_LAYOUT, *centre, half, 2.0 * half / CELLS, page_at, len(page), *times)
    stream.seek(start)
    header.write_to(stream, ensure_same_size=True)
    stream.seek(0, 2)


def _octree_of(header: laspy.LasHeader, records: Records, count: int, portion: int) -> Octree:
    """The octree over the points, which are added to the counts and bounds of the header."""
    places = [np.empty(count, dtype=np.int32) for _ in "XYZ"]
    for first in range(0, count, portion):
        part = slice(first, first + portion)
        points = records(part).points
        header.grow(points)
        for place, axis in zip(places, "XYZ", strict=True):
            place[part] = points.array[axis]
    return build_octree(places, np.round(header.scales / header.scales.min()).astype(np.int64))


def _write_chunks(stream: BinaryIO, laz: lazrs.LazVlr, records: Records, tree: Octree) -> None:
    """The points of each node as one chunk, in the order of the nodes."""
    compressor = lazrs.ParLasZipCompressor(stream, laz)
    compressor.reserve_offset_to_chunk_table()
    ends = np.cumsum(tree.counts)
    for first in range(0, len(ends), _BATCH):
        counts, end = tree.counts[first : first + _BATCH], ends[first : first + _BATCH][-1]
        points = records(tree.order[end - counts.sum() : end]).points.array
        compressor.compress_chunks([part.view(np.uint8) for part in np.split(points, np.cumsum(counts)[:-1])])
    compressor.done()


def _page(stream: BinaryIO, laz: lazrs.LazVlr, points_at: int, tree: Octree) -> bytes:
    """The hierarchy: of each node key, place in the file, bytes and points, by the table that ends the chunks."""
    stream.seek(points_at)
    table = np.array(lazrs.read_chunk_table(stream, laz), dtype=np.int64).reshape(-1, 2)
    if not np.array_equal(table[:, 0], tree.counts):
        raise RuntimeError("the chunks of the compressor are not the nodes of the octree")
    size = table[:, 1]
    entries = np.empty(len(tree.keys), dtype=[("key", "<i4", 4), ("at", "<u8"), ("size", "<i4"), ("count", "<i4")])
    entries["key"], entries["size"], entries["count"] = tree.keys, size, tree.counts
    entries["at"] = points_at + _CHUNK_TABLE_OFFSET + np.cumsum(size) - size
    return entries.tobytes()
