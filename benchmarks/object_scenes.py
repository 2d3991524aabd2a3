"""Objects with known surfaces to compare fields on: a wreck from the air, a sailing ship, a hull under water."""

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.ndimage import grey_opening
from scipy.spatial import cKDTree
from study import thinned, tops

from fields.volume.paths import Box
from fields.volume.photographs import Photographs
from geo import read_reference
from refract import FlatWater, PinholeCamera
from survey.folder.survey import load_survey
from survey.photos.images import load_image
from survey.simulate.conditions import Light, WaterOptics
from survey.simulate.direct import DirectRenderer
from survey.simulate.ground import NOTHING, Ground, Material, place_object, plane, texture_of_bed
from survey.simulate.scene_file import ObjectSettings, TextureSettings
from survey.simulate.shapes import TriangleMesh

GAMMA = 2.2
# One photograph in so many is held out.
HELD_EVERY = 8
NAMES = ("wreck", "ship", "hull")
QUARTERS = np.array([[-0.25, -0.25], [0.25, -0.25], [-0.25, 0.25], [0.25, 0.25]])
# Grains finer than this are left out of sand and speckle [m]: some two cells of the CPU-sized fields.
GRAIN_M = 0.06


@dataclass(frozen=True)
class ObjectScene:
    """Photographs of an object, and its surface.

    Attributes
    ----------
    name : str
    box : Box
    train, held : Photographs
        To learn from, and to compare with; of each the pixels whose surface lies in the box.
    surface : (N, 3) [m], local
        Points of what the photographs see inside the box.
    """

    name: str
    box: Box
    train: Photographs
    held: Photographs
    surface: np.ndarray


def load_scene(name: str, data: Path, scale: float) -> ObjectScene:
    """One of `NAMES`; ``scale`` is that of the pictures, 1 for full size.

    Raises
    ------
    ValueError
        For another name.
    """
    if name == "wreck":
        return _wreck(data / "wreck_dry", scale)
    if name == "ship":
        file = data / "real" / "ships" / "dutch_ship_medium_geometry_only.gltf"
        ship = ObjectSettings(str(file), (0.0, 0.0), scale=0.2, texel_m=GRAIN_M, colour=(0.5, 0.36, 0.22))
        return _orbit(name, ship, scale, lift=(10.0, 25.0, 45.0), water=None)
    if name == "hull":
        with TemporaryDirectory() as folder:
            file = Path(folder) / "hull.obj"
            file.write_text(_wigley_hull())
            hull = ObjectSettings(str(file), (0.0, 0.0), heel_deg=25.0, yaw_deg=30.0, texel_m=GRAIN_M)
            return _orbit(name, hull, scale, lift=(50.0, 65.0, 80.0), water=FlatWater((0.0, 0.0, 2.5), n_water=1.333))
    raise ValueError(f"there is no object {name}; expected one of {', '.join(NAMES)}")


def _wreck(folder: Path, scale: float) -> ObjectScene:
    """What rises over the bed of a drawn survey, with a metre of bed around it."""
    survey = load_survey(folder)
    seen = survey.frame.local_from_crs(read_reference(folder / "visible.ply").points)
    bed = float(np.median(seen[:, 2]))
    above = seen[standing_out(seen, reach=8.0) > 1.5]
    low, high = above.min(axis=0), above.max(axis=0)
    box = Box(np.r_[low[:2] - 1.0, seen[:, 2].min() - 0.2], high + np.array([1.0, 1.0, 0.2]))
    views = [v for v in survey.views if _looks_at(v.camera, box)]
    cameras = [v.camera.scaled(scale) for v in views]
    pictures = [load_image(v, scale=scale) for v in views]
    pixels = [_over(camera, box, bed) for camera in cameras]
    inside = ((seen > box.low) & (seen < box.high)).all(axis=1)
    return _split("wreck", box, cameras, pictures, pixels, None, seen[inside])


def standing_out(points: np.ndarray, reach: float) -> np.ndarray:
    """Heights (N,) [m] of points over the ground that a square of ``reach`` [m] can touch from below."""
    cell = 0.5
    top, row, column = tops(points, cell)
    top[np.isinf(top)] = np.median(points[:, 2])
    ground = grey_opening(top, size=round(reach / cell))
    return points[:, 2] - ground[row, column]


def _looks_at(camera: PinholeCamera, box: Box) -> bool:
    u, v = camera.project(0.5 * (box.low + box.high), None)
    return bool(0 <= u < camera.width and 0 <= v < camera.height)


def _over(camera: PinholeCamera, box: Box, bed: float) -> np.ndarray:
    """Flat indices of the pixels that look through the top of a box onto a level bed inside it."""
    direction = camera.directions(camera.pixel_centres().reshape(-1, 2))
    inside = np.ones(len(direction), dtype=bool)
    for z in (bed, box.high[2]):
        at = camera.centre + direction * ((z - camera.centre[2]) / direction[:, 2])[:, None]
        inside &= ((at > box.low) & (at < box.high))[:, :2].all(axis=1)
    return np.flatnonzero(inside)


