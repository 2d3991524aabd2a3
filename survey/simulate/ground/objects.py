"""Bodies from files, scaled, turned, heeled and set on the bed."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from geo import Mesh, read_reference
from survey.errors import SurveyError
from survey.simulate.ground.ground import Look, shade_beside_bed
from survey.simulate.ground.paint import periodic
from survey.simulate.ground.shapes import rotation
from survey.simulate.ground.skin import ImageSkin
from survey.simulate.ground.texture import vertex_skin
from survey.simulate.ground.triangles import TriangleMesh
from survey.simulate.light import Light
from survey.simulate.scene_file import ObjectSettings

# From a file in which y points up to one in which z does.
_Z_UP_FROM_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def place_object(settings: ObjectSettings, folder: Path, bed, light: Light) -> tuple[TriangleMesh, Look]:
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
    return shape, Look(skin, shade_beside_bed(shape, bed, light))


def _speckled(shape: TriangleMesh, settings: ObjectSettings) -> ImageSkin:
    """A periodic speckle of one colour, laid along the axes of local on the faces that look along the third one."""
    rng = np.random.default_rng([len(shape.faces), 10])
    tile = np.exp(sum(0.15 * periodic(rng, size) for size in (2, 4, 8, 32)))
    image = (tile[..., None] * np.array(settings.colour)).astype(np.float32)
    axes = np.eye(3)[[[1, 2], [2, 0], [0, 1]]] / settings.texel_m
    texel_from_point = np.concatenate([axes, np.zeros((3, 2, 1))], axis=-1)
    return ImageSkin(image, texel_from_point, np.abs(shape.normals).argmax(axis=1), repeats=True)
