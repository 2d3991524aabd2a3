"""A drawn bed over the small survey: a plane that rises out of the water, as a run would find it."""

from pathlib import Path

import numpy as np

from fields.sweep.bed import BedPoints
from fields.sweep.maps import HeightMap
from survey.folder.survey import Survey

SPACING_M = 0.1
# Neighbouring points differ by 4.7 mm, so that what LAS rounds off is spread evenly over a millimetre.
SLOPE = 0.047


def plane_bed(survey: Survey, *, num: int = 140, depth_m: float = 0.3) -> BedPoints:
    """Points of a regular grid, ``num`` by ``num``, on a plane that rises to the east and is wet in the west.

    The plane lies ``depth_m`` under local z = 0 in the middle.
    """
    along = SPACING_M * (np.arange(num) - 0.5 * (num - 1))
    x, y = (v.ravel() for v in np.meshgrid(along, along))
    z = SLOPE * x - depth_m
    n = len(z)
    water = survey.water
    depth = np.full(n, np.nan) if water is None else water.height(x, y) - z
    grey = (127 + 100 * np.sin(3.0 * x) * np.cos(2.0 * y)).astype(np.uint8)
    return BedPoints(
        np.stack([x, y, z], axis=-1),
        np.stack([grey, grey, 255 - grey], axis=-1),
        np.linspace(0.005, 0.015, n, dtype=np.float32),
        (2 + np.arange(n) % 5).astype(np.uint8),
        depth.astype(np.float32),
        np.linspace(0.0, 0.5, n, dtype=np.float32),
        depth > 0.0 if water else np.zeros(n, dtype=bool),
    )


def plane_height_map(survey: Survey, view: int, *, shape: tuple[int, int] = (48, 64)) -> HeightMap:
    """A height map that falls from dry at the right to wet at the left, a quarter of it not confirmed."""
    height = np.broadcast_to(np.linspace(-1.0, 0.4, shape[1], dtype=np.float32), shape).copy()
    agreeing = np.full(shape, 3, dtype=np.uint8)
    agreeing[: shape[0] // 2, : shape[1] // 2] = 0
    ones = np.ones(shape, dtype=np.float32)
    return HeightMap(view, height, ones, agreeing, 0.01 * ones)


def write_plane_mesh(path: Path, survey: Survey, *, raised_m: float, half_m: float = 8.0) -> Path:
    """The plane of `plane_bed` (at its default depth), raised, as a PLY mesh of two triangles in crs."""
    corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) * half_m
    local = np.column_stack([corners, SLOPE * corners[:, 0] - 0.3 + raised_m])
    lines = [" ".join(f"{v:.6f}" for v in p) for p in survey.frame.crs_from_local(local)]
    head = "ply\nformat ascii 1.0\nelement vertex 4\nproperty double x\nproperty double y\nproperty double z\n"
    faces = "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
    path.write_text(head + faces + "\n".join(lines) + "\n3 0 1 2\n3 0 2 3\n")
    return path
