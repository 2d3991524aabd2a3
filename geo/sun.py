"""Position of the sun by time and place."""

import math
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np

_J2000 = datetime(2000, 1, 1, 12, tzinfo=UTC)


@dataclass(frozen=True)
class Sun:
    """The middle of the sun in the sky."""

    azimuth: float  # [rad]: clockwise from north, 0 to 2 pi
    # [rad]: above the horizon, without the refraction of the air: 0.5 degrees at the horizon, 0.03 at 30 degrees
    elevation: float

    @property
    def direction(self) -> np.ndarray:
        """Unit direction (3,) toward the sun: east, north, up."""
        level = math.cos(self.elevation)
        return np.array([level * math.sin(self.azimuth), level * math.cos(self.azimuth), math.sin(self.elevation)])


def sun_at(time: datetime, latitude_deg: float, longitude_deg: float) -> Sun:
    """The sun at a time, with its time zone, seen from a place, north and east positive.

    The low-precision formulas of the Astronomical Almanac as J. J. Michalsky gives them (Solar Energy 40, 1988,
    227-235): good to 0.01 degrees from 1950 to 2050.
    """
    if time.tzinfo is None:
        raise ValueError(f"the time {time} has no time zone, expected one with its offset from UTC")
    days = (time - _J2000).total_seconds() / 86400.0
    mean_longitude = 280.460 + 0.9856474 * days
    anomaly = math.radians(357.528 + 0.9856003 * days)
    longitude = math.radians(mean_longitude + 1.915 * math.sin(anomaly) + 0.020 * math.sin(2.0 * anomaly))
    obliquity = math.radians(23.439 - 4e-7 * days)
    ascension = math.atan2(math.cos(obliquity) * math.sin(longitude), math.cos(longitude))
    declination = math.asin(math.sin(obliquity) * math.sin(longitude))
    # Of the Earth against the stars; a day from noon to noon is 24 h, and 24.06570982 h by the stars.
    sidereal = math.radians(15.0 * (18.697375 + 24.0657098242 * days) + longitude_deg)
    hour, latitude = sidereal - ascension, math.radians(latitude_deg)
    east = -math.cos(declination) * math.sin(hour)
    north = math.cos(latitude) * math.sin(declination) - math.sin(latitude) * math.cos(declination) * math.cos(hour)
    up = math.sin(latitude) * math.sin(declination) + math.cos(latitude) * math.cos(declination) * math.cos(hour)
    return Sun(math.atan2(east, north) % (2.0 * math.pi), math.asin(max(min(up, 1.0), -1.0)))
