"""From random settings to photographs: ground, flight, moving waves, lens and sensor.

Every ray through the middle of a pixel is refracted at the waves and followed to the bed exactly; between these rays
the places they meet are interpolated, and the texture is averaged over four of them per pixel.
"""

import dataclasses
import math
from functools import cache

import cv2
import numpy as np
from field_settings import FieldSettings

from fields.image_store import GAMMA
from geo.crs import parse_crs
from geo.frames import LocalFrame
from refract import FlatWater, PinholeCamera
from refract.curved import WavyWater
from refract.lens import Lens, normalised
from refract.snell import fresnel_coefficients
from survey.folder.local_frame import water_plane
from survey.settings.config import WaterConfig
from survey.simulate.conditions import Light, WaterOptics
from survey.simulate.direct import DirectRenderer, depth_below
from survey.simulate.ground import BED, Ground, Material, seen_area, shade_of_map
from survey.simulate.shapes import BedGrid
from survey.simulate.textures import draped_texture, in_texels, light_of_bed, noise, sand

# Between vertices of the bed [m].
_CELL_M = 0.03
_GRAVITY = 9.81
# Of the length and width of the area that is flown over.
EVALUATED = 0.8
# Rays at a time, so that they stay in the cache.
_RAYS = 1 << 14


@dataclasses.dataclass(frozen=True)
class FieldScene:
    """A scene ready to be photographed; its origin lies on the water, in the middle.

    Attributes
    ----------
    settings : FieldSettings
    frame : LocalFrame
    cameras : tuple of PinholeCamera
        Free of distortion, local.
    lens : Lens
    waves : WavyWater
        Moving.
    times : (cameras,) [s]
        Of the photographs.
    still : DirectRenderer
        The same under water without waves, for the truth.
    flown, bounds : (e0, n0, e1, n1), in crs
        What the flight covers, and the inner part of it that many cameras see, which is evaluated.
    """

    settings: FieldSettings
    frame: LocalFrame
    cameras: tuple[PinholeCamera, ...]
    lens: Lens
    waves: WavyWater
    times: np.ndarray
    still: DirectRenderer
    flown: tuple[float, float, float, float]
    bounds: tuple[float, float, float, float]

    @property
    def names(self) -> list[str]:
        """File names of the photographs."""
        return [f"{k:04d}.jpg" for k in range(len(self.cameras))]

    def photograph(self, index: int) -> np.ndarray:
        """Image (height, width, 3) uint8 of one camera."""
        settings = self.settings
        rng = np.random.default_rng([settings.seed, 23, index])
        water = self.waves.at(float(self.times[index])) if settings.wave_m > 0.0 else self.still.water
        renderer = dataclasses.replace(self.still, water=water)
        linear = _light(renderer, self.cameras[index], self.lens) * math.exp(settings.exposure_std * rng.normal())
        x, y = (np.linspace(-1.0, 1.0, count) for count in (self.lens.width, self.lens.height))
        linear *= (1.0 - settings.vignetting * 0.5 * (x**2 + y[:, None] ** 2))[..., None]
        grey = 255.0 * np.clip(linear, 0.0, 1.0) ** (1.0 / GAMMA)
        grey += settings.noise * rng.standard_normal(grey.shape, dtype=np.float32)
        return np.clip(np.round(grey), 0.0, 255.0).astype(np.uint8)


def stage(settings: FieldSettings) -> FieldScene:
    """Build the scene of random settings."""
    frame = LocalFrame(parse_crs(settings.crs), (*settings.origin, settings.level_m))
    level = WaterConfig(
        level_m=settings.level_m,
        level_at=settings.origin,
        slope_east=settings.slope_east,
        slope_north=settings.slope_north,
        refractive_index=settings.index,
    )
    plane, lens = water_plane(frame, level), settings.lens
    cameras = tuple(_fly(settings, lens))
    rng = np.random.default_rng([settings.seed, 22])
    usual = WaterOptics()
    colour = WaterOptics(
        absorption=tuple(settings.murk * a for a in usual.absorption), veiling=settings.murk * usual.veiling
    )
    return FieldScene(
        settings=settings,
        frame=frame,
        cameras=cameras,
        lens=lens,
        waves=_waves(settings, plane, rng),
        times=np.cumsum(rng.uniform(1.8, 3.0, len(cameras))),
        still=DirectRenderer(_ground(settings, cameras), plane, colour),
        flown=settings.bounds(1.0),
        bounds=settings.bounds(EVALUATED),
    )


