"""Random settings of surveys as they come from the field: what is there, and what the surveyor knows of it."""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from refract.lens import Lens

SIZES = ((640, 480), (800, 600), (1024, 768))
PLACES = (
    ("EPSG:25832+7837", (512340.0, 5960210.0)),
    ("EPSG:25832+7837", (676120.0, 5311480.0)),
    ("EPSG:25833+5778", (389250.0, 5248730.0)),
    ("EPSG:25831+7837", (688400.0, 5712050.0)),
)


@dataclass(frozen=True)
class FieldSettings:
    """A bed, its water, a flight and a camera.

    Attributes
    ----------
    crs, origin : str, (easting, northing)
        The local frame has its origin on the true water surface there.
    size_m : (east, north) [m]
        What is flown over, about the origin.
    depth_m : [m]
        Of the deepest part, relief aside.
    dry_share : [-]
        Of the area, a bank; 0 where all of it is wet.
    bank_to_deg : [deg]
        Toward which the bed rises, clockwise from north.
    relief : [-]
        Undulation as a share of the depth.
    bare_share : [-]
        Of the ground, nearly without texture.
    contrast, bare_contrast : [-]
        Of the texture elsewhere, and of what is left of that on bare ground.
    level_m, slope_east, slope_north, index : true water
    level_std_m : [m]
        With which the level was read.
    stated_level_m, stated_index : what the surveyor knows
    wave_m : [m]
        Amplitude of all trains of waves together.
    murk : [-]
        Absorption and veil, as a share of the usual.
    size_px, stated_focal_px, focal_px, principal_px, distortion : the camera; (k1, k2, p1, p2)
    height_m : [m]
        Of the cameras above the water.
    num_nadir, num_oblique : int
    position_std_m : (3,) [m]
        Of GPS, east, north, up.
    position_offset_m : (3,) [m]
        What all positions have in common.
    noise : [grey levels]
    exposure_std : [-]
        Of the logarithm of the exposure from image to image.
    vignetting : [-]
        Loss of light in the corners.
    jpeg_quality, jpeg_subsampling : int
        As Pillow has them.
    seed : int
    """

    crs: str
    origin: tuple[float, float]
    size_m: tuple[float, float]
    depth_m: float
    dry_share: float
    bank_to_deg: float
    relief: float
    bare_share: float
    contrast: float
    bare_contrast: float
    level_m: float
    slope_east: float
    slope_north: float
    index: float
    level_std_m: float
    stated_level_m: float
    stated_index: float
    wave_m: float
    murk: float
    size_px: tuple[int, int]
    stated_focal_px: float
    focal_px: float
    principal_px: tuple[float, float]
    distortion: tuple[float, float, float, float]
    height_m: float
    num_nadir: int
    num_oblique: int
    position_std_m: tuple[float, float, float]
    position_offset_m: tuple[float, float, float]
    noise: float
    exposure_std: float
    vignetting: float
    jpeg_quality: int
    jpeg_subsampling: int
    seed: int

    @property
    def gsd_m(self) -> float:
        """On the water, straight below [m]."""
        return self.height_m / self.focal_px

    def bounds(self, share: float) -> tuple[float, float, float, float]:
        """Low and high easting and northing of a part of the area about the origin, in crs."""
        (e, n), (wide, deep) = self.origin, (0.5 * share * size for size in self.size_m)
        return e - wide, n - deep, e + wide, n + deep

    @property
    def lens(self) -> Lens:
        """The true lens."""
        return Lens("OPENCV", (self.focal_px, self.focal_px, *self.principal_px, *self.distortion), *self.size_px)


