"""[water] of survey.toml: a plane, the index of the water, its colour, and how well they are known."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from survey.errors import ConfigError
from survey.files.toml_table import INLINE, key, require_with, std_key

MOST_LEVEL_STD_M = 10.0
# Slope of a water surface at most: steeper than 0.065 a stream is a cascade, white water that shows no bed
# (D. R. Montgomery and J. M. Buffington, Channel-reach morphology in mountain drainage basins, 1997).
MOST_SLOPE = 0.065
# Filling locks and the largest tidal bores rise faster, and nobody flies there for the bed.
MOST_RATE_M_PER_H = 10.0


@dataclass(frozen=True)
class LevelSources:
    """Files of [water] that give the level, at most one."""

    shoreline: str | None = None  # CSV of points, easting, northing, height, or a vector file, where water meets land
    gnss_points: str | None = None  # the same, of points anywhere on the surface
    surface: str | None = None  # the same or a GeoTIFF, of water that is not a plane
    gauge: str | None = None  # series of time and level: CSV, or a form of NOAA, PEGELONLINE or USGS
    image_levels: str | None = None  # CSV of image, level
    clicks: str | None = None  # CSV of image, x, y, name: places of the waterline in two photographs or more

    @property
    def named(self) -> dict[str, str]:
        """The files that are given, by their keys."""
        return {name: path for name, path in vars(self).items() if path is not None}


@dataclass(frozen=True)
class LevelRate:
    """Rate of [water] at which the level rises."""

    level_rate_m_per_h: float | None = key(  # the level then holds at level_time
        None,
        f"metres per hour, at most {MOST_RATE_M_PER_H:g} up or down; tides have up to 3",
        least=-MOST_RATE_M_PER_H,
        most=MOST_RATE_M_PER_H,
    )
    # Where it is given, the adjustment finds the rate
    level_rate_std_m_per_h: float | None = std_key(
        MOST_RATE_M_PER_H, "metres per hour", "0.3 if the tide is nearly unknown"
    )
    level_time: str | None = key(None, "a time with its zone, e.g. 2024-06-01T10:30:00Z")

    def __post_init__(self):
        require_with("water", self, "level_rate_m_per_h", ("level_time", "level_rate_std_m_per_h"), "0 if unknown")


@dataclass(frozen=True)
class Medium:
    """Light or water that the index in [water] belongs to; nothing in a loaded survey."""

    index_wavelength_nm: float | None = key(
        None, "400 to 700, the wavelengths of light; an index from a handbook belongs to 589.3", least=400.0, most=700.0
    )
    temperature_c: float | None = None
    salinity_psu: float | None = None

    @property
    def named(self) -> list[str]:
        """The keys of the water itself that are given."""
        return [name for name in ("temperature_c", "salinity_psu") if getattr(self, name) is not None]

    def __post_init__(self):
        require_with("water", self, "temperature_c", ("salinity_psu",), "or refractive_index")


@dataclass(frozen=True)
class WaterColour:
    """Colour of [water]."""

    absorption_per_m: tuple[float, float, float] | None = key(
        None, "[red, green, blue], the absorption coefficient in 1/m, none below 0, e.g. [0.3, 0.07, 0.05]", least=0.0
    )
    veiling_light: tuple[float, float, float] | None = key(
        None,
        "[red, green, blue], linear light of endless water, 0 for none, 1 for white, e.g. [0.03, 0.17, 0.2]",
        least=0.0,
    )

    def __post_init__(self):
        for one, other in (("absorption_per_m", "veiling_light"), ("veiling_light", "absorption_per_m")):
            require_with("water", self, other, (one,), "veiling_light = [0, 0, 0] for water that scatters nothing")


@dataclass(frozen=True)
class WaterConfig:
    """[water]: a plane through ``level_m`` at ``level_at``, with its rise per metre along the grid axes."""

    level_m: float | None = None  # None only until the file that is named instead is read
    level_at: tuple[float, float] | None = key(None, "[easting, northing]")
    slope_east: float = 0.0
    slope_north: float = 0.0
    # Of the light that is matched, unless index_wavelength_nm tells another
    refractive_index: float | None = key(
        None, "1.0 to 1.6 relative to air; fresh water has 1.333, sea water 1.340", least=1.0, most=1.6
    )
    medium: Medium = field(default_factory=Medium, metadata=INLINE)
    colour: WaterColour = field(default_factory=WaterColour, metadata=INLINE)
    sources: LevelSources = field(default_factory=LevelSources, metadata=INLINE)
    rate: LevelRate = field(default_factory=LevelRate, metadata=INLINE)
    gauge_zero_m: float | None = None  # height in crs from which the readings of the gauge count
    layer: str | None = None  # of the file of points or lines, the one that is the water
    # Standard deviations, for the adjustment
    level_std_m: float | None = std_key(MOST_LEVEL_STD_M, "metres", "a staff has about 0.02, a gauge 0.01")
    index_std: float | None = std_key(0.1, "", "temperature and salinity give the index to 0.0005")
    slope_std: float | None = std_key(0.2, "metres per metre", "a river slopes by 0.001 to 0.01")

    def __post_init__(self):
        levels = [*([] if self.level_m is None else ["level_m"]), *self.sources.named]
        moving = [name for name in ("gauge", "image_levels") if name in self.sources.named]
        files = ("shoreline", "gnss_points", "surface")
        if self.sources.surface is not None and (self.level_at is not None or self.slope_east or self.slope_north):
            raise ConfigError("[water] surface gives the level everywhere; remove level_at, slope_east and slope_north")
        require_with("water", self.sources, "gauge", ("gauge_zero_m",), "readings count from its zero", self)
        if self.layer is not None and not any(name in self.sources.named for name in files):
            raise ConfigError(f"[water] has layer without {', '.join(files)}, one of whose files has it; give both")
        if len(levels) > 1:
            raise ConfigError(f"[water] has {' and '.join(levels)}, each of which gives the level; keep one")
        if self.rate.level_rate_m_per_h is not None and moving:
            raise ConfigError(f"[water] has level_rate_m_per_h and {moving[0]}, both of a moving level; keep one")
        if self.refractive_index is not None and self.medium.named:
            raise ConfigError(f"[water] has both refractive_index and {' and '.join(self.medium.named)}; keep one")
        require_with("water", self, "refractive_index", ("index_wavelength_nm",), "or temperature_c", self.medium)

    @property
    def known_level_m(self) -> float:
        """``level_m`` of settings for which the file that may be named instead was read."""
        if self.level_m is None:
            raise ValueError("level_m is not known before the file that [water] names instead is read")
        return self.level_m

    @property
    def known_level_at(self) -> tuple[float, float]:
        """``level_at`` of the settings of a loaded survey, which have its default filled in."""
        if self.level_at is None:
            raise ValueError("level_at is not known before its default is filled in from the cameras")
        return self.level_at

    @property
    def states_index(self) -> bool:
        """Whether the index is given; else it and its standard deviation are assumed."""
        return not (self.refractive_index is None and self.medium.temperature_c is None and self.index_std is None)

    @property
    def gives_level(self) -> bool:
        """Whether a level, or a file of it, is given."""
        return self.level_m is not None or bool(self.sources.named)

    def require_level(self) -> None:
        """Raise ConfigError where neither a level nor a file of it is given.

        Structure from motion can do without: the adjustment then finds the level, where the photographs tell it.
        """
        if not self.gives_level:
            raise ConfigError(
                "level_m is missing from [water]. Give the height of the water surface in the survey's vertical "
                "datum, e.g. level_m = 12.34, or name a file in shoreline, gnss_points, surface, gauge, image_levels "
                "or clicks. For a dry survey write dry = true above the first table, in place of [water]. Only a "
                "survey without poses, with GPS positions in its photographs, can leave the level to the adjustment"
            )


def require_slope(slope: tuple[float, float], source: str, remedy: str) -> None:
    """Raise ConfigError where a slope [-] east and north is steeper than `MOST_SLOPE`; ``source`` begins the error."""
    steepness = math.hypot(*slope)
    if steepness > MOST_SLOPE:
        raise ConfigError(
            f"{source} {slope[0]:.3g} and {slope[1]:.3g}, {math.degrees(math.atan(steepness)):.2g} degrees, expected a "
            f"rise of at most {MOST_SLOPE:g} m in a metre (a river has 0.001 to 0.01, a rapid 0.03); {remedy}"
        )
