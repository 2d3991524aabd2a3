"""Flight patterns: exposure stations by [flight] of a scene file, and their coverage of the bed through the water."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np

from refract import FlatWater, PinholeCamera
from refract.lens import Lens
from survey.errors import ConfigError, SurveyError
from survey.files.toml_table import key, require_valid

# Least angle of an image's upper border below the horizon [rad]: nearer to it water reflects, and footprints are
# endless.
_BELOW_HORIZON = math.radians(10.0)
# More photographs than this are a mistake in an overlap.
_MOST_VIEWS = 5000


# East and north [m], tilt from the plumb line and heading, clockwise from north [rad].
Pose = tuple[float, float, float, float]
PATTERNS = ("nadir", "five", "oblique", "outer")
_OVERLAP, _TILT = "0 to 0.97, a share of the footprint", "degrees from 0 (straight down) to 60"
# Points along each axis of the area at which views are counted.
_POINTS = 41
# Largest tilt of a nadir photograph [deg].
NADIR_DEG = 7.0


@dataclass(frozen=True)
class FlightSettings:
    """[flight]: a block of photographs over the area; exactly one of `poses`, `height_m` and `gsd_m` is given."""

    # File of planned poses, in a format of poses of surveys; the settings of patterns are then not used
    poses: str | None = None
    speed_m_s: float | None = key(None, above=0)  # [m/s] or None: of the drone while it photographs
    # [m]: standard deviation of GPS positions, in each direction: 0.02 with RTK or PPK, 3 without
    position_std_m: float = key(0.02, above=0)
    # [m]: of the cameras above the water, or above the origin where there is none
    height_m: float | None = key(None, above=0)
    gsd_m: float | None = key(None, above=0)  # [m]: of the bed straight below, seen through the water
    # some of "nadir" (strips of nadir views), "five" (the same strips with four more cameras that look ahead, back,
    # left and right), "oblique" (rings of views at a point of interest), "outer" (strips outside the four sides that
    # look in)
    patterns: tuple[str, ...] = ("nadir", "oblique")
    # forward_overlap, side_overlap [-]: share of a photograph's footprint on the bed that the next photograph, and the
    # next strip, covers again
    forward_overlap: float = key(0.8, _OVERLAP, least=0, most=0.97)
    side_overlap: float = key(0.7, _OVERLAP, least=0, most=0.97)
    heading_deg: float = 90.0  # [deg]: of the strips, clockwise from north
    tilt_deg: float = key(30.0, _TILT, least=0, most=60)  # [deg]: of all oblique views from the plumb line
    # (east, north) [m]: point of interest of the rings, from the origin, on the bed
    target: tuple[float, float] = (0.0, 0.0)
    ring_views: int = key(8, above=0)  # Views of each ring
    # [deg]: one ring for each; default: one of `tilt_deg`
    ring_tilts_deg: tuple[float, ...] = key((), _TILT, least=0, most=60)
    # [-]: deviation of the flight from the plan: of positions as a share of the height, of angles in radians
    wobble: float = key(0.01, least=0, most=0.1)

    def __post_init__(self):
        if sum(value is not None for value in (self.poses, self.height_m, self.gsd_m)) != 1:
            raise ConfigError(
                "flight: give exactly one of height_m, above the water, gsd_m, on the bed, and poses, a file; not both"
            )
        require_valid(self, FlightSettings, lambda field: f"flight.{field.name}")
        unknown = [word for word in self.patterns if word not in PATTERNS]
        if unknown or not self.patterns:
            raise ConfigError(f"flight.patterns is {list(self.patterns)}, expected some of {', '.join(PATTERNS)}")


@dataclass(frozen=True)
class Site:
    """Area, depth and water of a flight, local."""

    size_m: tuple[float, float]  # (east, north) [m]: about the origin
    depth_m: float  # [m]: of the bed below the water, on average; 0 for a dry site
    water: FlatWater | None

    @property
    def level(self) -> float:
        """Height of the water at the origin [m], local; 0 where there is none."""
        return 0.0 if self.water is None else float(self.water.height(0.0, 0.0))

    def flying_height(self, flight: FlightSettings, focal_px: float) -> float:
        """Height of the cameras above the water [m].

        Through water, the bed at depth h straight below appears at the distance ``H + h / n``.
        """
        if flight.height_m is not None:
            return flight.height_m
        if flight.gsd_m is None:
            raise SurveyError("flight has neither height_m nor gsd_m, expected one of them; give height_m")
        height = flight.gsd_m * focal_px - self.apparent_depth
        if height <= 0.0:
            raise SurveyError(
                f"flight.gsd_m is {flight.gsd_m:g}, for which the camera would have to be {-height:.2f} m under the "
                "water; give a coarser one, or a longer focal length"
            )
        return height

    @property
    def apparent_depth(self) -> float:
        """Apparent depth of the bed straight below a camera [m]."""
        return self.depth_m / (1.0 if self.water is None else float(self.water.n_water))


def plan_flight(flight: FlightSettings, lens: Lens, site: Site, seed: int) -> list[PinholeCamera]:
    """The cameras of a flight, local, in the order in which they are flown."""
    half_down = math.atan(0.5 * lens.height / lens.focal[1])
    tilts = [flight.tilt_deg, *flight.ring_tilts_deg] if set(flight.patterns) != {"nadir"} else [0.0]
    if math.radians(max(tilts)) + half_down > 0.5 * math.pi - _BELOW_HORIZON:
        raise SurveyError(
            f"views tilted by {max(tilts):g} degrees show the horizon with this lens, half of whose vertical field of "
            f"view is {math.degrees(half_down):.1f} degrees; give a smaller tilt or a longer focal length"
        )
    height = site.flying_height(flight, lens.focal[0])
    # No more than tell that they are too many: an area in wrong units has billions.
    poses = list(islice(_poses(flight, lens, site, height), _MOST_VIEWS + 1))
    if not 3 <= len(poses) <= _MOST_VIEWS:
        found = str(len(poses)) if len(poses) < 3 else f"more than {_MOST_VIEWS}"
        raise SurveyError(
            f"the flight has {found} photographs, expected 3 to {_MOST_VIEWS}; change the overlaps, the height or "
            "the area"
        )
    shakes = flight.wobble * np.random.default_rng([seed, 1]).standard_normal((len(poses), 6))
    return [_camera(pose, site.level, lens, height, shake) for pose, shake in zip(poses, shakes, strict=True)]


def _poses(flight: FlightSettings, lens: Lens, site: Site, height: float) -> Iterator[Pose]:
    """Exposure stations of all patterns, one pattern after the other."""
    tilt = math.radians(flight.tilt_deg)
    for pattern in flight.patterns:
        if pattern == "oblique":
            yield from _rings(flight, site, height)
        elif pattern == "outer":
            yield from _outer(flight, lens, site, height)
        else:
            for x, y, turn in _strips(flight, lens, site, height):
                yield x, y, 0.0, turn
                yield from ((x, y, tilt, turn + k * 0.5 * math.pi) for k in range(4 if pattern == "five" else 0))


def _footprint(lens: Lens, site: Site, height: float) -> tuple[float, float]:
    """Width and height [m] of the footprint of a nadir view on the bed."""
    n = 1.0 if site.water is None else float(site.water.n_water)
    tangents = [0.5 * size / focal for size, focal in zip((lens.width, lens.height), lens.focal, strict=True)]
    in_water = [math.tan(math.asin(math.sin(math.atan(tangent)) / n)) for tangent in tangents]
    across, along = (2.0 * (height * t + site.depth_m * w) for t, w in zip(tangents, in_water, strict=True))
    return across, along


def _strips(flight: FlightSettings, lens: Lens, site: Site, height: float) -> Iterator[tuple[float, float, float]]:
    """x, y [m] and heading [rad] of nadir views in parallel strips over the whole area, flown back and forth."""
    heading = math.radians(flight.heading_deg)
    ahead, right = _axes(heading)
    across, along = _footprint(lens, site, height)
    step, gap = along * (1.0 - flight.forward_overlap), across * (1.0 - flight.side_overlap)
    num_strips, num_views = (max(math.ceil(size / s) + 1, 1) for size, s in (
        (_extent(site, right), gap), (_extent(site, ahead), step),
    ))  # fmt: skip
    for strip in range(num_strips):
        b = (strip - 0.5 * (num_strips - 1)) * gap
        for view in range(num_views) if strip % 2 == 0 else reversed(range(num_views)):
            x, y = (view - 0.5 * (num_views - 1)) * step * ahead + b * right
            yield float(x), float(y), heading + math.pi * (strip % 2)


def _rings(flight: FlightSettings, site: Site, height: float) -> Iterator[Pose]:
    """x, y [m], tilt and heading [rad] of views from all around at the point of interest."""
    tilts = flight.ring_tilts_deg or (flight.tilt_deg,)
    for ring, tilt_deg in enumerate(tilts):
        tilt = math.radians(tilt_deg)
        reach = (height + site.apparent_depth) * math.tan(tilt)
        for view in range(flight.ring_views):
            # Rings are turned against each other, so that no two views look from the same side.
            heading = 2.0 * math.pi * (view + ring / len(tilts)) / flight.ring_views
            x, y = np.array(flight.target) - reach * _axes(heading)[0]
            yield float(x), float(y), tilt, heading


def _outer(flight: FlightSettings, lens: Lens, site: Site, height: float) -> Iterator[Pose]:
    """x, y [m], tilt and heading [rad] of strips outside the four sides that look at the area's border."""
    tilt = math.radians(flight.tilt_deg)
    reach = (height + site.apparent_depth) * math.tan(tilt)
    # The footprint of an oblique view widens with distance; that of its middle row counts.
    step = _footprint(lens, site, height)[0] / math.cos(tilt) * (1.0 - flight.forward_overlap)
    for side in range(4):
        inward = math.radians(flight.heading_deg) + 0.5 * math.pi * side
        ahead, right = _axes(inward)
        num_views = max(math.ceil(_extent(site, right) / step) + 1, 1)
        start = -(0.5 * _extent(site, ahead) + reach) * ahead
        for view in range(num_views):
            # From right to left, so that the next side begins where this one ends.
            x, y = start - (view - 0.5 * (num_views - 1)) * step * right
            yield float(x), float(y), tilt, inward


