"""The paint of a bed: sand drawn at a resolution, a checker, an image laid from above, or colours of vertices."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from PIL import Image

from fields.gamma import GAMMA
from survey.errors import SurveyError
from survey.simulate.ground.paint import sand
from survey.simulate.ground.skin import ImageSkin, VertexSkin, skin_from_above
from survey.simulate.ground.triangles import TriangleMesh
from survey.simulate.scene_file import TextureSettings

# Texels of the largest texture: 12 bytes each, and as much again while it is drawn.
_MOST_TEXELS = 80_000_000
_DARK, _BRIGHT = 0.08, 0.6

Area = tuple[float, float, float, float]


def skin_of_bed(
    settings: TextureSettings, folder: Path, shape, rgb: np.ndarray | None, area: Area, seed: int
) -> ImageSkin | VertexSkin:
    """The skin of a bed.

    Parameters
    ----------
    shape : BedGrid or TriangleMesh
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
