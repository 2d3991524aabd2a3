"""A small survey with known truth, drawn without further input: for the demo and the tests.

python -m survey.simulate.drawn FOLDER [--tiny] [KEY=VALUE ...], with the keys of `DrawnScene`
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import math
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from geo.crs import parse_crs
from geo.errors import GeoError
from geo.frames import LocalFrame
from refract import PinholeCamera, channel_indices, water_index
from refract.lens import Lens
from survey.errors import SurveyError
from survey.files.toml_table import key, parse_toml, require_valid
from survey.folder.local_frame import water_plane
from survey.progress import Progress
from survey.settings.config import WaterConfig
from survey.simulate.conditions import Light, Sensor, WaterOptics
from survey.simulate.direct import DirectRenderer
from survey.simulate.ground import Ground, Material, seen_area, shade_beside_bed, shade_of_map
from survey.simulate.shapes import BedGrid, Solid, rotation
from survey.simulate.sidecars import StagedScene
from survey.simulate.textures import ROCK, ImageTexture, draped_texture, in_texels, light_of_bed, noise, periodic, sand
from survey.simulate.writing import write_survey

_GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))
# Tilt of the convergent views from the plumb line, least and most [rad].
_TILTS = (math.radians(10.0), math.radians(35.0))
# A body, its colour, and the direction of its grain.
Body = tuple[Solid, tuple[float, float, float], np.ndarray | None]

_WOOD, _CLAY = (0.42, 0.29, 0.18), (0.60, 0.33, 0.20)
# Of an amphora: places along its axis and radii there [m].
_AMPHORA = ((-0.5, 0.03), (-0.38, 0.12), (-0.05, 0.21), (0.14, 0.19), (0.27, 0.07), (0.42, 0.06), (0.5, 0.09))
# Handbooks state the index of water in the light of sodium.
_STATED_NM = 589.3
# Duration of the flight where the water level changes during it [s].
FLIGHT_S = 3600.0


@dataclass(frozen=True)
class DrawnScene:
    """A bed, the water over it and a flight; the defaults are the survey of the demo."""

    size_m: tuple[float, float] = key((11.0, 10.0), above=0)  # (east, north): of what is evaluated, about the origin
    depth_m: float = key(2.8, above=0)  # Greatest mean depth; the bed undulates about 0.1 of it
    # 1 leaves rays straight, with the colours of water
    n_water: float = key(1.333, "1.0 to 1.6; fresh water has 1.333", least=1.0, most=1.6)
    level_m: float = 584.2  # Height of the water surface at the origin, in crs
    # slope_east, slope_north [-]: rise of the water surface per metre along the grid axes
    slope_east: float = 0.0
    slope_north: float = 0.0
    num_views: int = key(20, "at least 3: fewer views cannot be reconstructed", least=3)
    nadir_share: float = key(0.6, "0 to 1, which has no tilted views", least=0, most=1)
    image_px: tuple[int, int] = key((480, 360), above=0)  # (width, height)
    focal_px: float = key(840.0, above=0)
    flying_m: float = key(21.0, above=0)  # Height of the cameras over the water
    noise: float = key(1.0, least=0)  # Standard deviation [grey levels]; 0 writes PNG without loss instead of JPEG
    seed: int = key(1, "a whole number from zero on", least=0)
    crs: str = "EPSG:25832+7837"  # Projected, in metres, with heights
    origin: tuple[float, float] = (676120.0, 5311480.0)  # (easting, northing), in crs
    cell_m: float = key(0.025, above=0)  # Spacing of the vertices of the bed, and so of the true mesh
    texel_m: float = key(0.01, above=0)  # Spacing of its texels, which should be finer than any pixel
    # Of the camera, at each photograph in another level direction, at most that of the fastest drones
    speed_m_s: float = key(0.0, least=0, most=30)
    # Of its rolling shutter, from the first to the last row; 0 for a global shutter
    readout_s: float = key(0.0, least=0, most=0.25)
    to_sun: tuple[float, float, float] = Light.to_sun  # Direction toward the sun, local, any length
    # [deg C] of fresh water, or None. Photographs then have an index per channel (`refract.channel_indices`), the truth
    # that of green, and survey.toml that of the sodium line, with its wavelength; `n_water` is not used.
    temperature_c: float | None = None
    # Of the water from the first photograph to the last, an hour later, as in the highest tides; `level_m` is its mean
    rise_m: float = key(0.0, least=-3, most=3)
    shore: bool = False  # A bank that rises out of the water in the north
    objects: bool = True  # A boat, an amphora, rocks
    water: bool = True  # False for a dry bed

    def __post_init__(self):
        require_valid(self, DrawnScene, lambda field: f"{field.name} of a drawn scene")
        if self.flying_m < 2.0 * self.depth_m:
            raise SurveyError(
                f"flying_m is {self.flying_m:g}, expected at least twice the depth of {self.depth_m:g} m: "
                "the bank and its objects must stay under the cameras"
            )

    @classmethod
    def tiny(cls, **changes) -> DrawnScene:
        """A survey for tests, drawn in about a second: 8 views of 160x120, 2.6 x 2.4 m of bed, no noise."""
        small: dict[str, Any] = {
            "size_m": (2.6, 2.4), "depth_m": 1.2, "num_views": 8, "image_px": (160, 120),
            "focal_px": 280.0, "flying_m": 7.0, "noise": 0.0,
        }  # fmt: skip
        return cls(**(small | changes))

    @property
    def unit_m(self) -> float:
        """Scale of objects and of the large shapes of the bed: 1 for an area of 12 m."""
        return min(self.size_m) / 12.0

    def cameras(self) -> list[PinholeCamera]:
        """The flight: strips of views that look down, then convergent views, tilted by 10 to 35 degrees."""
        rng = np.random.default_rng([self.seed, 1])
        nadir = min(max(round(self.nadir_share * self.num_views), 1), self.num_views)
        cameras = []
        for x, y, row in _grid(nadir, self.size_m, self.image_px):
            # With the heading of its strip, and some noise of position and attitude.
            shake = 0.02 * rng.standard_normal(2)
            heading = math.pi * (row % 2) + 0.03 * rng.standard_normal()
            cameras.append(self._camera(x, y, np.array([*shake, -1.0]), heading, rng))
        tilts = np.linspace(*_TILTS, self.num_views - nadir)
        azimuths = _GOLDEN_ANGLE * np.arange(len(tilts))
        cameras += [self.look_in(tilt, azimuth, rng) for tilt, azimuth in zip(tilts, azimuths, strict=True)]
        if self.rise_m != 0.0 and self.water:
            tides = self.rise_m * np.linspace(-0.5, 0.5, self.num_views)
            cameras = [replace(camera, tide=tide) for camera, tide in zip(cameras, tides.tolist(), strict=True)]
        if self.speed_m_s == 0.0 or self.readout_s == 0.0:
            return cameras
        motions = self.velocities() * self.readout_s / (self.image_px[1] - 1)
        return [replace(camera, motion=motion) for camera, motion in zip(cameras, motions, strict=True)]

    def look_in(self, tilt: float, azimuth: float, rng: np.random.Generator) -> PinholeCamera:
        """A camera that looks at a place about the middle, tilted from the plumb line toward an azimuth [rad]."""
        toward = np.array([math.sin(azimuth), math.cos(azimuth)])
        target = rng.uniform(-0.18, 0.18, 2) * self.size_m
        x, y = target - (self.flying_m + 0.7 * self.depth_m) * math.tan(tilt) * toward
        forward = np.array([*(math.sin(tilt) * toward), -math.cos(tilt)])
        return self._camera(x, y, forward, azimuth, rng, 0.05)

    def velocities(self) -> np.ndarray:
        """Velocities of the cameras (views, 3) [m/s], local: level, in any direction."""
        toward = np.random.default_rng([self.seed, 9]).uniform(0.0, 2.0 * math.pi, self.num_views)
        return self.speed_m_s * np.stack([np.sin(toward), np.cos(toward), np.zeros(self.num_views)], axis=-1)

    def _camera(
        self, x: float, y: float, forward: np.ndarray, heading: float, rng: np.random.Generator, shake: float = 0.0
    ) -> PinholeCamera:
        """A camera that looks `forward`; the top of its image points to `heading` [rad], north over east."""
        centre = np.array([x, y, self.flying_m]) + 0.01 * self.flying_m * rng.standard_normal(3)
        heading += shake * rng.standard_normal() if shake else 0.0
        forward = forward / np.linalg.norm(forward)
        right = np.cross(forward, [math.sin(heading), math.cos(heading), 0.0])
        right = right / np.linalg.norm(right)
        axes = np.stack([right, np.cross(forward, right), forward])
        width, height = self.image_px
        return PinholeCamera(centre, axes, self.focal_px, self.focal_px, width / 2, height / 2, width, height)


def _grid(count: int, size_m: tuple[float, float], image_px: tuple[int, int]) -> Iterator[tuple[float, float, int]]:
    """x, y [m] and row of `count` views in strips along x, with equal forward and side overlap."""
    rows = max(round(math.sqrt(count * size_m[1] / size_m[0] * image_px[0] / image_px[1])), 1)
    for row in range(rows):
        columns = count // rows + (row < count % rows)
        y = 0.35 * size_m[1] * (2.0 * row / (rows - 1) - 1.0) if rows > 1 else 0.0
        for column in range(columns):
            yield (0.3 * size_m[0] * (2.0 * column / (columns - 1) - 1.0) if columns > 1 else 0.0), y, row


def build_ground(scene: DrawnScene, cameras: Sequence[PinholeCamera], light: Light) -> Ground:
    """The ground of a scene, over the area that its cameras see."""
    rng = np.random.default_rng([scene.seed, 2])
    west, south, east, north = seen_area(cameras, scene.size_m, -1.5 * scene.depth_m)
    cell, texel = scene.cell_m, scene.texel_m
    shape = (math.ceil((north - south) / cell) + 1, math.ceil((east - west) / cell) + 1)
    x = west + cell * np.arange(shape[1])
    y = (south + cell * np.arange(shape[0]))[:, None]
    heights = _heights(scene, x, y, rng)
    stones = _add_stones(heights, rng, scene)
    bed = BedGrid(heights, west, south, cell)
    bodies = _bodies(scene, bed, rng) if scene.objects else []
    solids = tuple(solid for solid, _, _ in bodies)
    stone = in_texels(stones, cell, texel)
    texture = draped_texture(sand(stone.shape, texel, rng, stone), west, south, texel)
    materials = [Material(texture, shade_of_map(bed, light_of_bed(bed, solids, light)))]
    tile = np.exp(sum(0.15 * periodic(rng, size) for size in (2, 4, 8, 32))).astype(np.float32)
    for solid, colour, grain in bodies:
        # The tile of brightness lies along each plane of a body, stretched along its grain if any.
        along, stretch = (np.array([0.8, 0.0, 0.6]), 1.0) if grain is None else (grain, 0.15)
        across = np.cross(solid.normals, along) + 1e-12
        across = across / np.linalg.norm(across, axis=1, keepdims=True)
        axes = np.stack([across, stretch * np.cross(across, solid.normals)], axis=1) / scene.texel_m
        # Planes show different parts of the tile.
        shift = np.arange(len(axes))[:, None] * (7.0, 31.0) - axes @ solid.centre
        texels = np.concatenate([axes, shift[..., None]], axis=-1)
        image = tile[..., None] * np.array(colour, dtype=np.float32)
        texture = ImageTexture(image, texels, np.arange(len(axes)), repeats=True)
        materials.append(Material(texture, shade_beside_bed(solid, bed, light)))
    return Ground(bed, solids, tuple(materials))


def _heights(scene: DrawnScene, x: np.ndarray, y: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Heights of the bed (ny, nx) [m]: a large shape, ripples in places, and roughness down to 5 cm."""
    shape = (y.size, x.size)

    def wave(spacing_m: float) -> np.ndarray:
        return noise(rng, shape, max(spacing_m / scene.cell_m, 1.0))

    unit, depth = scene.unit_m, scene.depth_m
    height = -depth * (1.0 + 0.07 * wave(3.5 * unit) + 0.02 * wave(1.2 * unit))
    if scene.shore:
        share = np.clip((y / scene.size_m[1] + 0.45) / 0.95, 0.0, 1.0)
        height = height * (1.0 - share) + 0.32 * depth * share
    angle = rng.uniform(0.0, math.pi)
    phase = (x * math.cos(angle) + y * math.sin(angle)) * (2.0 * math.pi / 0.32) + 1.5 * wave(1.0)
    height += 0.012 * np.sin(phase) * np.clip(wave(1.5), 0.0, 1.0)
    for spacing in (0.4, 0.2, 0.1, 0.05):
        height += 0.05 * spacing * wave(spacing)
    return height.astype(np.float64)


