"""The scene file: settings of a simulation in TOML, every key checked (docs/simulation.md lists them)."""

from dataclasses import MISSING, dataclass, field
from datetime import datetime
from pathlib import Path

from survey.errors import ConfigError
from survey.files.toml_table import key, parse_toml, read_toml
from survey.simulate.flight import FlightSettings

BEDS = ("drawn", "plane", "mesh", "cloud")
TEXTURES = ("sand", "checker", "image", "vertex")
MODES = ("direct", "physical")


@dataclass(frozen=True)
class BedSettings:
    """[bed]: the shape of the ground."""

    kind: str = key("drawn", one_of=BEDS)
    file: str | None = None
    frame: str = key("crs", one_of=("crs", "local"))  # of the file: "crs", or "local" [m] about the origin
    depth_m: float = key(2.5, above=0)  # drawn, plane: mean depth below the origin
    shore: bool = False  # drawn: a bank that rises out of the water in the north
    bodies: bool = False  # drawn: a boat, an amphora, rocks
    cell_m: float = key(0.025, above=0)  # drawn: between its vertices
    spacing_m: float | None = key(None, above=0)  # cloud: thinned to one point per cell of this size first
    smoothing: int = key(0, "a number of passes, zero or more", least=0)  # cloud: passes of Laplacian smoothing

    def __post_init__(self):
        if (self.kind in ("mesh", "cloud")) != (self.file is not None):
            remedy = f'give file = "..." for kind = "{self.kind}"' if self.file is None else 'give kind = "mesh"'
            raise ConfigError(f"bed.kind {self.kind} does not go with bed.file {self.file}; {remedy}, or remove it")


@dataclass(frozen=True)
class TextureSettings:
    """[texture]: albedo of the bed."""

    kind: str = key("sand", one_of=TEXTURES)
    file: str | None = None  # image: laid over the bed from above
    texel_m: float = key(0.01, above=0)  # sand: resolution; image: size of its pixels on the ground
    square_m: float = key(0.5, above=0)  # checker: side of a square

    def __post_init__(self):
        if (self.kind == "image") != (self.file is not None):
            raise ConfigError(
                f'texture.kind {self.kind} does not go with texture.file {self.file}; kind = "image" needs a file'
            )


@dataclass(frozen=True)
class ObjectSettings:
    """[[objects]]: a body from a file, placed on the bed."""

    file: str
    at: tuple[float, float]  # [m] east and north of the origin
    above_bed_m: float = 0.0  # its lowest point
    scale: float = key(1.0, above=0)
    yaw_deg: float = 0.0  # counter-clockwise, seen from above
    pitch_deg: float = 0.0
    heel_deg: float = 0.0
    up: str = key("z", one_of=("y", "z"))  # the axis of the file that points up; of glTF it is known
    colour: tuple[float, float, float] = (0.42, 0.29, 0.18)  # linear albedo, speckled, where the file has none
    texel_m: float = key(0.01, above=0)  # resolution of the speckle


@dataclass(frozen=True)
class WaveSettings:
    """[[water.waves]]: one train of sinusoidal waves."""

    amplitude_m: float = key(MISSING, above=0)
    length_m: float = key(MISSING, above=0)
    toward_deg: float = 0.0  # clockwise from north
    phase_deg: float = 0.0  # at the origin


@dataclass(frozen=True)
class WaterSettings:
    """[water]: absent for a dry scene."""

    level_m: float | None = None  # height in crs at the origin; default: the height of the origin
    slope_east: float = 0.0
    slope_north: float = 0.0
    refractive_index: float = key(1.333, "1.0 to 1.6; fresh: 1.333", least=1.0, most=1.6)
    absorption: tuple[float, float, float] = key(
        (0.17, 0.042, 0.055), "[red, green, blue], zero or more, in 1/m", least=0
    )
    scattering: float = key(0.2, "zero or more, in 1/m", least=0)
    # Mean cosine of scattering
    asymmetry: float = key(0.92, "above 0 (isotropic) and below 1", above=0, below=1)
    waves: tuple[WaveSettings, ...] = ()
    heights: str | None = None  # file of points or a raster of the surface, in crs, instead of a plane

    def __post_init__(self):
        if self.waves and self.heights is not None:
            raise ConfigError("water.waves and water.heights contradict each other; keep one")


