"""The water level of a scene, in crs, as a surface in its local frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geo.frames import LocalFrame
from refract import FlatWater


@dataclass(frozen=True)
class WaterLevel:
    """Still water: what survey.toml says of it.

    Attributes
    ----------
    level_m : [m]
        Height of the surface at `level_at`, in crs.
    level_at : (easting, northing), in crs
    slope_east, slope_north : [-]
        Rise per metre along the grid axes.
    refractive_index : [-]
        Relative to air.
    """

    level_m: float
    level_at: tuple[float, float]
    slope_east: float = 0.0
    slope_north: float = 0.0
    refractive_index: float = 1.333

    def plane(self, frame: LocalFrame) -> FlatWater:
        """The surface in local."""
        at = np.array([*self.level_at, self.level_m])
        normal = frame.local_from_grid(at) @ (-self.slope_east, -self.slope_north, 1.0)
        point = tuple(float(v) for v in frame.local_from_crs(at))
        slopes = -normal[:2] / normal[2]
        return FlatWater(point, n_water=self.refractive_index, slope_x=float(slopes[0]), slope_y=float(slopes[1]))
