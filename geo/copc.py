"""Cloud-optimised LAZ (COPC 1.0): a LAZ 1.4 file whose chunks are the nodes of an octree, so that readers fetch parts.

The specification is https://copc.io. No library for Python both keeps the descriptors of extra bytes and writes a cloud
without an object for each point, so the octree (`geo.octree`) and the two records of COPC are made here; lazrs
compresses.
"""

from __future__ import annotations

import struct
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
# Nodes that are compressed at a time, on all cores.
_BATCH = 16
_CHUNK_TABLE_OFFSET = 8


def write_copc(las: laspy.LasData, stream: BinaryIO) -> None:
    """Write points of format 6, 7 or 8 as COPC; the stream can be read and sought in.

    Parameters
    ----------
    las : laspy.LasData
        One point at least. Its header is changed.

    Raises
    ------
    lazrs.LazrsError
        If the system refuses to write.
    """
    header = las.header
    header.update(las.points)
    header.are_points_compressed = True
    finest = header.scales.min()
    per_step = np.round(header.scales / finest).astype(np.int64)
    tree = build_octree([las.points.array[axis] for axis in "XYZ"], per_step)
    laz = lazrs.LazVlr.new_for_compression(
        header.point_format.id, header.point_format.num_extra_bytes, use_variable_size_chunks=True
    )
    info = laspy.VLR(*_INFO, "COPC info", bytes(struct.calcsize(_INFO_LAYOUT)))
    # COPC asks for its record at byte 375, before all others.
    header.vlrs.insert(0, info)
    header.vlrs.insert(1, laspy.VLR("laszip encoded", 22204, "lazrs", laz.record_data()))
    start = stream.tell()
    header.write_to(stream)
    _write_chunks(stream, laz, las.points.array, tree)
    end = stream.tell()
    page = _page(stream, laz, header.offset_to_point_data, tree)
    stream.seek(end)
    stream.write(struct.pack(_EXTENDED_HEAD, _HIERARCHY[0].encode(), _HIERARCHY[1], len(page), b"EPT hierarchy"))
    page_at = stream.tell()
    stream.write(page)
    header.start_of_first_evlr, header.number_of_evlrs = end, 1
    low = header.offsets + tree.corner * finest
    half = 0.5 * tree.side * finest
    times = np.asarray(las.points.array["gps_time"])
    info.record_data = struct.pack(
        _INFO_LAYOUT, *(low + half), half, 2.0 * half / CELLS, page_at, len(page), times.min(), times.max()
    )
    stream.seek(start)
    header.write_to(stream, ensure_same_size=True)
    stream.seek(0, 2)


def _write_chunks(stream: BinaryIO, laz: lazrs.LazVlr, points: np.ndarray, tree: Octree) -> None:
    """The points of each node as one chunk, in the order of the nodes."""
    compressor = lazrs.ParLasZipCompressor(stream, laz)
    compressor.reserve_offset_to_chunk_table()
    ends = np.cumsum(tree.counts)
    for first in range(0, len(ends), _BATCH):
        rows = [
            tree.order[end - count : end]
            for end, count in zip(ends[first : first + _BATCH], tree.counts[first : first + _BATCH], strict=True)
        ]
        compressor.compress_chunks([points[row].view(np.uint8) for row in rows])
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