def _add_stones(heights: np.ndarray, rng: np.random.Generator, scene: DrawnScene) -> np.ndarray:
    """Add half-buried stones of 8 to 26 cm to `heights`; their brightness (ny, nx), 0 elsewhere."""
    ny, nx = heights.shape
    stones = np.zeros((ny, nx), dtype=np.float32)
    count = int(1.5 * ny * nx * scene.cell_m**2)
    centres = rng.uniform((0.0, 0.0), (nx - 1.0, ny - 1.0), (count, 2))
    radii = rng.uniform(0.04, 0.04 + 0.09 * min(1.0, 2.0 * scene.unit_m), count) / scene.cell_m
    brightness, flatness = rng.uniform(0.6, 1.5, count), rng.uniform(0.4, 0.8, count)
    for (u, v), radius, bright, flat in zip(centres, radii, brightness, flatness, strict=True):
        i0, i1 = max(int(u - radius), 0), min(int(u + radius) + 2, nx)
        j0, j1 = max(int(v - radius), 0), min(int(v + radius) + 2, ny)
        distance2 = ((np.arange(i0, i1) - u) ** 2 + ((np.arange(j0, j1) - v) ** 2)[:, None]) / radius**2
        cap = flat * radius * scene.cell_m * np.sqrt(np.maximum(1.0 - distance2, 0.0))
        heights[j0:j1, i0:i1] += cap
        stones[j0:j1, i0:i1] = np.where(distance2 < 1.0, bright, stones[j0:j1, i0:i1])
    return stones