def _wigley_hull(length: float = 5.0, beam: float = 1.2, draught: float = 0.8) -> str:
    """Wigley's parabolic hull, y = beam / 2 (1 - (2 x / length)^2) (1 - (z / draught)^2), open above, as an OBJ."""
    x, z = np.meshgrid(np.linspace(-1.0, 1.0, 81), np.linspace(-1.0, 0.0, 25), indexing="ij")
    y = (1.0 - x**2) * (1.0 - z**2)
    lines = [
        f"v {0.5 * length * a:.5f} {side * 0.5 * beam * b:.5f} {draught * c:.5f}"
        for side in (1, -1) for a, b, c in zip(x.ravel(), y.ravel(), z.ravel(), strict=True)
    ]  # fmt: skip
    corner = (25 * np.arange(80)[:, None] + np.arange(24)).ravel() + 1
    for a in corner:
        lines += [f"f {a} {a + 25} {a + 26}", f"f {a} {a + 26} {a + 1}"]
        b = a + x.size
        lines += [f"f {b} {b + 26} {b + 25}", f"f {b} {b + 1} {b + 26}"]
    return "\n".join(lines) + "\n"


def _orbit(
    name: str, settings: ObjectSettings, scale: float, *, lift: tuple[float, ...], water: FlatWater | None
) -> ObjectScene:
    """A body on level sand, from rings of cameras at elevations ``lift`` [deg]."""
    light = Light()
    reach = 12.0
    area = (-reach, -reach, reach, reach)
    bed = plane(area, 0.0)
    body, material = place_object(settings, Path(), bed, light)
    low, high = body.vertices.min(axis=0), body.vertices.max(axis=0)
    box = Box(np.r_[low[:2] - 0.3, -0.15], high + np.array([0.3, 0.3, 0.15]))
    # In air the sand ends with the box, before black; under water it goes on, and what lies beyond the box is masked.
    (x0, y0), (x1, y1) = ((-reach, -reach), (reach, reach)) if water else (box.low[:2], box.high[:2])
    corners = np.array([[x0, y0, 0.0], [x1, y0, 0.0], [x1, y1, 0.0], [x0, y1, 0.0]])
    sand = Material(
        texture_of_bed(TextureSettings(texel_m=GRAIN_M), Path(), bed, None, area, 1),
        lambda points, face: np.ones(len(points)),
    )
    floor = TriangleMesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))
    renderer = DirectRenderer(Ground(floor, (body,), (sand, material)), water, WaterOptics())
    cameras = _rings(box, scale, lift, above=None if water is None else 2.5 * box.edge)
    pictures, pixels, surface = [], [], []
    for camera in cameras:
        grid = camera.pixel_centres().reshape(-1, 2)
        hits = renderer.trace(camera, grid)
        inside = ((hits.points > box.low) & (hits.points < box.high)).all(axis=1)
        # The mean of four rays in linear light: a field is a mean over cells, and cannot draw what one ray hits.
        light_seen = sum(renderer.radiance(camera, grid + aside) for aside in QUARTERS) / len(QUARTERS)
        stored = np.clip(light_seen, 0.0, 1.0) ** (1.0 / GAMMA)
        pictures.append(np.round(255.0 * stored).astype(np.uint8).reshape(camera.height, camera.width, 3))
        pixels.append(np.flatnonzero(inside | (hits.body == NOTHING)))
        surface.append(hits.points[inside])
    return _split(name, box, cameras, pictures, pixels, water, thinned(np.concatenate(surface), box.edge / 256.0))


def _rings(box: Box, scale: float, lift: tuple[float, ...], above: float | None) -> list[PinholeCamera]:
    """Sixteen cameras on each ring; their pictures hold the box."""
    middle, cameras = 0.5 * (box.low + box.high), []
    away = above or 2.2 * box.edge
    width, height = round(800 * scale), round(600 * scale)
    focal = height * away / (1.15 * box.edge)
    for ring, degrees in enumerate(lift):
        for k in range(16):
            turn, rise = np.radians(22.5 * k + 7.0 * ring), np.radians(degrees)
            back = np.array([np.cos(turn) * np.cos(rise), np.sin(turn) * np.cos(rise), np.sin(rise)])
            right = np.array([-np.sin(turn), np.cos(turn), 0.0])
            rows = np.stack([right, np.cross(-back, right), -back])
            cameras.append(
                PinholeCamera(middle + away * back, rows, focal, focal, width / 2, height / 2, width, height)
            )
    return cameras


def _split(name, box, cameras, pictures, pixels, water, surface) -> ObjectScene:
    held = [k for k in range(len(cameras)) if k % HELD_EVERY == HELD_EVERY // 2]
    rest = [k for k in range(len(cameras)) if k not in held]
    parts = (
        Photographs([cameras[k] for k in of], [pictures[k] for k in of], [pixels[k] for k in of], water)
        for of in (rest, held)
    )
    return ObjectScene(name, box, *parts, surface)


def chamfer(points: np.ndarray, surface: np.ndarray) -> float:
    """Mean of the mean distances [m] from each cloud to the other."""
    there, _ = cKDTree(surface).query(points)
    back, _ = cKDTree(points).query(surface)
    return float(0.5 * (there.mean() + back.mean()))
