"""Snell optics of a camera in air and a bed under water."""

from refract._ranges import OutsideFit
from refract.absorption import channel_absorption, leg_transmittance
from refract.air import air_index
from refract.apparent import apparent_depth, apparent_depth_tangential, tangential_shift, true_depth
from refract.camera import PinholeCamera
from refract.fresnel import fresnel_coefficients, radiance_factor
from refract.media import channel_indices, water_index, water_index_iapws, water_index_parrish
from refract.paths import BentPaths, trace
from refract.projection import Projection, crossing_point, project
from refract.regimes import Regime, counts
from refract.snell import bend, bend_regime
from refract.surfaces import FlatWater, WaterSurface

__all__ = [
    "BentPaths",
    "FlatWater",
    "OutsideFit",
    "PinholeCamera",
    "Projection",
    "Regime",
    "WaterSurface",
    "air_index",
    "apparent_depth",
    "apparent_depth_tangential",
    "bend",
    "bend_regime",
    "channel_absorption",
    "channel_indices",
    "counts",
    "crossing_point",
    "fresnel_coefficients",
    "leg_transmittance",
    "project",
    "radiance_factor",
    "tangential_shift",
    "trace",
    "true_depth",
    "water_index",
    "water_index_iapws",
    "water_index_parrish",
]
