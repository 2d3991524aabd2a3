"""Everything solid in a scene: the bed, the bodies on it, their materials, the first hit of a ray, and the extent.

Bodies from files are scaled, turned, heeled and set on the bed. Textures of the bed are sand drawn at a resolution, a
checker, an image draped from above, or colours of vertices.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import igl
import numpy as np
from scipy.spatial import Delaunay, QhullError

from fields.image_store import GAMMA
from geo import Cloud, LocalFrame, Mesh, read_reference, require_same_crs
from geo.crs import height_unit_m
from geo.shapes import ground_of, in_height_unit
from refract import PinholeCamera
from survey.errors import SurveyError
from survey.photos.images import eight_bits
from survey.photos.pixels import read_rgb
from survey.simulate.conditions import Light
from survey.simulate.scene_file import BedSettings, ObjectSettings, TextureSettings
from survey.simulate.shapes import BedGrid, Solid, TriangleMesh, near_solids, rotation
from survey.simulate.textures import ImageTexture, VertexTexture, draped_texture, look_up, periodic, sand

# The body of a hit on the bed, and of a ray that meets nothing.
BED, NOTHING = -1, -2

Shape = BedGrid | Solid | TriangleMesh
Shade = Callable[[np.ndarray, np.ndarray], np.ndarray]
# Margin beyond the view of the outermost pixels [m].
_MARGIN_M = 0.5
# Spacing of the vertices of a level bed [m]: only light is interpolated between them.
_PLANE_CELL_M = 0.5


@dataclass(frozen=True)
class Material:
    """Lambertian material of a body: albedo, and light in the mode without light transport."""

    texture: ImageTexture | VertexTexture
    shade: Shade  # callable: light (N,) at points (N, 3) on faces (N,) in the mode without light transport


@dataclass(frozen=True)
class Ground:
    """Everything solid in a scene, with Lambertian appearance."""

    bed: BedGrid | TriangleMesh
    solids: tuple[Solid | TriangleMesh, ...]  # tuple of Solid or TriangleMesh: the bodies on the bed
    materials: tuple[Material, ...]  # Of the bed, then of each body

    def first_hit(self, origin: np.ndarray, direction: np.ndarray, t_end: np.ndarray):
        """First hits of rays up to ``t_end``: distance (N,) [m], body (N,) and face (N,).

        The distance is infinite, and the body `NOTHING`, where a ray meets nothing.
        """
        t, face = self.bed.hit(origin, direction, t_end)
        body = np.where(np.isfinite(t), BED, NOTHING)
        ends = np.minimum(t, t_end)
        top = max((solid.centre[2] + solid.radius for solid in self.solids), default=-np.inf)
        # Most rays through air end above all bodies.
        low = np.flatnonzero(origin[:, 2] + ends * direction[:, 2] < top)
        if not low.size:
            return t, body, face
        near = near_solids(self.solids, origin[low], direction[low], ends[low])
        for index, solid in enumerate(self.solids):
            rays = low[near[:, index]]
            t_solid, face_solid = solid.hit(origin[rays], direction[rays], t_end[rays])
            nearer = t_solid < t[rays]
            rays = rays[nearer]
            t[rays], body[rays], face[rays] = t_solid[nearer], index, face_solid[nearer]
        return t, body, face

    def colour(self, points: np.ndarray, body: np.ndarray, face: np.ndarray) -> np.ndarray:
        """Linear radiance (N, 3) of points (N, 3) [m] in dry air; black where there is nothing."""
        colour = np.zeros((len(points), 3))
        for index, material in enumerate(self.materials, start=BED):
            on = np.flatnonzero(body == index)
            if on.size:
                shade = material.shade(points[on], face[on])
                colour[on] = material.texture.albedo(points[on], face[on]) * shade[:, None]
        return colour


def shade_of_map(bed: BedGrid, lit: np.ndarray) -> Shade:
    """Light on a bed from values (ny, nx) at its vertices."""
    lit = np.ascontiguousarray(lit, dtype=np.float32)
    return lambda points, face: look_up(lit, (points[:, :2] - (bed.west, bed.south)) / bed.cell)[:, 0]


def shade_of_normals(normals: np.ndarray, light: Light) -> Shade:
    """Light on faces by their normals (F, 3)."""
    lit = light.irradiance(normals)
    return lambda points, face: lit[face]


def shade_beside_bed(solid: Solid | TriangleMesh, bed: BedGrid | TriangleMesh, light: Light) -> Shade:
    """Light on a body by its normals, darker near the bed."""
    lit = light.irradiance(solid.normals)

    def shade(points: np.ndarray, face: np.ndarray) -> np.ndarray:
        over_bed = (points[:, 2] - bed.height(points[:, 0], points[:, 1])) / (0.6 * solid.radius)
        # Beside a bed of limited extent there is no corner.
        over_bed = np.nan_to_num(over_bed, nan=1.0)
        return lit[face] * (0.6 + 0.4 * np.clip(over_bed, 0.0, 1.0))

    return shade


def seen_area(
    cameras: Sequence[PinholeCamera], size_m: tuple[float, float], lowest: float
) -> tuple[float, float, float, float]:
    """West, south, east and north [m], local, of an area about the origin and of everything that cameras see.

    The area has sides (east, north) [m]; `lowest` [m] is a height below all of the bed. Rays count as straight, which
    reaches further than under water.
    """
    corners = [0.5 * np.array(size_m), -0.5 * np.array(size_m)]
    for camera in cameras:
        u, v = np.meshgrid([0.0, camera.width], [0.0, camera.height])
        rays = camera.directions(np.stack([u.ravel(), v.ravel()], axis=-1))
        t = (camera.centre[2] - lowest) / -rays[:, 2]
        corners.extend((camera.centre + t[:, None] * rays)[:, :2])
    low, high = np.min(corners, axis=0) - _MARGIN_M, np.max(corners, axis=0) + _MARGIN_M
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def bed_from_file(path: Path, settings: BedSettings, frame: LocalFrame) -> tuple[TriangleMesh, np.ndarray | None]:
    """The bed from a file, in local, and the colours (V, 3) uint8 of its vertices if it has any."""
    in_crs = settings.frame == "crs"
    shape = in_height_unit(read_reference(path), height_unit_m(frame.crs) if in_crs else 1.0)
    if isinstance(shape, Cloud):
        shape, _ = ground_of(shape, path)
    points, faces = (shape.vertices, shape.faces) if isinstance(shape, Mesh) else (shape.points, None)
    if settings.kind == "mesh" and faces is None:
        raise SurveyError(f'{path} has no faces; give kind = "cloud" in [bed], or a mesh')
    if in_crs:
        require_same_crs(frame.crs, shape.crs, "the scene", str(path))
        points = frame.local_from_crs(points)
        if not np.isfinite(points).all():
            raise SurveyError(
                f"{path} has coordinates that are not on the map of {frame.crs.name}; correct crs or bed.frame"
            )
    if settings.kind == "mesh" and faces is not None:
        return TriangleMesh(points, faces), shape.rgb
    rgb = shape.rgb
    if settings.spacing_m is not None:
        # The mean of the points in each square cell.
        cells, low = np.floor((points[:, :2] - points[:, :2].min(axis=0)) / settings.spacing_m), points.min(axis=0)
        cell, counts = np.unique(cells.astype(np.int64), axis=0, return_inverse=True, return_counts=True)[1:]
        values = points - low if rgb is None else np.column_stack([points - low, rgb])
        means = np.stack([np.bincount(cell.ravel(), column) / counts for column in values.T], axis=-1)
        points, rgb = low + means[:, :3], None if rgb is None else np.round(means[:, 3:]).astype(np.uint8)
    try:
        return mesh_of_points(points, settings.smoothing), rgb
    except (QhullError, ValueError) as error:
        raise SurveyError(
            f"{path} has {len(points)} points, expected a cloud that covers the bed: three or more, not on one line"
        ) from error


def mesh_of_points(points: np.ndarray, smoothing: int) -> TriangleMesh:
    """Triangles between points (N, 3) [m], local: 2.5D Delaunay in plan view, smoothed along the plumb line.

    Each pass moves every vertex to the mean height of its neighbours (Laplacian smoothing with full weight; places in
    plan view stay). The triangles fill the convex hull of the points.
    """
    faces = Delaunay(points[:, :2]).simplices.astype(np.int64)
    a, b, c = (points[faces[:, k], :2] for k in range(3))
    clockwise = (b - a)[:, 0] * (c - a)[:, 1] < (b - a)[:, 1] * (c - a)[:, 0]
    faces[clockwise] = faces[clockwise][:, ::-1]
    heights = points[:, 2].copy()
    links = igl.adjacency_matrix(faces)
    links.resize(len(heights), len(heights))
    for _ in range(smoothing):
        heights = links @ heights / np.maximum(np.asarray(links.sum(axis=1)).ravel(), 1)
    return TriangleMesh(np.concatenate([points[:, :2], heights[:, None]], axis=-1), faces)


def plane(area: tuple[float, float, float, float], z: float) -> BedGrid:
    """A level bed over west, south, east, north [m] at a height [m], local."""
    west, south, east, north = area
    cells = [max(int(np.ceil(size / _PLANE_CELL_M)), 1) for size in (north - south, east - west)]
    return BedGrid(np.full((cells[0] + 1, cells[1] + 1), z), west, south, _PLANE_CELL_M)


# From a file in which y points up to one in which z does.
_Z_UP_FROM_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
# Texels of the largest texture: 12 bytes each, and as much again while it is drawn.
_MOST_TEXELS = 80_000_000
_DARK, _BRIGHT = 0.08, 0.6

Area = tuple[float, float, float, float]


def place_object(settings: ObjectSettings, folder: Path, bed, light: Light) -> tuple[TriangleMesh, Material]:
    """A body from a file with its material, standing on the bed.

    The axes of the file are those of a ship: x ahead, z up; heel turns about x, then pitch about y, yaw about z. The
    middle of its extent comes to `at`, its lowest point ``above_bed_m`` over the bed there.
    """
    path = folder / settings.file
    mesh = read_reference(path)
    if not isinstance(mesh, Mesh):
        raise SurveyError(f"{path} has no faces; an object needs a mesh")
    points = mesh.vertices - mesh.vertices.mean(axis=0)
    if settings.up == "y":
        points = points @ _Z_UP_FROM_Y_UP.T
    yaw, pitch, heel = (math.radians(a) for a in (settings.yaw_deg, settings.pitch_deg, settings.heel_deg))
    points = settings.scale * points @ rotation(yaw, pitch, heel).T
    low, high = points.min(axis=0), points.max(axis=0)
    x, y = settings.at
    z = float(bed.height(x, y)) + settings.above_bed_m
    if not np.isfinite(z):
        raise SurveyError(f"{path} is placed at {x:g}, {y:g} m, outside the bed; correct at, in metres from the origin")
    shape = TriangleMesh(points - [*(0.5 * (low + high)[:2]), low[2]] + (x, y, z), mesh.faces)
    if mesh.rgb is not None:
        coloured = VertexTexture((np.asarray(mesh.rgb) / 255.0) ** GAMMA, *shape.mesh()[:2])
        return shape, Material(coloured, shade_beside_bed(shape, bed, light))
    # A periodic speckle of one colour by triplanar mapping: along the local axes nearest to the plane of each face.
    rng = np.random.default_rng([len(shape.faces), 10])
    tile = np.exp(sum(0.15 * periodic(rng, size) for size in (2, 4, 8, 32)))
    image = (tile[..., None] * np.array(settings.colour)).astype(np.float32)
    axes = np.eye(3)[[[1, 2], [2, 0], [0, 1]]] / settings.texel_m
    texel_from_point = np.concatenate([axes, np.zeros((3, 2, 1))], axis=-1)
    texture = ImageTexture(image, texel_from_point, np.abs(shape.normals).argmax(axis=1), repeats=True)
    return shape, Material(texture, shade_beside_bed(shape, bed, light))


def texture_of_bed(
    settings: TextureSettings, folder: Path, shape, rgb: np.ndarray | None, area: Area, seed: int
) -> ImageTexture | VertexTexture:
    """The texture of a bed over an area, by colours (V, 3) uint8 of its vertices or an image centred on the origin."""
    if settings.kind == "vertex":
        if rgb is None:
            raise SurveyError('texture.kind is "vertex", but the file of the bed has no colours; give another kind')
        return VertexTexture((np.asarray(rgb) / 255.0) ** GAMMA, *shape.mesh()[:2])
    if settings.file is not None:
        linear = ((np.arange(256) / 255.0) ** GAMMA).astype(np.float32)
        # The first row of an image is its north.
        image = np.ascontiguousarray(linear[eight_bits(read_rgb(folder / settings.file))][::-1])
        west, south = (-0.5 * (image.shape[k] - 1) * settings.texel_m for k in (1, 0))
        return draped_texture(image, west, south, settings.texel_m)
    if settings.kind == "checker":
        require_texels("texture.square_m", settings.square_m, area, "squares")
        # One corner lies on the origin. A texel is a square.
        square = settings.square_m
        first_column, first_row = math.floor(area[0] / square), math.floor(area[1] / square)
        columns, rows = math.ceil(area[2] / square) - first_column, math.ceil(area[3] / square) - first_row
        bright = (np.arange(rows)[:, None] + first_row + np.arange(columns) + first_column) % 2 == 0
        image = np.where(bright, _BRIGHT, _DARK)[..., None] * np.ones(3, dtype=np.float32)
        middle = (first_column + 0.5) * square, (first_row + 0.5) * square
        return draped_texture(image.astype(np.float32), *middle, square, sharp=True)
    texel = settings.texel_m
    west, south, east, north = area
    require_texels("texture.texel_m", texel, area)
    size = (math.ceil((north - south) / texel) + 1, math.ceil((east - west) / texel) + 1)
    return draped_texture(sand(size, texel, np.random.default_rng([seed, 9])), west, south, texel)


def require_texels(name: str, size_m: float, area: Area, what: str = "texels") -> None:
    """Raise SurveyError if a texture or grid over an area is too fine for memory; ``name``: the key of its spacing."""
    rows, columns = (area[3] - area[1]) / size_m, (area[2] - area[0]) / size_m
    if rows * columns > _MOST_TEXELS:
        coarser = size_m * math.sqrt(rows * columns / _MOST_TEXELS)
        raise SurveyError(
            f"{name} is {size_m:g}, which takes {columns:.6g} x {rows:.6g} {what} for what the cameras see; "
            f"give {coarser + 5e-4:.3f} or more, or fly lower"
        )