def _light(renderer: DirectRenderer, camera: PinholeCamera, lens: Lens) -> np.ndarray:
    """Linear light (height, width, 3) of the pixels of a camera."""
    direction = _rays_in_camera(lens) @ camera.cam_from_local
    parts = []
    for start in range(0, len(direction), _RAYS):
        rays = direction[start : start + _RAYS]
        hits = renderer.trace_rays(np.broadcast_to(camera.centre, rays.shape), rays)
        parts.append(np.column_stack([hits.points, hits.in_water, hits.incidence]))
    shape = (lens.height, lens.width)
    met = np.concatenate(parts).reshape(*shape, 5)
    total, wet = np.zeros((*shape, 3)), met[..., 3:4] > 0.0
    cosine, met = met[..., 4:], np.ascontiguousarray(met[..., :4])
    mirrored = fresnel_coefficients(cosine, n_from=1.0, n_to=renderer.water.n_water).reflectance
    for across in (-0.25, 0.25):
        for down in (-0.25, 0.25):
            shift = np.array([[1.0, 0.0, across], [0.0, 1.0, down]])
            flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            at = cv2.warpAffine(met, shift, shape[::-1], flags=flags, borderMode=cv2.BORDER_REPLICATE).reshape(-1, 4)
            bed = np.full(len(at), BED)
            dry = renderer.ground.colour(at[:, :3], bed, np.zeros(len(at), dtype=int))
            depth = np.maximum(depth_below(renderer.water, at[:, :3]), 0.0)
            seen = renderer.colour.seen_through(dry, depth, at[:, 3]).reshape(*shape, 3)
            total += np.where(wet, (1.0 - mirrored) * seen + mirrored * renderer.colour.sky, dry.reshape(*shape, 3))
    return total / 4.0


@cache
def _rays_in_camera(lens: Lens) -> np.ndarray:
    """Unit directions (pixels, 3) in cam of the middles of pixels."""
    plane, _ = normalised(lens)
    rays = np.concatenate([plane, np.ones((len(plane), 1))], axis=-1)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def _waves(settings: FieldSettings, plane: FlatWater, rng: np.random.Generator) -> WavyWater:
    """Trains of equal steepness that run roughly one way, as fast as on deep water."""
    lengths = rng.uniform((0.7, 1.5, 3.0, 1.0), (1.5, 3.0, 6.0, 6.0))
    amplitudes = lengths * rng.uniform(0.7, 1.3, 4)
    amplitudes *= settings.wave_m / np.linalg.norm(amplitudes)
    toward = rng.uniform(0.0, 2.0 * math.pi) + rng.normal(0.0, 0.5, 4)
    number = 2.0 * math.pi / lengths
    vectors = np.stack([number * np.sin(toward), number * np.cos(toward)], axis=-1)
    return WavyWater(
        plane.point,
        amplitudes.tolist(),
        vectors.tolist(),
        rng.uniform(0.0, 2.0 * math.pi, 4).tolist(),
        frequencies=np.sqrt(_GRAVITY * number).tolist(),
        n_water=plane.n_water,
        slope_x=plane.slope_x,
        slope_y=plane.slope_y,
    )