def _camera(pose: Pose, level: float, lens: Lens, height: float, shake: np.ndarray) -> PinholeCamera:
    """A camera at x, y [m], tilted toward a heading, to which the top of its image points; shaken (6,) [-, rad]."""
    x, y, tilt, heading = pose
    centre = np.array([x, y, level + height]) + height * shake[:3]
    heading, tilt = heading + shake[3], tilt + shake[4]
    ahead, _ = _axes(heading)
    forward = np.array([*(math.sin(tilt) * ahead), -math.cos(tilt)])
    top = np.array([*(math.cos(tilt) * ahead), math.sin(tilt)])
    right = np.cross(forward, top)
    c, s = math.cos(shake[5]), math.sin(shake[5])
    return lens.pinhole(centre, np.stack([c * right - s * top, -c * top - s * right, forward]))


def _axes(heading: float) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors (east, north) ahead and to the right of a heading [rad], clockwise from north."""
    east, north = math.sin(heading), math.cos(heading)
    return np.array([east, north]), np.array([north, -east])


def _extent(site: Site, axis: np.ndarray) -> float:
    """Extent of the area along a horizontal unit vector [m]."""
    return float(np.abs(axis) @ np.array(site.size_m))


def views_of_bed(cameras: Sequence[PinholeCamera], site: Site) -> np.ndarray:
    """How many photographs (rows, columns) see the points of a grid over a level bed at the site's mean depth."""
    east, north = (np.linspace(-0.5 * size, 0.5 * size, _POINTS) for size in site.size_m)
    x, y = np.meshgrid(east, north)
    points = np.stack([x, y, np.full_like(x, site.level - site.depth_m)], axis=-1)
    seen = [camera.sees(camera.project(points, site.water)) for camera in cameras]
    return np.sum(seen, axis=0)