@dataclass(frozen=True)
class LightSettings:
    """[light]: sky and sun."""

    sky: str = key("clear", one_of=("clear", "overcast"))
    # Of the light on level ground
    sun_share: float = key(0.4, "0 (no sun) to below 1", least=0, below=1)
    time: str | None = key(None, 'a time with its zone, e.g. "2026-07-14T09:30+02:00"')  # instead of the next two
    sun_elevation_deg: float | None = key(None, "5 to 90", least=5, most=90)  # default: 57
    sun_azimuth_deg: float | None = None  # clockwise from north; default: 56
    sun_diameter_deg: float = key(0.53, above=0)

    def __post_init__(self):
        if self.time is not None and (self.sun_elevation_deg is not None or self.sun_azimuth_deg is not None):
            raise ConfigError("light.time gives the position of the sun; remove sun_elevation_deg and sun_azimuth_deg")
        _ = self.known_time

    @property
    def known_time(self) -> datetime | None:
        """`time`, with its zone; None where it is not given."""
        try:
            known = None if self.time is None else datetime.fromisoformat(self.time)
        except ValueError:
            known = datetime.min
        if known is not None and known.tzinfo is None:
            raise ConfigError(
                f'light.time is "{self.time}", expected a time with its zone, e.g. "2026-07-14T09:30+02:00"'
            )
        return known


@dataclass(frozen=True)
class CameraSettings:
    """[camera]: the lens, in COLMAP's models."""

    size_px: tuple[int, int] = key(MISSING, "[width, height], at least 16 pixels a side", least=16)
    focal_px: float | None = key(None, above=0)
    focal_mm: float | None = key(None, above=0)  # with sensor_mm instead of focal_px
    sensor_mm: float | None = key(None, above=0)  # width of the sensor
    principal_point_px: tuple[float, float] | None = None
    model: str = "PINHOLE"
    distortion: tuple[float, ...] = ()

    def __post_init__(self):
        if (self.focal_px is None) == (self.focal_mm is None or self.sensor_mm is None):
            raise ConfigError("camera: give focal_px, or focal_mm and sensor_mm, and not both")

    @property
    def known_focal_px(self) -> float:
        """The focal length [px], as given or from millimetres."""
        by_mm = 0.0 if self.focal_mm is None or self.sensor_mm is None else self.focal_mm / self.sensor_mm
        return by_mm * self.size_px[0] if self.focal_px is None else self.focal_px


@dataclass(frozen=True)
class SensorSettings:
    """[sensor]: noise, exposure and motion blur."""

    noise: float = key(1.0, least=0)  # [grey levels], independent of the signal
    photons_at_white: float = key(0.0, least=0)  # 0: no shot noise
    exposure: float = key(1.0, above=0)  # linear grey per radiance
    exposure_drift: float = key(0.0, least=0)  # step of the logarithm from image to image
    blur_m: float = key(0.0, least=0)  # flown while the shutter is open
    shutter_s: float | None = key(None, above=0)  # open for so long, at flight.speed_m_s: instead of blur_m

    def __post_init__(self):
        if self.shutter_s is not None and self.blur_m != 0.0:
            raise ConfigError("sensor.shutter_s and sensor.blur_m say the same; keep one")


@dataclass(frozen=True)
class RenderSettings:
    """[render]: light transport."""

    mode: str = key("physical", one_of=MODES)
    samples: int = key(64, above=0)  # rays per pixel
    max_bounces: int = key(12, above=0)


@dataclass(frozen=True)
class AreaSettings:
    """[area]: the area flown over and evaluated."""

    size_m: tuple[float, float] = key(MISSING, "[east, north], above 0, about the origin", above=0)


@dataclass(frozen=True)
class SceneSettings:
    crs: str
    origin: tuple[float, float, float]  # easting, northing, height: of the local frame
    area: AreaSettings
    camera: CameraSettings
    flight: FlightSettings
    name: str = "simulated"
    seed: int = key(1, "a whole number from zero on", least=0)
    bed: BedSettings = field(default_factory=BedSettings)
    texture: TextureSettings = field(default_factory=TextureSettings)
    objects: tuple[ObjectSettings, ...] = ()
    water: WaterSettings | None = None
    light: LightSettings = field(default_factory=LightSettings)
    sensor: SensorSettings = field(default_factory=SensorSettings)
    render: RenderSettings = field(default_factory=RenderSettings)

    def __post_init__(self):
        if self.sensor.shutter_s is not None and self.flight.speed_m_s is None:
            raise ConfigError("sensor.shutter_s is given without flight.speed_m_s; give both, or sensor.blur_m")

    @property
    def blur_m(self) -> float:
        """Motion of the drone while the shutter is open [m]."""
        if self.sensor.shutter_s is None or self.flight.speed_m_s is None:
            return self.sensor.blur_m
        return self.flight.speed_m_s * self.sensor.shutter_s


def read_scene(path: Path) -> SceneSettings:
    """Read and check a scene file."""
    return read_toml(path, lambda text: parse_toml(text, SceneSettings))