def draw_settings(seed: int) -> FieldSettings:
    """Random settings; a seed has the same ones everywhere."""
    rng = np.random.default_rng([seed, 20])
    size_px, focal, height, depth = _flight_over(rng)
    dry_share = rng.uniform(0.12, 0.5) if rng.random() < 0.55 else 0.0
    num_views, num_oblique = _num_views(rng)
    size_m = _size_m(rng, height / focal * math.sqrt(size_px[0] * size_px[1]), num_views)
    std, offset = _receiver(rng, dry_share)
    level, level_std = rng.uniform(0.0, 400.0), rng.uniform(0.02, 0.06)
    index = rng.uniform(1.325, 1.345)
    slopes = rng.normal(0.0, 0.002, 2) if rng.random() < 0.3 else (0.0, 0.0)
    principal_px, distortion = _lens(rng, size_px)
    crs, origin = PLACES[rng.integers(len(PLACES))]
    return FieldSettings(
        crs=crs,
        origin=origin,
        size_m=size_m,
        depth_m=round(depth, 2),
        dry_share=round(dry_share, 3),
        bank_to_deg=round(rng.uniform(0.0, 360.0), 1),
        relief=round(rng.uniform(0.04, 0.14), 3),
        bare_share=round(rng.uniform(0.05, 0.45), 3),
        contrast=round(rng.uniform(0.5, 1.0), 3),
        # A sequence of its own. From sand that no matcher can follow to sand that shows its grains.
        bare_contrast=round(np.random.default_rng([seed, 25]).uniform(0.07, 0.6), 3),
        level_m=round(level, 3),
        slope_east=round(float(slopes[0]), 5),
        slope_north=round(float(slopes[1]), 5),
        index=round(index, 5),
        level_std_m=round(level_std, 3),
        stated_level_m=round(level + level_std * rng.standard_normal(), 3),
        stated_index=round(index + 0.001 * rng.standard_normal(), 4),
        wave_m=round(0.0 if rng.random() < 0.2 else rng.uniform(0.002, 0.015), 4),
        murk=round(rng.uniform(0.5, 1.3), 3),
        size_px=size_px,
        stated_focal_px=float(focal),
        focal_px=round(focal * (1.0 + rng.uniform(0.001, 0.01) * rng.choice([-1.0, 1.0])), 3),
        principal_px=principal_px,
        distortion=distortion,
        height_m=round(height, 2),
        num_nadir=num_views - num_oblique,
        num_oblique=num_oblique,
        position_std_m=std,
        position_offset_m=offset,
        noise=round(rng.uniform(1.0, 4.0), 2),
        exposure_std=round(rng.uniform(0.01, 0.08), 3),
        vignetting=round(rng.uniform(0.0, 0.4), 3),
        jpeg_quality=int(rng.integers(85, 96)),
        jpeg_subsampling=int(rng.choice([0, 2])),
        seed=seed,
    )


def _num_views(rng: np.random.Generator) -> tuple[int, int]:
    """How many photographs there are, and how many of them are oblique."""
    num_views = int(rng.integers(22, 57))
    nadir_only = rng.random() < 0.25
    return num_views, 0 if nadir_only else round(num_views * rng.uniform(0.2, 0.45))


def _size_m(rng: np.random.Generator, footprint_m: float, num_views: int) -> tuple[float, float]:
    """An area that as many views with such a footprint (side of a square as large) cover some eight times."""
    side = footprint_m * math.sqrt(num_views / 8.0) * rng.uniform(0.55, 0.75)
    ratio = rng.uniform(0.85, 1.15)
    return round(side * ratio, 2), round(side / ratio, 2)


def _receiver(rng: np.random.Generator, dry_share: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Standard deviation of GPS positions, and what all of them have in common, each (3,) [m]: east, north, up."""
    kind = rng.random()
    if kind < 0.7 or (kind >= 0.88 and dry_share == 0.0):
        return (0.02, 0.02, 0.03), (0.0, 0.0, 0.0)
    if kind < 0.88:
        return (0.05, 0.05, 0.08), (0.0, 0.0, 0.0)
    # A receiver without corrections: most of its error stays the same during a flight.
    return (1.5, 1.5, 1.5), tuple(round(float(v), 3) for v in rng.normal(0.0, 1.4, 3))


def _lens(rng: np.random.Generator, size_px: tuple[int, int]) -> tuple[tuple[float, float], tuple[float, ...]]:
    """Principal point [px] and distortion (k1, k2, p1, p2)."""
    off_axis, toward = rng.uniform(0.0, 8.0), rng.uniform(0.0, 2.0 * math.pi)
    k1 = rng.uniform(0.01, 0.08) * rng.choice([-1.0, 1.0])
    distortion = (k1, -k1 * rng.uniform(0.2, 0.8), *rng.normal(0.0, 0.0005, 2))
    principal = (
        round(size_px[0] / 2 + off_axis * math.cos(toward), 3),
        round(size_px[1] / 2 + off_axis * math.sin(toward), 3),
    )
    return principal, tuple(round(float(v), 6) for v in distortion)


def _flight_over(rng: np.random.Generator) -> tuple[tuple[int, int], int, float, float]:
    """Size [px], focal length [px], height of the cameras [m] and depth [m] that go together."""
    while True:
        size_px = SIZES[rng.integers(len(SIZES))]
        focal = 10 * round(0.1 * size_px[0] * rng.uniform(0.85, 1.6))
        height, depth = focal * rng.uniform(0.015, 0.035), rng.uniform(0.8, 6.0)
        if 15.0 <= height <= 45.0 and depth < 0.2 * height:
            return size_px, focal, height, depth


def as_table(settings: FieldSettings) -> dict:
    """The settings as values for TOML."""
    return {k: list(v) if isinstance(v, tuple) else v for k, v in dataclasses.asdict(settings).items()}
