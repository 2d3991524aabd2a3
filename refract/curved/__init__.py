"""Water surfaces that are not planes: waves, and measured heights."""

from refract.curved.bicubic import BicubicWater
from refract.curved.curved_water import CurvedWater
from refract.curved.wavy import WavyWater

__all__ = ["BicubicWater", "CurvedWater", "WavyWater"]
