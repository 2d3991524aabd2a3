"""Snell optics of a camera in air and a bed under water."""

from refract.apparent import apparent_depth, apparent_depth_tangential, tangential_shift, true_depth
from refract.camera import PinholeCamera
from refract.paths import BentPaths, trace
from refract.projection import crossing_point
from refract.snell import bend
from refract.surfaces import FlatWater

__all__ = [
    "BentPaths",
    "FlatWater",
    "PinholeCamera",
    "apparent_depth",
    "apparent_depth_tangential",
    "bend",
    "crossing_point",
    "tangential_shift",
    "trace",
    "true_depth",
]
