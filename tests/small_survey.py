"""A survey folder of a few tiny images, whole and correct, for tests to spoil."""

from pathlib import Path

import numpy as np
from PIL import ExifTags, Image
from pyproj import Transformer

CRS = "EPSG:25832+5778"
E0, N0, LEVEL = 589012.0, 5194736.0, 2105.0
SIZE = (64, 48)
FOCAL = 100.0

TOML = f"""
name = "small"
crs = "{CRS}"
[cameras]
poses = "cameras.csv"
model = "PINHOLE"
size_px = [64, 48]
focal_px = {FOCAL}
principal_point_px = [32.0, 24.0]
[water]
level_m = {LEVEL}
level_at = [{E0}, {N0}]
refractive_index = 1.333
"""

# Tags that stand in the part of EXIF about the exposure begin with these.
_OF_EXPOSURE = ("Focal", "Exposure", "DateTimeOriginal", "OffsetTimeOriginal")

HEADER = "image,easting,northing,height,omega,phi,kappa"


def camera_lines(num: int = 4) -> list[str]:
    """Lines of cameras.csv: nadir views 20 m over the water, 3 m apart."""
    return [f"{i:04d}.jpg,{E0 + 3 * i:.3f},{N0 - 2 * i:.3f},{LEVEL + 20:.3f},0,0,{10 * i}" for i in range(num)]


def write_image(path: Path, *, size=SIZE, gps: tuple[float, float, float] | None = None, **exif) -> None:
    """A noisy JPEG, with a GPS position in crs and EXIF tags by name where they are given."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.random.default_rng(5).integers(0, 255, (size[1], size[0], 3), dtype=np.uint8)
    image = Image.fromarray(pixels)
    tags = image.getexif()
    for name, value in exif.items():
        tag = ExifTags.Base[name]
        (tags.get_ifd(ExifTags.IFD.Exif) if name.startswith(_OF_EXPOSURE) else tags)[tag] = value
    if gps is not None:
        lon, lat = Transformer.from_crs("EPSG:25832", "EPSG:4326", always_xy=True).transform(*gps[:2])
        position = tags.get_ifd(ExifTags.IFD.GPSInfo)
        position[ExifTags.GPS.GPSLatitudeRef], position[ExifTags.GPS.GPSLongitudeRef] = "N", "E"
        position[ExifTags.GPS.GPSLatitude], position[ExifTags.GPS.GPSLongitude] = _dms(lat), _dms(lon)
        position[ExifTags.GPS.GPSAltitudeRef], position[ExifTags.GPS.GPSAltitude] = b"\0", gps[2]
    image.save(path, quality=90, exif=tags, comment=path.name)


def _dms(degrees: float) -> tuple[float, float, float]:
    minutes, seconds = divmod(degrees * 3600.0, 60.0)
    whole, minutes = divmod(minutes, 60.0)
    return whole, minutes, round(seconds, 7)


def small_survey(folder: Path, *, num: int = 4, toml: str | None = TOML, gps: bool = False) -> Path:
    """Write a survey folder that loads without a warning; returns it.

    The positions in EXIF leave the line of the cameras by 1 m to either side: on one line they could not place a block.
    """
    folder.mkdir(parents=True, exist_ok=True)
    lines = camera_lines(num)
    (folder / "cameras.csv").write_text("\n".join([HEADER, *lines]) + "\n")
    for i, line in enumerate(lines):
        name, e, n, h, *_ = line.split(",")
        aside = 1.0 - 2.0 * (i % 2)
        write_image(folder / "images" / name, gps=(float(e) + aside, float(n) + aside, float(h)) if gps else None)
    if toml is not None:
        (folder / "survey.toml").write_text(toml)
    return folder


def write_poses(folder: Path, lines: list[str]) -> None:
    """Put other lines into cameras.csv."""
    (folder / "cameras.csv").write_text("\n".join([HEADER, *lines]) + "\n")


def replaced(*pairs: tuple[str, str]) -> str:
    """The settings of `small_survey` with some words replaced, each of which has to be there."""
    text = TOML
    for old, new in pairs:
        if old not in text:
            raise ValueError(f"{old!r} is not in the settings of the small survey")
        text = text.replace(old, new)
    return text


def unposed(folder: Path, *pairs: tuple[str, str]) -> Path:
    """The small survey without poses, its settings replaced as by `replaced`: one for structure from motion."""
    folder = small_survey(folder, gps=True, toml=replaced(('poses = "cameras.csv"', ""), *pairs))
    (folder / "cameras.csv").unlink()
    return folder


def rows_of(sections, title: str) -> dict[str, str]:
    """The rows of the section of a title that `check` prints."""
    (section,) = [section for section in sections if section.title == title]
    return dict(section.rows)