def _bodies(scene: DrawnScene, bed: BedGrid, rng: np.random.Generator) -> list[Body]:
    """An upturned boat, a crate, a log, an amphora and rocks, spread over the area."""
    unit = scene.unit_m

    def place(points: np.ndarray, x: float, y: float, turn: np.ndarray, lift: float) -> np.ndarray:
        x, y = x * scene.size_m[0], y * scene.size_m[1]
        return unit * points @ turn.T + (x, y, float(bed.height(x, y)) + unit * lift)

    turn = rotation(0.7, 0.02, 0.12)
    bodies: list[Body] = [(Solid.around(place(_boat(), -0.17, -0.10, turn, 0.02)), _WOOD, turn[:, 0])]
    turn = rotation(0.35, 0.1, 0.15)
    box = np.stack(np.meshgrid([-0.4, 0.4], [-0.3, 0.3], [-0.2, 0.3]), axis=-1).reshape(-1, 3)
    bodies.append((Solid.around(place(box, 0.22, 0.10, turn, 0.1)), _WOOD, turn[:, 0]))
    turn = rotation(2.3, 0.03)
    bodies.append((Solid.around(place(_frustum(-1.3, 0.14, 1.3, 0.11), 0.10, -0.28, turn, 0.09)), _WOOD, turn[:, 0]))
    turn = rotation(-0.6, -0.12)
    for (x0, r0), (x1, r1) in itertools.pairwise(_AMPHORA):
        bodies.append((Solid.around(place(_frustum(x0, r0, x1, r1), 0.05, 0.27, turn, 0.15)), _CLAY, None))
    for x, y in ((-0.33, 0.25), (-0.24, 0.34), (0.34, -0.12), (0.30, 0.34), (-0.35, -0.36), (0.02, 0.04)):
        ball = rng.standard_normal((26, 3))
        ball = ball / np.linalg.norm(ball, axis=1, keepdims=True) * rng.uniform(0.22, 0.5) * np.array([1.0, 0.8, 0.6])
        red, green, blue = rng.uniform(0.8, 1.3) * np.array(ROCK)
        turn = rotation(rng.uniform(0.0, 6.0))
        bodies.append((Solid.around(place(ball, x, y, turn, 0.08)), (red, green, blue), None))
    return bodies


