"""Snell optics of a camera in air and a bed under water; surfaces that are not planes are in `refract.curved`."""

# Part of bathynerf.

from refract._array import OutsideFit
from refract.camera import PinholeCamera
from refract.media import channel_indices, water_index
from refract.paths import BentPaths, Projection, crossing_point, project, trace
from refract.snell import (
    apparent_depth,
    apparent_depth_tangential,
    bend,
    fresnel_coefficients,
    tangential_shift,
    true_depth,
)
from refract.surfaces import FlatWater, WaterSurface

__all__ = [
    "BentPaths", "FlatWater", "OutsideFit", "PinholeCamera", "Projection", "WaterSurface", "apparent_depth",
    "apparent_depth_tangential", "bend", "channel_indices", "crossing_point", "fresnel_coefficients", "project",
    "tangential_shift", "trace", "true_depth", "water_index",
]  # fmt: skip
