"""Bodies from files, scaled, turned, heeled and set on the bed; and what they and the bed are painted with.

Paint is sand drawn at a resolution, a checker, an image laid from above, or colours of vertices.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from PIL import Image

from fields.image_store import GAMMA
from geo import Mesh, read_reference
from survey.errors import SurveyError
from survey.simulate.ground.ground import Material, shade_beside_bed
from survey.simulate.ground.paint import ImageSkin, VertexSkin, periodic, sand, skin_from_above
from survey.simulate.ground.shapes import TriangleMesh, rotation
from survey.simulate.light import Light
from survey.simulate.scene_file import ObjectSettings, TextureSettings

# From a file in which y points up to one in which z does.
_Z_UP_FROM_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
# Texels of the largest texture: 12 bytes each, and as much again while it is drawn.
_MOST_TEXELS = 80_000_000
_DARK, _BRIGHT = 0.08, 0.6

Area = tuple[float, float, float, float]


def place_object(settings: ObjectSettings, folder: Path, bed, light: Light) -> tuple[TriangleMesh, Material]:
    """A body with its look, standing on the bed.

    The axes of the file are those of a ship: x ahead, z up; heel turns about x, then pitch about y, yaw about z. The
    middle of its extent comes to `at`, its lowest point ``above_bed_m`` over the bed there.

    Raises
    ------
    SurveyError, GeoError
        If the file has no faces or cannot be read.
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
    skin = _speckled(shape, settings) if mesh.rgb is None else vertex_skin(shape, mesh.rgb)
    return shape, Material(skin, shade_beside_bed(shape, bed, light))


def _speckled(shape: TriangleMesh, settings: ObjectSettings) -> ImageSkin:
    """A periodic speckle of one colour, laid along the axes of local on the faces that look along the third one."""
    rng = np.random.default_rng([len(shape.faces), 10])
    tile = np.exp(sum(0.15 * periodic(rng, size) for size in (2, 4, 8, 32)))
    image = (tile[..., None] * np.array(settings.colour)).astype(np.float32)
    axes = np.eye(3)[[[1, 2], [2, 0], [0, 1]]] / settings.texel_m
    texel_from_point = np.concatenate([axes, np.zeros((3, 2, 1))], axis=-1)
    return ImageSkin(image, texel_from_point, np.abs(shape.normals).argmax(axis=1), repeats=True)


def skin_of_bed(
    settings: TextureSettings, folder: Path, shape, rgb: np.ndarray | None, area: Area, seed: int
) -> ImageSkin | VertexSkin:
    """The skin of a bed.

    Parameters
    ----------
    rgb : (V, 3) uint8 or None
        Colours of its vertices.
    area : west, south, east, north [m], local
        Area to cover; an image is centred on the origin.

    Raises
    ------
    SurveyError
        If the texture is too fine for memory, or data of the bed or the image is missing.
    """
    if settings.kind == "vertex":
        if rgb is None:
            raise SurveyError('texture.kind is "vertex", but the file of the bed has no colours; give another kind')
        return vertex_skin(shape, rgb)
    if settings.file is not None:
        return _image(folder / settings.file, settings.texel_m)
    if settings.kind == "checker":
        return _checker(settings.square_m, area)
    texel = settings.texel_m
    west, south, east, north = area
    require_texels(texel, area)
    size = (math.ceil((north - south) / texel) + 1, math.ceil((east - west) / texel) + 1)
    return skin_from_above(sand(size, texel, np.random.default_rng([seed, 9])), west, south, texel)


def require_texels(texel_m: float, area: Area) -> None:
    """Raise SurveyError if a texture over an area is too fine for memory."""
    rows, columns = (area[3] - area[1]) / texel_m, (area[2] - area[0]) / texel_m
    if rows * columns > _MOST_TEXELS:
        coarser = texel_m * math.sqrt(rows * columns / _MOST_TEXELS)
        raise SurveyError(
            f"texture.texel_m is {texel_m:g}, which takes {columns:.0f} x {rows:.0f} texels for what the cameras see; "
            f"give {coarser + 5e-4:.3f} or more, or fly lower"
        )


def vertex_skin(shape: TriangleMesh, rgb: np.ndarray) -> VertexSkin:
    """Colours (V, 3) uint8 of a file as linear albedo."""
    vertices, faces, _ = shape.mesh()
    return VertexSkin((np.asarray(rgb) / 255.0) ** GAMMA, vertices, faces)


def linear_image(path: Path) -> np.ndarray:
    """An image file as linear albedo (rows, columns, 3) float32."""
    try:
        with Image.open(path) as image:
            return ((np.asarray(image.convert("RGB")) / 255.0) ** GAMMA).astype(np.float32)
    except OSError as error:
        raise SurveyError(f"{path} cannot be read as an image ({error}); correct the path or convert it") from error


def _image(path: Path, texel_m: float) -> ImageSkin:
    # The first row of an image is its north.
    image = np.ascontiguousarray(linear_image(path)[::-1])
    rows, columns = image.shape[:2]
    west, south = -0.5 * (columns - 1) * texel_m, -0.5 * (rows - 1) * texel_m
    return skin_from_above(image, west, south, texel_m)


def _checker(square: float, area: Area) -> ImageSkin:
    """Squares with sharp borders; one corner lies on the origin. A texel is a square."""
    west, south, east, north = (math.floor(area[0] / square), math.floor(area[1] / square), *area[2:])
    columns, rows = math.ceil(east / square) - west, math.ceil(north / square) - south
    bright = (np.arange(rows)[:, None] + south + np.arange(columns) + west) % 2 == 0
    image = np.where(bright, _BRIGHT, _DARK)[..., None] * np.ones(3, dtype=np.float32)
    middle = (west + 0.5) * square, (south + 0.5) * square
    return skin_from_above(image.astype(np.float32), *middle, square, sharp=True)
