"""Water surfaces that are not planes: waves, rasters, scattered points, and still water on a round Earth."""

from refract.curved.any_surface import AnySurface
from refract.curved.bicubic import BicubicWater
from refract.curved.height_field import HeightFieldWater
from refract.curved.spherical import SphericalWater, curvature_drop, gaussian_radius
from refract.curved.wavy import WavyWater

__all__ = [
    "AnySurface",
    "BicubicWater",
    "HeightFieldWater",
    "SphericalWater",
    "WavyWater",
    "curvature_drop",
    "gaussian_radius",
]