def _boat() -> np.ndarray:
    """Points of an upturned hull, 3.8 m long along x, keel up."""
    s = np.linspace(-1.0, 1.0, 13)
    wide, zero = 0.66 * (1.0 - np.abs(s) ** 2.4), 0.0 * s
    gunwale = [np.stack([1.9 * s, side * wide, zero], axis=-1) for side in (-1.0, 1.0)]
    chine = [np.stack([1.8 * s, side * 0.75 * wide, zero + 0.34], axis=-1) for side in (-1.0, 1.0)]
    keel = np.stack([1.7 * s, zero, 0.52 - 0.12 * s**2], axis=-1)
    return np.concatenate([*gunwale, *chine, keel])


def _frustum(x0: float, radius0: float, x1: float, radius1: float) -> np.ndarray:
    angle = 2.0 * math.pi * np.arange(14) / 14
    circle = np.stack([0.0 * angle, np.cos(angle), np.sin(angle)], axis=-1)
    return np.concatenate([radius0 * circle + (x0, 0.0, 0.0), radius1 * circle + (x1, 0.0, 0.0)])


def stage_drawing(scene: DrawnScene) -> StagedScene:
    """Build the ground of a drawn scene; the origin of its frame lies on the water surface, in the middle."""
    frame = LocalFrame(parse_crs(scene.crs), (*scene.origin, scene.level_m))
    level, water, indices = None, None, None
    if scene.water:
        stated = scene.n_water
        if scene.temperature_c is not None:
            red, green, blue = (float(n) for n in channel_indices(scene.temperature_c, 0.0))
            indices, stated = (red, green, blue), round(float(water_index(_STATED_NM, scene.temperature_c, 0.0)), 6)
        level = WaterConfig(
            level_m=scene.level_m,
            level_at=scene.origin,
            slope_east=scene.slope_east,
            slope_north=scene.slope_north,
            refractive_index=stated,
        )
        water = water_plane(frame, level)
        water = water if indices is None else replace(water, n_water=indices[1])
    cameras = tuple(scene.cameras())
    ground = build_ground(scene, cameras, Light(scene.to_sun))
    width, height = scene.image_px
    (e, n), (wide, deep) = scene.origin, scene.size_m
    return StagedScene(
        name="drawn",
        crs=scene.crs,
        frame=frame,
        cameras=cameras,
        lens=Lens("PINHOLE", (scene.focal_px, scene.focal_px, width / 2, height / 2), width, height),
        level=level,
        renderer=DirectRenderer(ground, water, WaterOptics(), indices),
        sensor=Sensor(noise=scene.noise),
        bounds=(e - 0.5 * wide, n - 0.5 * deep, e + 0.5 * wide, n + 0.5 * deep),
        seed=scene.seed,
        velocities=scene.velocities() if scene.speed_m_s > 0.0 else None,
        readout_s=scene.readout_s,
        index_wavelength_nm=None if indices is None else _STATED_NM,
        duration_s=FLIGHT_S if scene.rise_m != 0.0 and scene.water else 0.0,
    )


