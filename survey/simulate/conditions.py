"""Conditions of a scene: sky and sun, the water, its surface and colour, and the sensor of the camera.

The radiance of the sky depends on elevation alone, and the sun has a size. The colour of the water results from
absorption, and from scattering into the path. The sensor turns radiance into grey levels, through a lens.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fields.image_store import GAMMA
from geo import read_reference, require_same_crs
from geo.crs import height_unit_m
from geo.frames import LocalFrame
from geo.shapes import in_height_unit, vertices_of
from refract import FlatWater, PinholeCamera
from refract.curved import BicubicWater, WavyWater
from refract.lens import Lens, normalised
from survey.errors import ConfigError, SurveyError
from survey.simulate.scene_file import SensorSettings, WaveSettings

# Radiance of an overcast sky at the horizon, as a share of that at the zenith (CIE 1955, Moon and Spencer).
_HORIZON_SHARE = 1.0 / 3.0
# Linear radiance (N, 3) along rays from origins (N, 3) in directions (N, 3), with a seed for random sampling.
RadianceFunction = Callable[[np.ndarray, np.ndarray, int], np.ndarray]

# Rays at a time.
_RAYS = 1 << 21
# Steps of a sequence that fills the cube evenly (Roberts 2018, the generalised golden ratio of three dimensions).
_STEPS = 1.0 / 1.2207440846057596 ** np.arange(1, 4)


@dataclass(frozen=True)
class Light:
    """Sky and sun, scaled so that a white matt surface lies at radiance 1 on level ground in air."""

    # (3,): direction toward the middle of the sun, local, any length
    to_sun: tuple[float, float, float] = (0.45, 0.30, 0.84)
    sun_share: float = 0.4  # [-]: share of the light on level ground that comes from the sun; 0 without one
    # [rad]: half the angle under which the sun is seen; 0.0046 in nature, 0 for a point. All of the disc is above the
    # horizon.
    sun_radius: float = 0.0046
    overcast: bool = False  # A sky three times as bright at the zenith as at the horizon, instead of a uniform one

    def __post_init__(self):
        if not 0.0 < np.linalg.norm(self.to_sun) < np.inf:
            raise ConfigError(f"to_sun is {list(self.to_sun)}, expected a direction toward the sun, of any length")
        # With the sun in the zenith and a disc of 180 degrees both are a right angle, up to rounding.
        if not 0.0 <= self.sun_radius <= self.elevation + 1e-9:
            raise ConfigError(
                f"the sun is {math.degrees(2.0 * self.sun_radius):.4g} deg across and its middle "
                f"{math.degrees(self.elevation):.4g} deg above the horizon; light.sun_diameter_deg is expected at 0 "
                "to twice the elevation"
            )

    @property
    def sun(self) -> np.ndarray:
        """Unit direction (3,) toward the sun, local."""
        direction = np.array(self.to_sun)
        return direction / np.linalg.norm(direction)

    @property
    def elevation(self) -> float:
        """Elevation of the middle of the sun [rad]."""
        return math.asin(min(float(self.sun[2]), 1.0))

    def irradiance(self, normal: np.ndarray) -> np.ndarray:
        """Light (...) that a surface of unit normals (..., 3) gets where nothing shades it; 1 if level."""
        sky = 0.5 + 0.5 * normal[..., 2]
        # A uniform sky suffices: the mode that uses this is about geometry.
        sun = np.maximum(normal @ self.sun, 0.0) / self.sun[2]
        return (1.0 - self.sun_share) * sky + self.sun_share * sun

    def sky(self, up):
        """Radiance of the sky at directions whose vertical part is ``up`` (...), numpy or Dr.Jit; 0 below the horizon.

        The overcast sky is ``1/3 + 2/3 up`` of the zenith; its integral with the cosine is 7/9 pi of the zenith, so the
        zenith has 9/7.
        """
        if self.overcast:
            zenith = 1.0 / (_HORIZON_SHARE + 2.0 / 3.0 * (1.0 - _HORIZON_SHARE))
            shape = zenith * (_HORIZON_SHARE + (1.0 - _HORIZON_SHARE) * up)
        else:
            shape = 1.0 + 0.0 * up
        return (1.0 - self.sun_share) * shape

    @property
    def sun_irradiance(self) -> float:
        """Irradiance by the sun on a surface that faces it, if all of the disc is above it."""
        return math.pi * self.sun_share / float(self.sun[2])


def with_waves(plane: FlatWater, waves: Sequence[WaveSettings]) -> WavyWater:
    """A plane with trains of waves on it."""
    vectors, phases = [], []
    for wave in waves:
        toward, number = math.radians(wave.toward_deg), 2.0 * math.pi / wave.length_m
        vectors.append((number * math.sin(toward), number * math.cos(toward)))
        phases.append(math.radians(wave.phase_deg))
    return WavyWater(
        plane.point,
        [wave.amplitude_m for wave in waves],
        vectors,
        phases,
        n_water=plane.n_water,
        slope_x=plane.slope_x,
        slope_y=plane.slope_y,
    )


def measured_surface(path: Path, frame: LocalFrame, n_water: float) -> BicubicWater:
    """The surface interpolated between measured points in crs, from a raster, cloud or mesh."""
    shape = read_reference(path)
    require_same_crs(frame.crs, shape.crs, "the scene", str(path))
    shape = in_height_unit(shape, height_unit_m(frame.crs))
    points = frame.local_from_crs(vertices_of(shape))
    try:
        return BicubicWater.from_points(points[:, :2], points[:, 2], n_water=n_water)
    except ValueError as error:
        raise SurveyError(f"{path} gives no water surface: {error}") from error


@dataclass(frozen=True)
class WaterOptics:
    """Optical properties of the water."""

    # (3,) [1/m]: of red, green and blue; the default is a lake with a little yellow substance
    absorption: tuple[float, float, float] = (0.17, 0.042, 0.055)
    scattering: float = 0.2  # [1/m]: of all colours alike
    # [-]: mean cosine of scattering; natural water scatters forward (0.92: Mobley 1994, for Petzold's measurements)
    asymmetry: float = 0.92
    # (3,): radiance of infinitely deep water, for the mode without light transport
    veil: tuple[float, float, float] = (0.03, 0.17, 0.21)
    veiling: float = 0.06  # [1/m]: rate at which the veil builds up, in the same mode
    sky: float = 0.55  # [-]: radiance that the surface reflects, in the same mode

    @property
    def delta_eddington(self) -> tuple[float, float]:
        """Scattering [1/m] and asymmetry by delta-Eddington scaling (Joseph, Wiscombe and Weinman 1976).

        The share ``g**2`` in the forward peak counts as not scattered, the rest has the asymmetry ``g / (1 + g)``. Lost
        is the halo of a few degrees around bright objects.
        """
        g = self.asymmetry
        return self.scattering * (1.0 - g * g), g / (1.0 + g)

    def seen_through(self, dry: np.ndarray, depth: np.ndarray, in_water: np.ndarray) -> np.ndarray:
        """Radiance (N, 3) of ground of radiance ``dry`` (N, 3) seen through water.

        The light goes down by the depth (N,) [m] of the ground, and up to the surface by `in_water` (N,) [m].
        """
        bed = dry * np.exp(-np.array(self.absorption) * (depth + in_water)[:, None])
        return bed + np.array(self.veil) * (1.0 - np.exp(-self.veiling * in_water))[:, None]


@dataclass(frozen=True)
class Sensor(SensorSettings):
    """Sensor of a camera: from radiance to grey levels; its blur is toward the top of the image."""

    noise: float = 0.0
    samples: int = 4  # Rays per pixel
    is_jittered: bool = False  # Whether rays are jittered in the pixel; else on a regular square grid

    def photograph(
        self, radiance_of: RadianceFunction, camera: PinholeCamera, lens: Lens, seed: tuple[int, int]
    ) -> np.ndarray:
        """The image (height, width, 3) uint8 of a camera; `seed` is that of the scene and the number of the image."""
        scene, index = seed
        walk = np.random.default_rng([scene, 7]).standard_normal(index + 1).sum()
        exposure = self.exposure * float(np.exp(self.exposure_drift * walk))
        linear = exposure * self.light(radiance_of, camera, lens, seed)
        if self.photons_at_white > 0.0:
            rng = np.random.default_rng([scene, 8, index])
            linear = rng.poisson(linear * self.photons_at_white) / self.photons_at_white
        grey = 255.0 * np.clip(linear, 0.0, 1.0) ** (1.0 / GAMMA)
        if self.noise > 0.0:
            grey += self.noise * np.random.default_rng([scene, 3, index]).standard_normal(grey.shape)
        return np.clip(np.round(grey), 0.0, 255.0).astype(np.uint8)

    def light(
        self, radiance_of: RadianceFunction, camera: PinholeCamera, lens: Lens, seed: tuple[int, int]
    ) -> np.ndarray:
        """Mean radiance (height, width, 3) of the pixels of a camera."""
        # Renderers that sample at random work in float32: 1e-4 px.
        dtype = np.float32 if self.is_jittered else np.float64
        middle, across, down = (part.astype(dtype) for part in _rays_of(lens, camera))
        total = np.zeros((camera.height * camera.width, 3))
        # Toward the top of the image, as far as that is level.
        forward = -camera.cam_from_local[1] * (1.0, 1.0, 0.0)
        forward *= self.blur_m / (np.linalg.norm(forward) or 1.0)
        rows = np.repeat(np.arange(camera.height) + 0.5, camera.width)[:, None]
        turn = np.random.default_rng([seed[0], 6, seed[1]]).random((len(total), 3), dtype=np.float32)
        for number, (part, offsets) in enumerate(self._samples(turn)):
            u, v, time = np.moveaxis(offsets.astype(dtype, copy=False), -1, 0)[..., None]
            # The lens is affine within a pixel, to 1e-6 of it.
            rays = middle[part, None] + u * across[part, None] + v * down[part, None]
            rays /= np.sqrt(np.einsum("pri,pri->pr", rays, rays))[..., None]
            origin = camera.centre if self.blur_m == 0.0 else (camera.centre + time * forward).reshape(-1, 3)
            if camera.motion is not None:
                late = rows[part, None] + v - camera.cy
                origin = origin + np.broadcast_to(late * camera.motion, rays.shape).reshape(-1, 3)
            own_seed = int(np.random.default_rng([*seed, number]).integers(1 << 31))
            radiance = radiance_of(np.broadcast_to(origin, (rays.size // 3, 3)), rays.reshape(-1, 3), own_seed)
            total[part] += radiance.reshape(rays.shape).sum(axis=1)
        return (total / self.samples).reshape(camera.height, camera.width, 3)

    def _samples(self, turn: np.ndarray) -> Iterator[tuple[slice, np.ndarray]]:
        """Parts of the flattened image, with offsets (pixels, rays, 3) from the pixel's middle [px] and in time.

        Time runs from -0.5 to 0.5 while the shutter is open. Random samples are one low-discrepancy sequence, shifted
        for each pixel by ``turn`` (pixels, 3).
        """
        if self.is_jittered:
            table = (np.arange(1, self.samples + 1)[:, None] * _STEPS % 1.0).astype(turn.dtype)
        else:
            side = round(self.samples**0.5)
            at = (np.arange(side) + 0.5) / side - 0.5
            time = (np.arange(self.samples) + 0.5) / self.samples - 0.5
            table = np.stack([*(c.ravel() for c in np.meshgrid(at, at)), time], axis=-1)
        at_once = min(self.samples, max(_RAYS // len(turn), 1))
        pixels = max(_RAYS // at_once, 1)
        for first in range(0, self.samples, at_once):
            rows = table[first : first + at_once]
            for start in range(0, len(turn), pixels):
                part = slice(start, min(start + pixels, len(turn)))
                if self.is_jittered:
                    sums = turn[part, None] + rows
                    yield part, np.where(sums >= 1.0, sums - 1.5, sums - 0.5)
                else:
                    yield part, np.broadcast_to(rows, (part.stop - part.start, *rows.shape))


def _rays_of(lens: Lens, camera: PinholeCamera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Viewing rays of pixel centres (pixels, 3), local, and their derivatives by column and row."""
    plane, change = normalised(lens)
    middle = np.concatenate([plane, np.ones((len(plane), 1))], axis=-1) @ camera.cam_from_local
    return middle, *(change[..., k] @ camera.cam_from_local[:2] for k in (0, 1))
