"""Light from above: a sky whose radiance depends on elevation alone, and a sun of finite size."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geo import read_reference, require_same_crs
from geo.crs import height_unit_m
from geo.frames import LocalFrame
from geo.shapes import in_height_unit, vertices_of
from refract import FlatWater
from refract.curved import BicubicWater, WavyWater
from survey.errors import ConfigError, SurveyError
from survey.simulate.scene_file import WaveSettings

# Radiance of an overcast sky at the horizon, as a share of that at the zenith (CIE 1955, Moon and Spencer).
_HORIZON_SHARE = 1.0 / 3.0


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
