"""Does every damaged file end in a value or in one clear sentence?

    python benchmarks/soak_inputs.py [--seconds 60] [--seed 0] [--only las exif ...] [--out FOLDER]

Files of every kind that is read from outside are written whole (those of poses as tests write them), then damaged:
bytes are replaced, repeated, cut out and cut off, lines swapped, numbers replaced by what nobody can mean.
A reader may return, or raise SurveyError or GeoError; anything else, a warning of numpy, more than ten seconds or a
gigabyte, is printed with its seed and kept in FOLDER. Exits 1 if there was one.
"""

import argparse
import random
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import NamedTuple

import numpy as np
from PIL import ExifTags, Image
from pyproj import CRS

from geo.errors import GeoError
from geo.features import read_lines, read_polygons
from geo.las import write_cloud
from geo.reading import read_reference
from survey.control.reading import read_control
from survey.errors import SurveyError
from survey.folder.headers import with_positions
from survey.photos.exif import Exif, read_exif
from survey.photos.pixels import require_complete
from survey.pose_files import find_poses, read_poses, read_ties
from survey.settings.config import parse_config
from survey.simulate.sidecars import gps_exif
from survey.simulate.writing import write_ply
from survey.water.gauge_files import read_series
from survey.water.level_observation import points_of_surface
from survey.water.surface_features import points_of_features

UTM = CRS("EPSG:25832+7837")
# Corners of what lines and polygons are for.
AROUND = np.array([[0.0, 0.0], [1e7, 1e7]])
E0, N0, LEVEL = 676120.0, 5311480.0, 584.2
# What damages files: other kinds of values, ends of texts and blocks, numbers that nobody can mean.
PIECES = (
    b"", b"\0", b"nan", b"-inf", b"1e999", b"1e308", b"9" * 400, b";", b",", b"\t", b'"', b"'", b"<", b">", b"[", b"]",
    b"{", b"}", b"null", b"true", b"\xff\xfe", b"\xff\xff\xff\xff", b"\x7f\xff\xff\xff", b"\xc3\xa9", b"\n", b"\n\n",
    b"-1", b"0", b"=", b"#", b"../../etc/passwd", b"&a;", b"0001.jpg", b"EPSG:4326", b" ", b"\r",
)  # fmt: skip
MOST_S, MOST_BYTES = 10, 1 << 30
# Inputs between two lines of progress.
_EVERY = 50_000


class Kind(NamedTuple):
    """A kind of input: the name of its file, a whole one, and what reads it."""

    name: str
    whole: Callable[[Path], None]
    read: Callable[[Path], object]


class TooSlow(Exception):
    """A reader that took more than its seconds."""


def text(content: str) -> Callable[[Path], None]:
    return lambda path: path.write_text(content, encoding="utf-8")


SETTINGS = """name = "cove"
crs = "EPSG:25832+7837"
[cameras]
model = "OPENCV"
distortion = [0.0, 0.0, 0.0, 0.0]
size_px = [640, 480]
focal_px = 640.0
principal_point_px = [320.0, 240.0]
position_std_m = [0.02, 0.02, 0.03]
[water]
level_m = 240.585
level_at = [676120.0, 5311480.0]
slope_east = 0.0
refractive_index = 1.3272
level_std_m = 0.036
[control]
checkpoints = "checkpoints.csv"
gcps = "gcp_list.txt"
std_m = 0.01
[area]
bounds = [676111.404, 5311472.252, 676128.596, 5311487.748]
heights = [230, 241]
[report]
project = "a"
[process]
quality = "fine"
"""
GCP_LIST = f"EPSG:25832\n{E0} {N0} 584.9 10 20 0000.jpg p1\n{E0 + 4} {N0 - 3} 585.5 11 20 0001.jpg p2 extra\n"
TABLE = f"name,easting,northing,height,std\np1,{E0},{N0},584.9,0.02\np2,{E0 + 4},{N0},585.5,0.03\n"
MARKS = "image,name,x,y\n0000.jpg,p1,10.5,20.5\n0001.jpg,p2,11.5,20.5\n"
MARKERS = """<?xml version="1.0" encoding="UTF-8"?><document version="2.0.0"><chunk label="C"><cameras>
<camera id="7" sensor_id="0" label="0000"/></cameras><markers><marker id="3" label="p1">
<reference x="589012" y="5194736" z="2105" sx="0.02" enabled="true"/></marker></markers><frames><frame id="0"><markers>
<marker marker_id="3"><location camera_id="7" x="10.5" y="20.5"/></marker></markers></frame></frames>
<reference></reference></chunk></document>"""
OPENSFM = """{"points": [{"id": "p1", "position": {"latitude": 47.9, "longitude": 11.3, "altitude": 584.0},
"observations": [{"shot_id": "0000.jpg", "projection": [0.1, -0.2]}]}]}"""
GAUGE = "time,level\n2024-06-01T10:00:00+00:00,584.20\n2024-06-01 11:00:00Z,584.25\n"
SURFACE = (
    f"easting,northing,height,std\n{E0},{N0},584.2,0.01\n{E0 + 3},{N0 + 1},584.21,0.01\n{E0},{N0 + 5},584.2,0.01\n"
)
GEO_TXT = "EPSG:4326\n0000.jpg 11.3579 47.9324 584.0 0 0 0 0.02 0.03\n0001.jpg 11.3580 47.9325 584.0\n"
SHORE = """{"type": "FeatureCollection", "features": [{"type": "Feature", "properties": {"level": 584.2},
"geometry": {"type": "LineString", "coordinates": [[11.3579, 47.9324, 584.2], [11.358, 47.9325, 584.2],
[11.3581, 47.9326, 584.2]]}}]}"""
AREA = """{"type": "FeatureCollection", "crs": {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::25832"}},
"features": [{"type": "Feature", "properties": {"name": "a"}, "geometry": {"type": "Polygon", "coordinates":
[[[676110, 5311470], [676120, 5311470], [676120, 5311480], [676110, 5311470]]]}}]}"""
XYZ = "".join(f"{E0 + i % 5} {N0 + i // 5} {583 + 0.01 * i:.2f}\n" for i in range(25))
XMP = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    '<rdf:Description xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" drone-dji:RtkFlag="50" '
    'drone-dji:RtkStdLon="0.01" drone-dji:RtkStdLat="0.01" drone-dji:RtkStdHgt="0.02" drone-dji:AltitudeType="RtkAlt" '
    'drone-dji:GpsLatitude="47.9" drone-dji:GpsLongitude="11.3" drone-dji:AbsoluteAltitude="+584.1" '
    'drone-dji:FlightXSpeed="+1.0" drone-dji:FlightYSpeed="-0.5" drone-dji:GimbalPitchDegree="-89.9"/>'
    "</rdf:RDF></x:xmpmeta>"
)


