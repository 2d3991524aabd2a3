"""Light from above: a sky whose radiance depends on elevation alone, and a sun of finite size."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from survey.errors import ConfigError

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
