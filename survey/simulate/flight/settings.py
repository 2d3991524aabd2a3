"""Settings of a flight: [flight] of a scene file."""

from __future__ import annotations

from dataclasses import dataclass

from survey.errors import ConfigError

PATTERNS = ("nadir", "five", "oblique", "outer")


@dataclass(frozen=True)
class FlightSettings:
    """A block of photographs over an area; one of `poses`, `height_m` and `gsd_m` is given.

    Attributes
    ----------
    poses : str or None
        File of planned poses, as those of a survey; patterns and what they take are then not used.
    speed_m_s : [m/s] or None
        Of the drone while it photographs.
    position_std_m : [m]
        Of the positions of its receiver, in each direction: 0.02 with corrections, 3 without.
    height_m : [m]
        Of the cameras above the water, or above the origin where there is none.
    gsd_m : [m]
        Of the bed straight below, seen through the water.
    patterns : of "nadir", "five", "oblique", "outer"
        Strips that look down; the same strips with four cameras more, that look ahead, back, left and right;
        rings that look at a point of interest; strips along the four sides, outside, that look in.
    forward_overlap, side_overlap : [-]
        Share of a photograph's footprint on the bed that the next one, and the next strip, has too.
    heading_deg : [deg]
        Of the strips, clockwise from north.
    tilt_deg : [deg]
        Of all oblique views from the plumb line.
    target : (east, north) [m]
        Point of interest of the rings, from the origin, on the bed.
    ring_views : int
        Views of each ring.
    ring_tilts_deg : [deg]
        One ring for each; default: one of `tilt_deg`.
    wobble : [-]
        What a real flight deviates from the plan, as a share of the height for places and in radians for angles.
    """

    poses: str | None = None
    speed_m_s: float | None = None
    position_std_m: float = 0.02
    height_m: float | None = None
    gsd_m: float | None = None
    patterns: tuple[str, ...] = ("nadir", "oblique")
    forward_overlap: float = 0.8
    side_overlap: float = 0.7
    heading_deg: float = 90.0
    tilt_deg: float = 30.0
    target: tuple[float, float] = (0.0, 0.0)
    ring_views: int = 8
    ring_tilts_deg: tuple[float, ...] = ()
    wobble: float = 0.01

    def __post_init__(self):
        if sum(value is not None for value in (self.poses, self.height_m, self.gsd_m)) != 1:
            raise ConfigError(
                "flight: give one of height_m, above the water, gsd_m, on the bed, and poses, a file; not both"
            )
        for name in ("height_m", "gsd_m", "ring_views", "speed_m_s", "position_std_m"):
            value = getattr(self, name)
            if value is not None and value <= 0:
                raise ConfigError(f"flight.{name} is {value:g}, expected a number above zero")
        unknown = [word for word in self.patterns if word not in PATTERNS]
        if unknown or not self.patterns:
            raise ConfigError(f"flight.patterns is {list(self.patterns)}, expected some of {', '.join(PATTERNS)}")
        for name, value in (("forward_overlap", self.forward_overlap), ("side_overlap", self.side_overlap)):
            if not 0.0 <= value <= 0.97:
                raise ConfigError(f"flight.{name} is {value:g}, expected 0 to 0.97, a share of the footprint")
        for tilt in (self.tilt_deg, *self.ring_tilts_deg):
            if not 0.0 <= tilt <= 60.0:
                raise ConfigError(f"flight: a tilt of {tilt:g} degrees; expected 0 (straight down) to 60")
        if not 0.0 <= self.wobble <= 0.1:
            raise ConfigError(f"flight.wobble is {self.wobble:g}, expected 0 to 0.1")
