"""A staged scene, and the files that go with its photographs: survey.toml, cameras.csv, EXIF and XMP."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image
from PIL.PngImagePlugin import PngInfo
from PIL.TiffImagePlugin import IFDRational
from scipy.spatial.transform import Rotation

from geo import write_whole
from geo.crs import is_geographic
from geo.frames import LocalFrame
from geo.transformation import lon_lat
from refract import FlatWater, PinholeCamera
from refract.lens import Lens, coefficients_of
from refract.surfaces import WaterSurface
from survey.photos.poses import CAM_FROM_OPK_CAM
from survey.settings.config import WaterConfig
from survey.simulate.conditions import RadianceFunction, Sensor
from survey.simulate.direct import DirectRenderer

_JPEG_QUALITY = 92
# When the first photograph is taken, where that matters, and the readings of the water.
_START = datetime(2024, 6, 1, 10, tzinfo=UTC)
GAUGE = "gauge.csv"


@dataclass(frozen=True)
class StagedScene:
    """A scene with its cameras and ground, ready to be rendered."""

    # name, crs: As survey.toml has them
    name: str
    crs: str
    frame: LocalFrame
    # Local, without the distortion of `lens`. Where their shutters roll (`PinholeCamera.motion`), `lens` has none;
    # where they have tides, the water is a plane.
    cameras: tuple[PinholeCamera, ...]
    lens: Lens  # Of all photographs
    level: WaterConfig | None  # Still water, for survey.toml
    # Exact in geometry: it computes the ground truth, whichever renderer takes the photographs
    renderer: DirectRenderer
    sensor: Sensor
    bounds: tuple[float, float, float, float]  # (e0, n0, e1, n1), in crs: what is evaluated
    seed: int
    # callable, optional: radiance along rays; by default that of `renderer`
    radiance_of: RadianceFunction | None = None
    velocities: np.ndarray | None = None  # (cameras, 3) [m/s], local, or None: for XMP; None writes none
    position_std_m: float = 0.02  # [m]: of the positions in EXIF, in each direction
    readout_s: float = 0.0  # [s]: of rolling shutters, for survey.toml; 0 where all rows are exposed at once
    # [nm] or None: of the light that the index of `level` belongs to, for survey.toml; None for that of the photographs
    index_wavelength_nm: float | None = None
    duration_s: float = 0.0  # [s]: from the first photograph to the last, for EXIF and a gauge; 0 writes neither

    @property
    def water(self) -> WaterSurface | None:
        """The surface of the water, local."""
        return self.renderer.water

    @property
    def names(self) -> list[str]:
        """File names of the photographs: JPEG, or PNG without loss where there is no noise."""
        suffix = ".jpg" if self.sensor.noise > 0.0 or self.sensor.is_jittered else ".png"
        return [f"{k:04d}{suffix}" for k in range(len(self.cameras))]

    def photograph(self, index: int) -> np.ndarray:
        """Image (height, width, 3) uint8 of one camera."""
        renderer, camera = self.at(index)
        radiance_of = self.radiance_of or renderer.radiance_of_rays
        return self.sensor.photograph(radiance_of, camera, self.lens, (self.seed, index))

    def at(self, index: int) -> tuple[DirectRenderer, PinholeCamera]:
        """The renderer with the water level at the time of a photograph, and the camera without its tide."""
        camera, water = self.cameras[index], self.renderer.water
        if camera.tide == 0.0 or not isinstance(water, FlatWater):
            return self.renderer, camera
        x, y, z = water.point
        own = replace(water, point=(x, y, z + camera.tide))
        return replace(self.renderer, water=own), replace(camera, tide=0.0)


def survey_toml(scene: StagedScene) -> str:
    """The text of survey.toml: the inputs of a reconstruction, without poses."""
    lens, level = scene.lens, scene.level
    fx, fy = lens.focal
    coefficients = [lens[name] for name in coefficients_of(lens.model)]
    bounds = ", ".join(f"{v:.3f}" for v in scene.bounds)
    lines: list[str | None] = [
        f"name = {json.dumps(scene.name, ensure_ascii=False)}",
        f'crs = "{scene.crs}"    # of cameras.csv, of truth/ and of every height here',
        "dry = true    # no ground is under water" if level is None else None,
        "",
        "[cameras]",
        'poses = "cameras.csv"    # easting, northing, height [m]; angles [deg] about the grid axes',
        f'model = "{lens.model}"',
        f"size_px = [{lens.width}, {lens.height}]",
        f"focal_px = {fx if fx == fy else [fx, fy]}",
        f"principal_point_px = [{lens['cx']}, {lens['cy']}]    # the centre of the first pixel is at 0.5, 0.5",
        f"rolling_shutter_s = {scene.readout_s}    # from the first to the last row" if scene.readout_s > 0.0 else None,
        f"distortion = {coefficients}" if coefficients else None,
        "",
    ]
    if level is not None:
        nm = scene.index_wavelength_nm
        lines += [
            "[water]",
            f"level_m = {level.level_m}    # height of the water surface, at the point below"
            if scene.duration_s == 0.0
            else f'gauge = "{GAUGE}"    # heights of the water surface, at the point below',
            f"level_at = {list(level.known_level_at)}    # easting, northing",
            f"slope_east = {level.slope_east}",
            f"slope_north = {level.slope_north}",
            f"refractive_index = {level.refractive_index}",
            None if nm is None else f"index_wavelength_nm = {nm}    # of the light that the index is of",
            "",
        ]
    lines += ["[area]", f"bounds = [{bounds}]    # easting and northing, low then high: what is evaluated", ""]
    return "\n".join(line for line in lines if line is not None)


def cameras_csv(names: Sequence[str], cameras: Sequence[PinholeCamera], frame: LocalFrame) -> str:
    """Poses in crs; omega, phi, kappa turn the grid axes: grid_from_camera = Rx(omega) Ry(phi) Rz(kappa)."""
    centres = frame.crs_from_local([camera.centre for camera in cameras])
    local_from_grid = frame.local_from_grid(centres)
    lines, digits = ["image,easting,northing,height,omega,phi,kappa"], 10 if is_geographic(frame.crs) else 6
    for name, camera, centre, axes in zip(names, cameras, centres, local_from_grid, strict=True):
        turn = Rotation.from_matrix(axes.T @ camera.cam_from_local.T @ CAM_FROM_OPK_CAM)
        numbers = [f"{v:.{digits}f}" for v in centre] + [f"{v:.9f}" for v in turn.as_euler("XYZ", degrees=True)]
        lines.append(",".join([name, *numbers]))
    return "\n".join([*lines, ""])


def exif_of_views(scene: StagedScene) -> list[Image.Exif]:
    """EXIF of all images: positions as the receiver knows them, heights in crs, and the focal length."""
    rng = np.random.default_rng([scene.seed, 5])
    centres = np.array([camera.centre for camera in scene.cameras])
    noise = scene.position_std_m * rng.standard_normal(centres.shape)
    places = scene.frame.crs_from_local(centres + noise)
    lon_lat_height = np.column_stack([lon_lat(scene.frame.crs, places[:, :2]), places[:, 2]]).tolist()
    film_mm = 36.0 * max(scene.lens.focal) / max(scene.lens.width, scene.lens.height)
    exifs = []
    for after, place in zip(np.linspace(0.0, scene.duration_s, len(places)).tolist(), lon_lat_height, strict=True):
        exif = Image.Exif()
        exif[ExifTags.Base.Make], exif[ExifTags.Base.Model] = "Simulated", f"{film_mm:.1f} mm"
        exif[ExifTags.IFD.Exif] = {ExifTags.Base.FocalLengthIn35mmFilm: round(film_mm)}
        gps = gps_exif(*place)
        if scene.duration_s > 0.0:
            time = _START + timedelta(seconds=after)
            second = IFDRational(1_000_000 * time.second + time.microsecond, 1_000_000)
            clock = (IFDRational(time.hour, 1), IFDRational(time.minute, 1), second)
            gps |= {ExifTags.GPS.GPSDateStamp: time.strftime("%Y:%m:%d"), ExifTags.GPS.GPSTimeStamp: clock}
        exif[ExifTags.IFD.GPSInfo] = gps
        exifs.append(exif)
    return exifs


def gauge_csv(scene: StagedScene) -> str:
    """Eleven readings of a gauge from the first photograph to the last, between which the water rises evenly."""
    assert scene.level is not None
    level_m = scene.level.known_level_m
    first, last = scene.cameras[0].tide, scene.cameras[-1].tide
    at = [(0.1 * i * scene.duration_s, level_m + first + 0.1 * i * (last - first)) for i in range(11)]
    rows = [f"{(_START + timedelta(seconds=s)).isoformat()},{level:.4f}" for s, level in at]
    return "\n".join(["time,level", *rows, ""])


def xmp_of_views(scene: StagedScene) -> list[str]:
    """XMP of all images with their speed, as DJI writes it: north, east, down, to 0.1 m/s; empty for a still scene."""
    if scene.velocities is None:
        return [""] * len(scene.cameras)
    form = (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        '<rdf:Description xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" drone-dji:FlightXSpeed="{:+.1f}" '
        'drone-dji:FlightYSpeed="{:+.1f}" drone-dji:FlightZSpeed="{:+.1f}"/></rdf:RDF></x:xmpmeta>'
    )
    return [form.format(north, east, -up) for east, north, up in scene.velocities.tolist()]


def gps_exif(lon: float, lat: float, height: float) -> dict:
    """The GPS part of EXIF, from degrees and metres."""

    def sexagesimal(angle: float) -> tuple[IFDRational, ...]:
        minutes, seconds = divmod(round(abs(angle) * 36e8), 6 * 10**7)
        degrees, minutes = divmod(minutes, 60)
        return IFDRational(degrees, 1), IFDRational(minutes, 1), IFDRational(seconds, 10**6)

    tag = ExifTags.GPS
    return {
        tag.GPSLatitudeRef: "N" if lat >= 0.0 else "S",
        tag.GPSLatitude: sexagesimal(lat),
        tag.GPSLongitudeRef: "E" if lon >= 0.0 else "W",
        tag.GPSLongitude: sexagesimal(lon),
        tag.GPSAltitudeRef: b"\x00" if height >= 0.0 else b"\x01",
        tag.GPSAltitude: IFDRational(round(abs(height) * 1000.0), 1000),
    }


def write_image(path: Path, image: np.ndarray, exif: Image.Exif, xmp: str = "") -> None:
    """Write an image (height, width, 3) uint8, whole or not at all; without loss where the name ends in .png."""
    picture = Image.fromarray(image)
    with write_whole(path) as stream:
        if path.suffix == ".png":
            texts = PngInfo()
            if xmp:
                texts.add_itxt("XML:com.adobe.xmp", xmp)
            picture.save(stream, "PNG", exif=exif, pnginfo=texts)
        else:
            picture.save(stream, "JPEG", quality=_JPEG_QUALITY, subsampling=0, exif=exif, xmp=xmp.encode())
