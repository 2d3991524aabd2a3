"""A level square in a map grid and clouds about it, for tests of `compare`."""

import laspy
import numpy as np
from laspy.vlrs.known import GeoKeyDirectoryVlr, GeoKeyEntryStruct
from pyproj import CRS

from geo import LocalFrame, write_cloud
from survey.compare.comparison import CompareOptions, compare_files
from survey.compare.figures import numbers_of

UTM32 = CRS("EPSG:25832+5778")
# On the central meridian, so that rows of the grid are rows of the local frame.
ORIGIN = (500000.0, 5194736.0, 2105.0)
FRAME = LocalFrame(UTM32, ORIGIN)
# LAS stores millimetres: half of one along each axis, seen along one direction.
LAS_M = 0.5e-3
HALF = 5.0
NUM_SAMPLES = 50_000


def write_mesh(path, vertices, faces):
    """A PLY in text, with coordinates to 0.1 micrometre."""
    lines = ["ply", "format ascii 1.0", f"element vertex {len(vertices)}"]
    lines += [f"property double {axis}" for axis in "xyz"]
    lines += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    lines += [" ".join(f"{value:.10f}" for value in vertex) for vertex in vertices]
    lines += [f"3 {a} {b} {c}" for a, b, c in faces]
    path.write_text("\n".join(lines) + "\n")
    return path


def write_plane(path):
    """A square of 10 m x 10 m at height 0 of the local frame, in crs, wound to face down."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * [HALF, HALF, 1.0]
    return write_mesh(path, FRAME.crs_from_local(corners), [[0, 2, 1], [0, 3, 2]])


def write_las(path, points, crs=UTM32, depth=None, num_views=0, incidence_deg=0.0):
    """A cloud in crs; its values are those of all points, or one each."""
    n = len(points)
    depth = np.broadcast_to(np.nan if depth is None else depth, n)
    write_cloud(
        path,
        points,
        crs,
        rgb=np.zeros((n, 3), np.uint8),
        depth_m=depth,
        std_m=np.zeros(n),
        num_views=np.broadcast_to(num_views, n),
        incidence_deg=np.broadcast_to(incidence_deg, n),
        is_wet=depth > 0,
    )
    return path


def keyed_las(path, keys, points):
    """A LAS 1.2 file of points whose CRS is that of GeoTIFF keys."""
    header, table = laspy.LasHeader(version="1.2", point_format=3), GeoKeyDirectoryVlr()
    table.geo_keys_header.number_of_keys = len(keys)
    table.geo_keys = [GeoKeyEntryStruct(id=k, tiff_tag_location=0, count=1, value_offset=v) for k, v in keys.items()]
    header.scales, header.offsets = [0.001] * 3, np.floor(points[0])
    header.vlrs.append(table)
    las = laspy.LasData(header)
    las.x, las.y, las.z = points.T
    las.write(path)
    return path


def grid(step, height=0.0, half=HALF):
    """Points in rows and columns over the plane, local [m]."""
    x, y = np.meshgrid(np.arange(-half, half + 1e-9, step), np.arange(-half, half + 1e-9, step))
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, height)], axis=1)


def compared(cloud, reference, **options):
    """The numbers of a comparison as JSON holds them; options as `CompareOptions`."""
    return numbers_of(compare_files(cloud, reference, options=CompareOptions(**options)))
