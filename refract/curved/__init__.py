"""Water surfaces that are not planes: waves, and measured heights."""

from refract.curved.curved_water import CurvedWater
from refract.curved.surfaces import BicubicWater, WavyWater

__all__ = ["BicubicWater", "CurvedWater", "WavyWater"]
