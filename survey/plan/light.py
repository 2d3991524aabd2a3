"""Rows of `check` about light and motion: the sun and its glitter on the water, blur by motion, and sharpness.

Facets of the water reflect the sun into the camera where their normal is halfway between the directions to the sun and
to the camera. C. Cox and W. Munk (Journal of the Optical Society of America 44, 1954, 838-850) measured their slopes: a
slope s has the density ``exp(-s^2 / v) / (pi v)`` with ``v = 0.003 + 0.00512 W``, W the wind [m/s] 12.5 m above the
sea. Glitter is taken to end where facets are a tenth as frequent as level ones. On rivers and ponds, where fetch is
short, it is narrower.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import numpy as np

from geo.crs import EARTH_RADIUS_M, height_unit_m
from geo.sun import Sun, sun_at
from refract import FlatWater, PinholeCamera
from survey.display.quantities import listed
from survey.folder.found import Found
from survey.folder.heights import above_start_of, place_of
from survey.folder.observations import velocities_of
from survey.folder.survey import Survey
from survey.photos.exif import Exif, middle_of
from survey.photos.poses import enu_from_yaw_pitch_roll
from survey.photos.texture import MOSTLY_WHITE, bytes_per_pixel, image_detail, relative_sharpness
from survey.plan.area import ASSUMED_DEPTH_M, Places, in_the_middle, places_of
from survey.plan.check import Checked, CheckSection, Verdict, verdict_by_limits, verdict_text
from survey.plan.choices import gsd_m

# A light breeze, in which most surveys of clear shallow water are flown [m/s].
USUAL_WIND_M_S = 3.0
# Glitter ends where facets are this frequent, relative to level ones.
_RAREST = 0.1
_MOST_PLACES = 400
# Samples along the longer side of a frame.
_STEPS = 24
# Shares of the photographs of a place that glitter spoils, up to which it is good, or fair; where no places are known,
# shares of a photograph.
LOST_GOOD, LOST_FAIR = 0.15, 0.4
# Motion blur [px]: matches have a precision of a sixth of a pixel, which suffers first.
BLUR_GOOD_PX, BLUR_FAIR_PX = 0.5, 1.0
# Least relative sharpness: sharp photographs vary down to 0.8; motion by four pixels gives less than this.
LEAST_SHARP = 0.75
# At most so many photographs are decoded, evenly through the flight [Mpx].
_MOST_MPX = 150.0
# In addition, up to this many whose files have less than this share of the usual bytes per pixel.
_MOST_SMALL, _SMALL = 10, 0.6
# Blurred and white photographs are named up to this number.
_MOST_NAMED = 6
_WINDS = ("north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west")
_DEG_PER_HOUR = 15.0


@dataclass(frozen=True)
class Glitter:
    """Effect of sun glitter on a flight."""

    num_views: int
    num_mirrored: int  # Photographs whose frame contains the mirror image of the sun on level water
    share: tuple[float, float]  # (median, largest): share of a photograph within the glitter
    # views, free_views (low, median) or None: photographs of a place, and those that show it free of glitter: 10 %
    # quantile over the places, and median. None where too few views overlap.
    views: tuple[float, float] | None
    free_views: tuple[float, float] | None


def slope_variance(wind_m_s: float) -> float:
    """Mean square slope [-] of the sea in a wind (Cox and Munk 1954)."""
    return 0.003 + 0.00512 * wind_m_s


def largest_facet_slope(wind_m_s: float) -> float:
    """Largest slope angle [rad] of facets at the edge of the glitter."""
    return math.atan(math.sqrt(-math.log(_RAREST) * slope_variance(wind_m_s)))


def glitters(directions: np.ndarray, sun: np.ndarray, up: np.ndarray, wind_m_s: float) -> np.ndarray:
    """Mask of unit rays (..., 3) that end in the glitter of a sun in direction (3,); `up`: normal of the water."""
    facet = sun - directions
    with np.errstate(invalid="ignore"):
        lean = (facet @ up) / np.linalg.norm(facet, axis=-1)
    return (lean >= math.cos(largest_facet_slope(wind_m_s))) & (directions @ up < 0.0) & (sun @ up > 0.0)


class GlitterOfFlight:
    """Rays of a flight over water of a normal (3,), local, for the glitter of any sun; places of the bed under it."""

    def __init__(
        self, cameras: list[PinholeCamera], up: np.ndarray, places: Places | None = None, water: FlatWater | None = None
    ):
        self._cameras, self._up = cameras, up
        self._frames = [camera.directions(_pixels(camera)) for camera in cameras]
        places = None if places is None else places.some(_MOST_PLACES)
        self._seen = None if places is None else places.seen
        self._rays = [] if places is None else [c.directions(c.project(places.cells, water)) for c in cameras]

    @classmethod
    def of(cls, survey: Survey) -> GlitterOfFlight:
        """Glitter on a survey with water, for a bed two metres deep."""
        water, _ = survey.require_water()
        cameras = [view.camera for view in survey.views]
        return cls(cameras, np.array(water.up), places_of(survey, ASSUMED_DEPTH_M), water)

    def under(self, suns: np.ndarray, wind_m_s: float) -> Glitter:
        """Under the suns (V, 3) of the photographs, or one (3,) for all: unit directions, local."""
        suns, up = np.broadcast_to(suns, (len(self._cameras), 3)), self._up
        pairs = list(zip(self._frames, suns, strict=True))
        shares = [float(glitters(rays, sun, up, wind_m_s).mean()) for rays, sun in pairs]
        mirrors = suns - 2.0 * (suns @ up)[:, None] * up
        num_mirrored = sum(
            bool(sun @ up > 0.0 and camera.sees(camera.project(camera.centre + mirror, None)))
            for camera, sun, mirror in zip(self._cameras, suns, mirrors, strict=True)
        )
        every = free = None
        if self._seen is not None:
            glittering = np.array(
                [glitters(rays, sun, up, wind_m_s) for rays, sun in zip(self._rays, suns, strict=True)]
            )
            every, free = _low_and_median(self._seen), _low_and_median(self._seen & ~glittering)
        return Glitter(len(shares), num_mirrored, (float(np.median(shares)), max(shares)), every, free)

    def highest_sun(self, wind_m_s: float) -> float:
        """Largest elevation [rad] of the sun that keeps steep views free of glitter; negative where there is none."""
        # Of the steepest half of the views.
        down = np.array([float(camera.cam_from_local[2] @ self._up) for camera in self._cameras])
        steep = np.argsort(down, kind="stable")[: max(len(down) // 2, 1)]
        cosines = [self._frames[number] @ -self._up for number in steep]
        widest = max(float(np.arccos(np.clip(each, -1.0, 1.0)).max()) for each in cosines)
        # A reflected ray turns by twice the slope of the facet.
        return 0.5 * math.pi - widest - 2.0 * largest_facet_slope(wind_m_s)


def _pixels(camera: PinholeCamera) -> np.ndarray:
    """Grid of pixels (N, 2) over a frame, in the middles of squares."""
    side = max(camera.width, camera.height) / _STEPS
    u, v = np.meshgrid(np.arange(0.5 * side, camera.width, side), np.arange(0.5 * side, camera.height, side))
    return np.stack([u.ravel(), v.ravel()], axis=-1)


def _low_and_median(seen: np.ndarray) -> tuple[float, float]:
    counts = seen.sum(axis=0)
    return float(np.quantile(counts, 0.1)), float(np.median(counts))


def light_section(checked: Checked, *, wind_m_s: float = USUAL_WIND_M_S) -> CheckSection:
    """Section on light by the image headers, and on the sharpness of a sample of photographs."""
    found, survey = checked.found, checked.survey
    rows = [*_sun_rows(found, survey, wind_m_s), ("motion", motion_text(*_motion(found, survey)))]
    return CheckSection("Light and sharpness", (*rows, ("sharpness", sharpness_text(found))))


def sun_text(suns: list[Sun], when: str) -> str:
    """Position of the sun in words: the median one, and the range of heights."""
    heights = [math.degrees(sun.elevation) for sun in suns]
    middle = suns[len(suns) // 2]
    toward = _WINDS[round(8.0 * middle.azimuth / (2.0 * math.pi)) % 8]
    spread = f" ({min(heights):.0f} to {max(heights):.0f})" if max(heights) - min(heights) >= 1.0 else ""
    return (
        f"{math.degrees(middle.elevation):.0f} degrees high{spread} in the {toward} (azimuth "
        f"{math.degrees(middle.azimuth):.0f}), {when}"
    )


def glitter_text(glitter: Glitter, highest_sun: float, wind_m_s: float, *, is_flown: bool) -> str:
    """The verdict on the glitter of the sun; `highest_sun` [rad] see `GlitterOfFlight.highest_sun`."""
    share, most = (100.0 * value for value in glitter.share)
    found = (
        f"the sun's mirror image lies in {glitter.num_mirrored} of {glitter.num_views} photographs, and in a wind of "
        f"{wind_m_s:g} m/s glitter covers {share:.0f} % of one (median; at most {most:.0f} %)"
    )
    if glitter.free_views is not None:
        low, median = glitter.free_views
        found += (
            f"; a point of the ground is free of it in {median:.0f} photographs (median), the worst tenth in {low:.0f} "
            "or fewer"
        )
    limit = math.degrees(highest_sun)
    fly = (
        f"a sun lower than {limit:.0f} degrees leaves the steep photographs free of it"
        if limit >= 5.0
        else "with so wide a lens no sun is low enough: fly under clouds, or in less wind"
    )
    verdict = verdict_by_limits(lost_share(glitter), LOST_GOOD, LOST_FAIR)
    return verdict_text(verdict, found, f"{fly}; masks ([images] masks) exclude it" if is_flown else fly)


def lost_share(glitter: Glitter) -> float:
    """Share of the photographs of a place that glitter spoils; of a photograph, where no place is known."""
    if glitter.views is None or glitter.free_views is None:
        return glitter.share[0]
    return 1.0 - glitter.free_views[1] / max(glitter.views[1], 1.0)


def motion_text(speed: float | None, exposure: float | None, pixel: float | None, known: str = "") -> str:
    """The verdict on blur by motion: speed [m/s], exposure [s] and ground pixel [m] of the photograph with the most.

    ``known`` says of how many photographs these are known.
    """
    if speed is None or exposure is None or pixel is None:
        missing = "the speed" if speed is None else "the exposure time" if exposure is None else "the flying height"
        return f"unknown: {missing} is not given"
    blur = speed * exposure / pixel
    message = f"blurs by {blur:.2f} px at most ({speed:.1f} m/s, open for {1000.0 * exposure:.2g} ms{known})"
    if blur <= BLUR_GOOD_PX:
        return verdict_text(Verdict.good, message, "")
    slower, shorter = BLUR_GOOD_PX * pixel / exposure, BLUR_GOOD_PX * pixel / speed
    advice = f"fly at {slower:.1f} m/s or slower, or open the shutter for {1000.0 * shorter:.2g} ms or less"
    return verdict_text(verdict_by_limits(blur, BLUR_GOOD_PX, BLUR_FAIR_PX), message, advice)


def sharpness_text(found: Found) -> str:
    """The verdict on photographs that are mostly white, and on those less sharp than the others."""
    names = _some(found)
    images = [image_detail(found.images[name]) for name in names]
    of = f"of {len(names)} photographs" + ("" if len(names) == len(found.images) else f" (of {len(found.images)})")
    plain = [name for name, image in zip(names, images, strict=True) if image.is_plain]
    white = {
        name: image.white
        for name, image in zip(names, images, strict=True)
        if image.white > MOSTLY_WHITE and not image.is_plain
    }
    clear = [name for name in names if name not in white and name not in plain]
    details = [image.detail for name, image in zip(names, images, strict=True) if name in clear]
    sharp = relative_sharpness(details) if clear else np.ones(0)
    if not np.isfinite(sharp).all():
        return "unknown: the photographs are too small"
    blurred = {name: float(value) for name, value in zip(clear, sharp, strict=True) if value < LEAST_SHARP}
    parts, advice = [], []
    low_bits = {image.low_bits for image in images}
    if plain and None not in low_bits:
        bits = max(filter(None, low_bits))
        parts.append(f"photographs of 16 bits hold numbers of {bits} bits, which show as black")
        advice.append(f"multiply their pixels by {1 << (16 - bits)}, the same in all")
    elif plain:
        verb = "is" if len(plain) == 1 else "are"
        named = listed(plain, _MOST_NAMED)
        parts.append(f"{len(plain)} {of} {verb} black or of one colour all over, and show nothing: {named}")
        advice.append("take these out of the image folder")
    if white:
        worst = _named([(name, f"{100.0 * white[name]:.0f} %") for name in sorted(white, key=lambda n: -white[n])])
        verb = "is" if len(white) == 1 else "are"
        parts.append(f"{len(white)} {of} {verb} more than half white by glint of the sun or exposure: {worst}")
        advice.append("saturated pixels show nothing of the bed: expose less, or fly at a lower sun")
    if blurred:
        worst = _named([(name, f"{blurred[name]:.2f}") for name in sorted(blurred, key=lambda n: blurred[n])])
        parts.append(
            f"{len(blurred)} {of} have less than {LEAST_SHARP:g} of the usual detail in some direction: {worst}"
        )
        advice.append("look at these, and take those that are blurred out of the image folder")
    elif clear:
        parts.append(f"none {of} is blurred against the others (the worst has {sharp.min():.2f})")
    bad = len(plain) + len(white) + len(blurred)
    verdict = Verdict.good if not bad else Verdict.fair if bad <= 0.1 * len(names) else Verdict.poor
    return verdict_text(verdict, "; ".join(parts), "; ".join(advice))


def _named(worst: list[tuple[str, str]]) -> str:
    """The first of many photographs by name, with their fault."""
    return listed([f"{name} ({value})" for name, value in worst], _MOST_NAMED)


def _some(found: Found) -> list[str]:
    """Names of photographs evenly spaced over the flight, and of those that compress to few bytes, as empty ones do."""
    names = sorted(found.images)
    mpx = np.median([header.size_px[0] * header.size_px[1] for header in found.headers.values()]) / 1e6
    number = int(np.clip(_MOST_MPX / mpx, 3, len(names)))
    chosen = {names[place] for place in np.linspace(0, len(names) - 1, number).round().astype(int)}
    per_pixel = bytes_per_pixel([found.images[name] for name in names], [found.headers[name].size_px for name in names])
    small = np.flatnonzero(per_pixel < _SMALL * np.median(per_pixel))
    return sorted(chosen | {names[place] for place in small[np.argsort(per_pixel[small], kind="stable")][:_MOST_SMALL]})


def _motion(found: Found, survey: Survey | None) -> tuple[float | None, float | None, float | None, str]:
    """Speed, exposure time and pixel size of the photograph with the most motion, and for how many they are known."""
    if survey is not None:
        velocities = survey.observations.velocities
    else:
        velocities = velocities_of(_gps_places(found), found.headers, None)
    speeds = {name: velocity.speed for name, velocity in velocities.items()}
    exposures = {name: header.exposure_s for name, header in found.headers.items() if header.exposure_s is not None}
    both = sorted(speeds.keys() & exposures.keys(), key=lambda name: speeds[name] * exposures[name])
    focal, height = _focal_px(found), above_start_of(found.headers)
    water = found.config.water
    heights = [header.lat_lon_height[2] for header in found.headers.values() if header.lat_lon_height is not None]
    if water is not None and water.level_m is not None and heights:
        over_water = float(np.nanmedian(heights)) - water.level_m / height_unit_m(found.crs)
        height = over_water if over_water > 0.0 else height
    by_headers = None if focal is None or height is None else height / focal
    pixel = by_headers if survey is None else gsd_m(survey)
    if not both:
        return max(speeds.values(), default=None), max(exposures.values(), default=None), pixel, ""
    known = "" if len(both) == len(found.images) else f"; known of {len(both)} of {len(found.images)}"
    return speeds[both[-1]], exposures[both[-1]], pixel, known


def _gps_places(found: Found) -> dict[str, np.ndarray]:
    """Places (3,) [m] of the photographs that have a GPS position, east, north and up of one of them."""
    known = {name: header.lat_lon_height for name, header in found.headers.items() if header.lat_lon_height is not None}
    if not known:
        return {}
    lat0, lon0, height0 = next(iter(known.values()))
    per_degree = math.radians(EARTH_RADIUS_M)
    across = per_degree * math.cos(math.radians(lat0))
    return {
        name: np.array([across * (lon - lon0), per_degree * (lat - lat0), np.nan_to_num(height - height0)])
        for name, (lat, lon, height) in known.items()
    }


def _focal_px(found: Found) -> float | None:
    given = found.config.cameras.focal_px
    if given is not None:
        return given[0] if isinstance(given, tuple) else given
    focals = [header.focal_px for header in found.headers.values() if header.focal_px is not None]
    return float(np.median(focals)) if focals else None


def _sun_rows(found: Found, survey: Survey | None, wind_m_s: float) -> list[tuple[str, str]]:
    """The sun, and its glitter where there is water."""
    place = _place(found, survey)
    if place is None:
        return [("sun", "unknown: no photograph has a position")]
    names = sorted(found.headers)
    if survey is not None:
        survey = in_the_middle(survey)
        names = [view.name for view in survey.views]
    times, assumed = times_of({name: found.headers[name] for name in names}, place[1])
    if times is None:
        return [("sun", "unknown: EXIF has no times")]
    suns = [sun_at(time, *place) for time in times]
    later = sun_at(times[len(times) // 2] - timedelta(hours=1), *place)
    summer = f"summer time, the sun was {math.degrees(later.elevation):.0f} degrees high"
    has_time_zone = any(found.headers[name].taken is not None for name in names)
    assumption = f"; {assumed}" + ("" if has_time_zone else f": if it was {summer}") if assumed else ""
    first, last = min(times), max(times)
    rows = [("sun", sun_text(suns, f"{first:%Y-%m-%d %H:%M} to {last:%H:%M} UTC{assumption}"))]
    flight = _flight(found, survey)
    if flight is None:
        return rows
    if max(sun.elevation for sun in suns) <= 0.0:
        return [*rows, ("glitter", "unknown: the sun is below the horizon by these times; set the clock of the camera")]
    glitter = flight.under(np.array([sun.direction for sun in suns]), wind_m_s)
    return [*rows, ("glitter", glitter_text(glitter, flight.highest_sun(wind_m_s), wind_m_s, is_flown=True))]


def times_of(headers: Mapping[str, Exif], longitude_deg: float) -> tuple[list[datetime] | None, str]:
    """Times of exposure in UTC with the assumption made; None where headers lack one."""
    taken = [header.taken for header in headers.values() if header.taken is not None]
    if len(taken) == len(headers):
        return taken, ""
    clocks = [header.clock for header in headers.values() if header.clock is not None]
    if len(clocks) < len(headers):
        return None, ""
    zones = [
        header.clock.replace(tzinfo=UTC) - header.taken for header in headers.values() if header.clock and header.taken
    ]
    if zones:
        # One camera, or one that was flown with others: those that say their offset tell that of the rest.
        zone = timedelta(minutes=round(float(np.median([each.total_seconds() for each in zones])) / 60.0))
        num_lacking = len(headers) - len(taken)
        assumed = f"EXIF has no time zone of {num_lacking} of {len(headers)}, and that of the others is taken"
    else:
        hours = round(longitude_deg / _DEG_PER_HOUR)
        zone = timedelta(hours=hours)
        assumed = f"EXIF has no time zone, and UTC{hours:+d} by the longitude is assumed"
    return [
        header.taken or header.clock.replace(tzinfo=UTC) - zone for header in headers.values() if header.clock
    ], assumed


def _place(found: Found, survey: Survey | None) -> tuple[float, float] | None:
    """Latitude and longitude [deg] of the survey."""
    if survey is None:
        return middle_of(found.headers)
    return place_of(survey.frame.crs, np.array(survey.frame.origin))


def _flight(found: Found, survey: Survey | None) -> GlitterOfFlight | None:
    """The rays of the photographs; those of their gimbals where no poses are known, else straight down."""
    if survey is not None:
        return GlitterOfFlight.of(survey) if survey.water is not None else None
    focal = _focal_px(found)
    if found.config.water is None or focal is None:
        return None
    cameras = []
    for name in sorted(found.headers):
        header = found.headers[name]
        yaw, pitch, roll = np.radians(header.motion.gimbal_deg or (0.0, -90.0, 0.0))
        cam_from_enu = enu_from_yaw_pitch_roll(yaw, pitch + 0.5 * math.pi, roll).T
        width, height = header.size_px
        cameras.append(PinholeCamera(np.zeros(3), cam_from_enu, focal, focal, 0.5 * width, 0.5 * height, width, height))
    return GlitterOfFlight(cameras, np.array([0.0, 0.0, 1.0]))
