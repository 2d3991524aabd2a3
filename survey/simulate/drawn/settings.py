"""Settings of a drawn survey: scene, water and flight."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from refract import PinholeCamera
from survey.errors import SurveyError
from survey.files.toml_table import key, require_valid

_GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))
# Tilt of the convergent views from the plumb line, least and most [rad].
_TILTS = (math.radians(10.0), math.radians(35.0))


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
    # Share of the pixels of all photographs that the sun on the waves saturates; beyond the limit no bed is visible
    glint_share: float = key(0.0, least=0, most=0.6)
    # Standard deviation over mean of the light that waves focus on the bed, with other waves in each photograph
    caustic_contrast: float = key(0.0, least=0, most=1.5)
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
        places = _grid(nadir, self.size_m, self.image_px)
        cameras = [self._look_down(x, y, row, rng) for row, x, y in places]
        tilts = np.linspace(*_TILTS, self.num_views - nadir)
        azimuths = _GOLDEN_ANGLE * np.arange(len(tilts))
        cameras += [self._look_in(tilt, azimuth, rng) for tilt, azimuth in zip(tilts, azimuths, strict=True)]
        if self.rise_m != 0.0 and self.water:
            tides = self.rise_m * np.linspace(-0.5, 0.5, self.num_views)
            cameras = [replace(camera, tide=tide) for camera, tide in zip(cameras, tides.tolist(), strict=True)]
        if self.speed_m_s == 0.0 or self.readout_s == 0.0:
            return cameras
        motions = self.velocities() * self.readout_s / (self.image_px[1] - 1)
        return [replace(camera, motion=motion) for camera, motion in zip(cameras, motions, strict=True)]

    def velocities(self) -> np.ndarray:
        """Velocities of the cameras (views, 3) [m/s], local: level, in any direction."""
        toward = np.random.default_rng([self.seed, 9]).uniform(0.0, 2.0 * math.pi, self.num_views)
        return self.speed_m_s * np.stack([np.sin(toward), np.cos(toward), np.zeros(self.num_views)], axis=-1)

    def _look_down(self, x: float, y: float, row: int, rng: np.random.Generator) -> PinholeCamera:
        """A nadir view of a strip, with the heading of its strip and some noise of position and attitude."""
        shake = 0.02 * rng.standard_normal(2)
        heading = math.pi * (row % 2) + 0.03 * rng.standard_normal()
        forward = np.array([*shake, -1.0])
        return self._camera(self._place(x, y, rng), forward, heading)

    def _look_in(self, tilt: float, azimuth: float, rng: np.random.Generator) -> PinholeCamera:
        toward = np.array([math.sin(azimuth), math.cos(azimuth)])
        target = rng.uniform(-0.18, 0.18, 2) * self.size_m
        x, y = target - (self.flying_m + 0.7 * self.depth_m) * math.tan(tilt) * toward
        forward = np.array([*(math.sin(tilt) * toward), -math.cos(tilt)])
        return self._camera(self._place(x, y, rng), forward, azimuth + 0.05 * rng.standard_normal())

    def _place(self, x: float, y: float, rng: np.random.Generator) -> np.ndarray:
        return np.array([x, y, self.flying_m]) + 0.01 * self.flying_m * rng.standard_normal(3)

    def _camera(self, centre: np.ndarray, forward: np.ndarray, heading: float) -> PinholeCamera:
        """A camera that looks `forward`; the top of its image points to `heading` [rad], north over east."""
        forward = forward / np.linalg.norm(forward)
        right = np.cross(forward, [math.sin(heading), math.cos(heading), 0.0])
        right = right / np.linalg.norm(right)
        axes = np.stack([right, np.cross(forward, right), forward])
        width, height = self.image_px
        return PinholeCamera(centre, axes, self.focal_px, self.focal_px, width / 2, height / 2, width, height)


def _grid(count: int, size_m: tuple[float, float], image_px: tuple[int, int]) -> list[tuple[int, float, float]]:
    """Row, x and y [m] of `count` views in strips along x, with equal forward and side overlap."""
    rows = max(round(math.sqrt(count * size_m[1] / size_m[0] * image_px[0] / image_px[1])), 1)
    per_row = [count // rows + (r < count % rows) for r in range(rows)]
    places = []
    for row, columns in enumerate(per_row):
        y = 0.35 * size_m[1] * (2.0 * row / (rows - 1) - 1.0) if rows > 1 else 0.0
        for column in range(columns):
            x = 0.3 * size_m[0] * (2.0 * column / (columns - 1) - 1.0) if columns > 1 else 0.0
            places.append((row, x, y))
    return places
