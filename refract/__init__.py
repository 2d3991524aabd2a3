"""Snell optics of a camera in air and a bed under water; surfaces that are not planes are in `refract.curved`."""

# Part of bathynerf.

from refract._numbers import OutsideFit
from refract.camera import PinholeCamera
from refract.media import channel_indices, water_index
from refract.paths import BentPaths, trace
from refract.projection import Projection, crossing_point, project
from refract.snell import (
    Regime,
    apparent_depth,
    apparent_depth_tangential,
    bend,
    bend_regime,
    fresnel_coefficients,
    regime_counts,
    tangential_shift,
    true_depth,
)
from refract.surfaces import FlatWater, WaterSurface

__all__ = [
    "BentPaths",
    "FlatWater",
    "OutsideFit",
    "PinholeCamera",
    "Projection",
    "Regime",
    "WaterSurface",
    "apparent_depth",
    "apparent_depth_tangential",
    "bend",
    "bend_regime",
    "channel_indices",
    "crossing_point",
    "fresnel_coefficients",
    "project",
    "regime_counts",
    "tangential_shift",
    "trace",
    "true_depth",
    "water_index",
]
