"""What goes with the photographs of a drawn survey: survey.toml, cameras.csv and EXIF."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational
from pyproj import Transformer

from geo.crs import horizontal_crs
from survey.drawn.drawing import Drawing

_JPEG_QUALITY = 92
_GPS_STD_M = 0.02
# The photogrammetric camera has y up and z back.
_FLIP = np.diag([1.0, -1.0, -1.0])


def survey_toml(drawing: Drawing) -> str:
    """The text of survey.toml: all that a reconstruction may know beside the poses."""
    scene = drawing.scene
    width, height = scene.image_px
    lines = [
        'name = "drawn"',
        f'crs = "{scene.crs}"    # of cameras.csv, of truth/ and of every height here',
        "",
        "[cameras]",
        'poses = "cameras.csv"    # easting, northing, height [m]; angles [deg] about the grid axes',
        'model = "PINHOLE"',
        f"size_px = [{width}, {height}]",
        f"focal_px = {scene.focal_px}",
        f"principal_point_px = [{width / 2}, {height / 2}]    # the centre of the first pixel is at 0.5, 0.5",
        "",
    ]
    if scene.water:
        lines += [
            "[water]",
            f"level_m = {scene.level_m}    # height of the water surface, at the point below",
            f"level_at = [{scene.origin[0]}, {scene.origin[1]}]    # easting, northing",
            f"slope_east = {scene.slope_east}",
            f"slope_north = {scene.slope_north}",
            f"refractive_index = {scene.n_water}",
            "",
        ]
    bounds = ", ".join(f"{v:.3f}" for v in drawing.bounds)
    lines += [
        "[area]",
        f"bounds = [{bounds}]    # easting and northing, low then high: what is evaluated",
        "",
    ]
    return "\n".join(lines)


def cameras_csv(drawing: Drawing) -> str:
    """Poses in crs; omega, phi, kappa turn the grid axes: grid_from_camera = Rx(omega) Ry(phi) Rz(kappa)."""
    centres = drawing.frame.crs_from_local([camera.centre for camera in drawing.cameras])
    local_from_grid = drawing.frame.local_from_grid(centres)
    lines = ["image,easting,northing,height,omega,phi,kappa"]
    for name, camera, centre, axes in zip(drawing.names, drawing.cameras, centres, local_from_grid, strict=True):
        r = axes.T @ camera.cam_from_local.T @ _FLIP
        angles = (math.atan2(-r[1, 2], r[2, 2]), math.asin(r[0, 2]), math.atan2(-r[0, 1], r[0, 0]))
        numbers = [f"{v:.6f}" for v in centre] + [f"{math.degrees(v):.9f}" for v in angles]
        lines.append(",".join([name, *numbers]))
    return "\n".join([*lines, ""])


def exif_of_views(drawing: Drawing) -> list[Image.Exif]:
    """EXIF of all images: positions as a good receiver knows them, heights in crs, and the focal length."""
    rng = np.random.default_rng([drawing.scene.seed, 5])
    centres = np.array([camera.centre for camera in drawing.cameras])
    e, n, heights = drawing.frame.crs_from_local(centres + _GPS_STD_M * rng.standard_normal(centres.shape)).T
    lon, lat = Transformer.from_crs(horizontal_crs(drawing.frame.crs), "EPSG:4326", always_xy=True).transform(e, n)
    film_mm = 36.0 * drawing.scene.focal_px / max(drawing.scene.image_px)
    exifs = []
    for values in zip(lon, lat, heights, strict=True):
        exif = Image.Exif()
        exif[ExifTags.Base.Make], exif[ExifTags.Base.Model] = "Drawn", f"{film_mm:.1f} mm"
        exif[ExifTags.IFD.Exif] = {ExifTags.Base.FocalLengthIn35mmFilm: round(film_mm)}
        exif[ExifTags.IFD.GPSInfo] = _gps(*(float(v) for v in values))
        exifs.append(exif)
    return exifs


def _gps(lon: float, lat: float, height: float) -> dict:
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


def save_image(path: Path, image: np.ndarray, exif: Image.Exif) -> None:
    """Write an image (height, width, 3) uint8, without loss where the name ends in .png."""
    picture = Image.fromarray(image)
    if path.suffix == ".png":
        picture.save(path, exif=exif)
    else:
        picture.save(path, quality=_JPEG_QUALITY, subsampling=0, exif=exif)
