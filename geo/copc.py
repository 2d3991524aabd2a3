"""Cloud-optimised LAZ (COPC 1.0): a LAZ 1.4 file whose chunks are the nodes of an octree, so that readers fetch parts.

The specification is https://copc.io. No library for Python both keeps the descriptors of extra bytes and writes a cloud
without an object for each point, so the octree (`geo.octree`) and the two records of COPC are made here; lazrs
compresses.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from copy import deepcopy
from typing import BinaryIO

import laspy
import lazrs
import numpy as np

from geo.octree import CELLS, Octree, build_octree

SUFFIX = ".copc.laz"
_INFO, _HIERARCHY = ("copc", 1), ("copc", 1000)
# Centre, half side, spacing, root page (offset and size), first and last GPS time, reserved.
_INFO_LAYOUT = "<3d2d2Q2d88x"
_EXTENDED_HEAD = "<2x16sHQ32s"
# Nodes that are compressed at a time, on all cores; points that are made into records at a time otherwise.
_BATCH, _PORTION = 16, 500_000
_CHUNK_TABLE_OFFSET = 8

Records = Callable[[slice | np.ndarray], laspy.LasData]


def write_copc(
    header: laspy.LasHeader, records: Records, count: int, stream: BinaryIO, portion: int = _PORTION
) -> None:
    """Write points of format 6, 7 or 8 as COPC; the stream can be read and sought in.

    Records are made a portion at a time, once for the places of the points and once, node by node, to be written.

    Parameters
    ----------
    header : laspy.LasHeader
        Of the records.
    records : callable
        Records of some rows: a slice, or indices (n,).
    count : int
        Number of points, one at least.
    portion : int
        Points that are made into records at a time, where they are not those of nodes.

    Raises
    ------
    lazrs.LazrsError
        If the system refuses to write.
    """
    # laspy counts the points of each record that is made in the header of the records.
    header = deepcopy(header)
    header.partial_reset()
    places = [np.empty(count, dtype=np.int32) for _ in "XYZ"]
    for first in range(0, count, portion):
        part = slice(first, first + portion)
        points = records(part).points
        header.grow(points)
        for place, axis in zip(places, "XYZ", strict=True):
            place[part] = points.array[axis]
    header.are_points_compressed = True
    finest = header.scales.min()
    per_step = np.round(header.scales / finest).astype(np.int64)
    tree = build_octree(places, per_step)
    del places
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
    low = header.offsets + tree.corner * finest
    half = 0.5 * tree.side * finest
    info.record_data = struct.pack(
        _INFO_LAYOUT,
        *(low + half),
        half,
        2.0 * half / CELLS,
        page_at,
        len(page),
        header.min_gps_time,
        header.max_gps_time,
    )
    stream.seek(start)
    header.write_to(stream, ensure_same_size=True)
    stream.seek(0, 2)


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