def points() -> np.ndarray:
    plan = np.stack(np.meshgrid(np.arange(8.0), np.arange(6.0)), axis=-1).reshape(-1, 2)
    return np.column_stack([plan + np.array([E0, N0]), 583.0 + 0.01 * plan.sum(axis=1)])


def las(path: Path) -> None:
    cloud = points()
    n = len(cloud)
    write_cloud(
        path, cloud, UTM, rgb=np.full((n, 3), 100, np.uint8), depth_m=LEVEL - cloud[:, 2], std_m=np.full(n, 0.02),
        num_views=np.full(n, 5, np.uint8), incidence_deg=np.full(n, 10.0), is_wet=np.full(n, True),
    )  # fmt: skip


def ply(path: Path) -> None:
    write_ply(path, points(), faces=np.array([[0, 1, 8], [1, 9, 8]]))


def photograph(path: Path) -> None:
    exif = Image.Exif()
    exif[ExifTags.Base.Make], exif[ExifTags.Base.Model] = "DJI", "FC6310R"
    exif[ExifTags.IFD.Exif] = {ExifTags.Base.FocalLengthIn35mmFilm: 24, ExifTags.Base.DateTimeOriginal: "2024:06:01 10"}
    exif[ExifTags.IFD.GPSInfo] = gps_exif(11.3579, 47.9324, 584.2)
    shades = np.random.default_rng(0).integers(0, 255, (24, 32, 3), np.uint8)
    Image.fromarray(shades).save(path, "JPEG", exif=exif, xmp=XMP.encode())


def picture(kind: str) -> Callable[[Path], None]:
    shades = np.random.default_rng(0).integers(0, 255, (24, 32, 3), np.uint8)
    return lambda path: Image.fromarray(shades).save(path, kind)


def obj(path: Path) -> None:
    path.write_text("v 0 0 0\nv 1 0 0.5\nv 0 1 1\nf 1 2 3\n")


def look(path: Path) -> object:
    return read_exif(path), require_complete(path)


HEADS = {name: Exif((640, 480), None, 800.0, 1, "DJI", None) for name in ("0000.jpg", "0001.jpg")}
KINDS = {
    "settings": Kind("survey.toml", text(SETTINGS), lambda path: parse_config(path.read_text(errors="replace"))),
    "gcp list": Kind("gcp_list.txt", text(GCP_LIST), read_control),
    "points": Kind("gcps.csv", text(TABLE), read_control),
    "marks": Kind("marks.csv", text(MARKS), read_control),
    "markers": Kind("markers.xml", text(MARKERS), read_control),
    "opensfm": Kind("ground_control_points.json", text(OPENSFM), read_control),
    "gauge": Kind("gauge.csv", text(GAUGE), read_series),
    "surface": Kind("surface.csv", text(SURFACE), lambda path: points_of_surface(path, "gnss_points", UTM)),
    "shore": Kind("shore.geojson", text(SHORE), lambda path: points_of_features(path, UTM)),
    "lines": Kind("lines.geojson", text(SHORE), lambda path: read_lines(path, UTM, AROUND)),
    "area": Kind("area.geojson", text(AREA), lambda path: read_polygons(path, UTM, AROUND)),
    "geo.txt": Kind("geo.txt", text(GEO_TXT), lambda path: with_positions(path, HEADS)),
    "las": Kind("cloud.las", las, read_reference),
    "laz": Kind("cloud.laz", las, read_reference),
    "ply": Kind("mesh.ply", ply, read_reference),
    "obj": Kind("mesh.obj", obj, read_reference),
    "photograph": Kind("0000.jpg", photograph, look),
    "PNG": Kind("0000.png", picture("PNG"), look),
    "TIFF": Kind("0000.tif", picture("TIFF"), look),
    "WebP": Kind("0000.webp", picture("WEBP"), look),
}