def draw_survey(folder: Path, scene: DrawnScene, *, again: bool = False, progress: Progress | None = None) -> None:
    """Draw a survey into a folder; see `survey.simulate.writing.write_survey`."""
    write_survey(folder, dataclasses.asdict(scene), lambda: stage_drawing(scene), again=again, progress=progress)


def main(arguments: list[str] | None = None) -> None:
    """``python -m survey.simulate.drawn``; what cannot be used, or written, ends it with exit code 2."""
    parser = argparse.ArgumentParser(
        prog="python -m survey.simulate.drawn", description="Draw a small survey into a folder, unless it is there."
    )
    parser.add_argument("folder", type=Path, help="survey folder to write, with the ground truth in truth/")
    parser.add_argument("--tiny", action="store_true", help="8 small views without noise, in about a second")
    parser.add_argument("settings", nargs="*", metavar="KEY=VALUE", help="of DrawnScene, e.g. shore=true depth_m=2.0")
    given = parser.parse_intermixed_args(arguments)
    text = "\n".join(given.settings)
    try:
        scene = parse_toml(text, DrawnScene)
        if given.tiny:
            scene = DrawnScene.tiny(**{name: getattr(scene, name) for name in tomllib.loads(text)})
        with Progress() as progress:
            draw_survey(given.folder, scene, progress=progress)
    except (GeoError, SurveyError, OSError) as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