def _fly(settings: FieldSettings, lens: Lens) -> list[PinholeCamera]:
    """Strips that look down, then views from all around that are tilted by 12 to 38 degrees."""
    rng = np.random.default_rng([settings.seed, 21])
    heading, height = rng.uniform(0.0, 2.0 * math.pi), settings.height_m
    half = 0.5 * np.array(settings.size_m) * rng.uniform(0.7, 0.95)
    rows = max(round(math.sqrt(settings.num_nadir * half[1] / half[0] * lens.width / lens.height)), 2)
    per_row = [settings.num_nadir // rows + (r < settings.num_nadir % rows) for r in range(rows)]
    poses = []
    for row, count in enumerate(per_row):
        y = half[1] * (2.0 * row / (rows - 1) - 1.0)
        for x in half[0] * np.linspace(-1.0, 1.0, count) * (1 - 2 * (row % 2)):
            poses.append((x, y, 0.0, math.pi * (row % 2)))
    azimuth = rng.uniform(0.0, 2.0 * math.pi)
    for view in range(settings.num_oblique):
        tilt, toward = rng.uniform(0.2, 0.66), azimuth + 2.4 * view
        target = rng.uniform(-0.25, 0.25, 2) * settings.size_m
        reach = (height + 0.7 * settings.depth_m) * math.tan(tilt)
        x, y = target - reach * np.array([math.sin(toward), math.cos(toward)])
        poses.append((x, y, tilt, toward))
    turn = np.array([[math.cos(heading), math.sin(heading)], [-math.sin(heading), math.cos(heading)]])
    return [_camera(turn @ pose[:2], pose[2], pose[3] + heading, height, lens, rng) for pose in poses]


def _camera(place: np.ndarray, tilt: float, heading: float, height: float, lens: Lens, rng: np.random.Generator):
    """A camera tilted toward a heading, to which the top of its image points, with what wind does to it."""
    shake = rng.normal(0.0, 0.015, 3)
    heading, tilt = heading + 2.0 * shake[0], tilt + shake[1]
    ahead = np.array([math.sin(heading), math.cos(heading)])
    forward = np.array([*(math.sin(tilt) * ahead), -math.cos(tilt)])
    top = np.array([*(math.cos(tilt) * ahead), math.sin(tilt)])
    right = np.cross(forward, top)
    c, s = math.cos(shake[2]), math.sin(shake[2])
    centre = np.array([*place, height]) + rng.normal(0.0, (0.2, 0.2, 0.012 * height))
    return lens.pinhole(centre, np.stack([c * right - s * top, -c * top - s * right, forward]))


def _ground(settings: FieldSettings, cameras: tuple[PinholeCamera, ...]) -> Ground:
    """The bed, as wide as cameras see, and its paint."""
    rng = np.random.default_rng([settings.seed, 2])
    # The undistorted corners do not reach as far as a lens of positive distortion sees.
    west, south, east, north = seen_area(cameras, settings.size_m, -1.6 * settings.depth_m)
    margin = 0.06 * max(east - west, north - south)
    west, south, east, north = west - margin, south - margin, east + margin, north + margin
    shape = (math.ceil((north - south) / _CELL_M) + 1, math.ceil((east - west) / _CELL_M) + 1)
    x, y = west + _CELL_M * np.arange(shape[1]), (south + _CELL_M * np.arange(shape[0]))[:, None]
    patches = noise(rng, shape, rng.uniform(1.5, 4.0) / _CELL_M)
    bare = 1.0 / (1.0 + np.exp(-8.0 * (patches - np.quantile(patches, 1.0 - settings.bare_share))))
    heights = _heights(settings, x, y, bare, rng)
    stones = _add_stones(heights, bare, rng)
    bed = BedGrid(heights.astype(np.float64), west, south, _CELL_M)
    texel = float(np.clip(0.55 * settings.gsd_m, 0.009, 0.018))
    painted = sand(in_texels(stones, _CELL_M, texel).shape, texel, rng, in_texels(stones, _CELL_M, texel))
    mean = painted.mean(axis=(0, 1))
    strength = settings.contrast * (1.0 - (1.0 - settings.bare_contrast) * in_texels(bare, _CELL_M, texel))
    painted = np.maximum(mean + strength[..., None] * (painted - mean), 0.02).astype(np.float32)
    lit = light_of_bed(bed, (), Light())
    material = Material(draped_texture(painted, west, south, texel), shade_of_map(bed, lit))
    return Ground(bed, (), (material,))


def _heights(settings: FieldSettings, x: np.ndarray, y: np.ndarray, bare: np.ndarray, rng) -> np.ndarray:
    """Heights of the bed (ny, nx) [m], local: a slope, or a bank, with undulation and roughness."""
    shape, depth = (y.size, x.size), settings.depth_m

    def wave(spacing_m: float) -> np.ndarray:
        return noise(rng, shape, max(spacing_m / _CELL_M, 1.0))

    toward = math.radians(settings.bank_to_deg)
    half = 0.5 * (abs(math.sin(toward)) * settings.size_m[0] + abs(math.cos(toward)) * settings.size_m[1])
    along = np.clip((x * math.sin(toward) + y * math.cos(toward)) / half, -1.6, 1.6)
    if settings.dry_share > 0.0:
        # The share of a square beyond a line across it.
        shore = 1.0 - 2.0 * settings.dry_share
        rise = depth / (shore + 1.0)
        height = rise * (along - shore)
        height = np.where(
            height < 0.0, np.maximum(height, -1.15 * depth), np.minimum(0.6 * height, 0.35 * height + 0.3)
        )
    else:
        shallow = rng.uniform(0.35, 0.9)
        height = -depth * (1.0 + (shallow - 1.0) * 0.5 * (along + 1.0))
    scale = min(settings.size_m) / 12.0
    wavy = settings.relief * wave(3.0 * scale) + 0.3 * settings.relief * wave(1.1 * scale)
    height = height + depth * wavy * np.clip(-height / depth + 0.15, 0.15, 1.0)
    angle = rng.uniform(0.0, math.pi)
    phase = (x * math.cos(angle) + y * math.sin(angle)) * (2.0 * math.pi / 0.36) + 1.5 * wave(1.0)
    height = height + 0.012 * np.sin(phase) * np.clip(wave(1.5), 0.0, 1.0)
    for spacing in (0.4, 0.2, 0.1):
        height += 0.05 * spacing * wave(spacing) * (1.0 - 0.85 * bare)
    if settings.dry_share == 0.0:
        height = -np.logaddexp(-height / 0.05, 0.2 / 0.05) * 0.05
    return height


def _add_stones(heights: np.ndarray, bare: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Add half-buried stones of 10 to 50 cm to `heights`; their brightness (ny, nx), 0 elsewhere."""
    ny, nx = heights.shape
    stones = np.zeros((ny, nx), dtype=np.float32)
    count = int(rng.uniform(0.3, 1.5) * ny * nx * _CELL_M**2)
    centres = rng.uniform((0.0, 0.0), (nx - 1.0, ny - 1.0), (count, 2))
    radii = 0.05 + 0.2 * rng.uniform(0.0, 1.0, count) ** 3
    looks = np.stack([rng.uniform(0.6, 1.5, count), rng.uniform(0.4, 0.8, count)], axis=-1)
    for (u, v), radius_m, (bright, flatness) in zip(centres, radii, looks, strict=True):
        if bare[int(v), int(u)] > 0.5:
            continue
        radius = radius_m / _CELL_M
        i0, i1 = max(int(u - radius), 0), min(int(u + radius) + 2, nx)
        j0, j1 = max(int(v - radius), 0), min(int(v + radius) + 2, ny)
        apart = ((np.arange(i0, i1) - u) ** 2 + ((np.arange(j0, j1) - v) ** 2)[:, None]) / radius**2
        heights[j0:j1, i0:i1] += flatness * radius_m * np.sqrt(np.maximum(1.0 - apart, 0.0))
        stones[j0:j1, i0:i1] = np.where(apart < 1.0, bright, stones[j0:j1, i0:i1])
    return stones