def poses_kinds(folder: Path) -> dict[str, Kind]:
    """A kind for each file of each format of poses, the others of its format beside it."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
    from whole_pose_files import whole_pose_files

    return {
        f"{form} {name}": poses_kind(name, files, given)
        for form, (files, given) in whole_pose_files(folder).items()
        for name in files
    }


def poses_kind(name: str, files: dict[str, bytes], given: str) -> Kind:
    def write(path: Path) -> None:
        for file, content in files.items():
            (path.parent / file).write_bytes(content)

    def read(path: Path) -> object:
        return find_poses(path.parent), read_poses(path.parent / given), read_ties(path.parent / given)

    return Kind(name, write, read)


def damaged(whole: bytes, dice: random.Random) -> bytes:
    """A file with one to four faults."""
    data = bytearray(whole)
    for _ in range(dice.choice((1, 1, 1, 2, 3, 4))):
        at = dice.randrange(len(data) + 1)
        fault = dice.randrange(7)
        if fault == 0:
            data[at : at + dice.choice((0, 1, 4, 8, 40))] = dice.choice(PIECES)
        elif fault == 1 and data:
            data[at % len(data)] = dice.randrange(256)
        elif fault == 2:
            data[at:at] = data[at : at + dice.choice((1, 8, 64))]
        elif fault == 3:
            del data[at : at + dice.choice((1, 4, 16, 256))]
        elif fault == 4 and dice.random() < 0.3:
            del data[at:]
        elif fault == 5:
            numbers = list(re.finditer(rb"[-+]?\d+\.?\d*", bytes(data[:20_000])))
            if numbers:
                one = dice.choice(numbers)
                data[one.start() : one.end()] = dice.choice(PIECES)
        elif fault == 6:
            lines = bytes(data).split(b"\n")
            first, other = dice.randrange(len(lines)), dice.randrange(len(lines))
            lines[first], lines[other] = lines[other], lines[first]
            data = bytearray(b"\n".join(lines))
    return bytes(data)


def fault_in(kind: Kind, path: Path) -> str | None:
    """What a reader ends in that is neither a value nor a sentence; None where it is one of these."""
    try:
        # Of processor time: a busy machine is no fault.
        signal.setitimer(signal.ITIMER_PROF, MOST_S)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                kind.read(path)
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0.0)
    except (SurveyError, GeoError) as error:
        return None if str(error).strip() else "an error without a sentence"
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        return traceback.format_exc()
    return None


def _too_slow(_signal: int, _frame: FrameType | None) -> None:
    raise TooSlow(f"took more than {MOST_S} s")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0, help="of processor time")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="*")
    parser.add_argument("--out", type=Path, default=Path("build/soak"))
    given = parser.parse_args()
    signal.signal(signal.SIGPROF, _too_slow)
    resource.setrlimit(resource.RLIMIT_AS, (8 * MOST_BYTES, resource.getrlimit(resource.RLIMIT_AS)[1]))
    found: dict[str, str] = {}
    with tempfile.TemporaryDirectory() as work:
        kinds = KINDS | poses_kinds(Path(tempfile.mkdtemp(dir=work)))
        only = given.only or list(kinds)
        whole, counts = {}, dict.fromkeys(only, 0)
        for name in only:
            folder = Path(work, name)
            folder.mkdir()
            kinds[name].whole(folder / kinds[name].name)
            whole[name] = (folder / kinds[name].name).read_bytes()
            if (first := fault_in(kinds[name], folder / kinds[name].name)) is not None:
                raise SystemExit(f"the whole file of {name} is not read: {first}")
        seed = given.seed
        while time.process_time() < given.seconds:
            name = only[seed % len(only)]
            path = Path(work, name, kinds[name].name)
            path.write_bytes(damaged(whole[name], random.Random(seed)))
            fault = fault_in(kinds[name], path)
            counts[name] += 1
            if fault is not None:
                # The same line of code is the same fault.
                where = re.findall(r'File "([^"]+)", line (\d+)', fault)[-1:]
                key = f"{name} {where} {fault.strip().splitlines()[-1][:60]}"
                if key not in found:
                    found[key] = fault
                    given.out.mkdir(parents=True, exist_ok=True)
                    shutil.copy(path, given.out / f"{seed}-{path.name}")
                    sys.stdout.write(f"seed {seed}, {name}:\n{fault}\n")
            seed += 1
            if (seed - given.seed) % _EVERY == 0:
                sys.stdout.write(f"{seed - given.seed} inputs, {len(found)} faults\n")
                sys.stdout.flush()
    sys.stdout.write(f"{sum(counts.values())} inputs, {len(found)} faults: {counts}\n")
    return min(len(found), 1)


if __name__ == "__main__":
    sys.exit(main())
