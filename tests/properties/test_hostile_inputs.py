"""Files of hostile hands: every reader of heads, levels and masks ends in one clear error, or reads what there is."""

import io
import json
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from small_survey import LEVEL, replaced, small_survey

from geo.crs import parse_crs
from geo.errors import GeoError
from survey.errors import ConfigError, ImageError, SurveyError
from survey.folder.survey import load_survey
from survey.photos.exif import read_exif
from survey.photos.images import read_mask
from survey.photos.pixels import read_rgb, require_complete
from survey.photos.xmp import height_datum, motion_of, rtk_of, stated_std, xmp_number
from survey.water.gauge_files import read_series
from survey.water.level_observation import points_of_surface
from survey.water.surface_features import points_of_features

FUZZ = settings(max_examples=60)
CRS = parse_crs("EPSG:25832+5778")
LONG = 400


def encoded(kind: str, **options) -> bytes:
    pixels = np.random.default_rng(3).integers(0, 255, (12, 16, 3), dtype=np.uint8)
    exif = Image.Exif()
    exif[271] = "maker"
    exif.get_ifd(0x8825).update({1: "N", 2: (46.5, 0.0, 0.0), 3: "E", 4: (10.25, 0.0, 0.0), 5: b"\0", 6: 2.5})
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, kind, exif=exif, **options)
    return buffer.getvalue()


SAMPLES = {
    ".jpg": encoded("JPEG", xmp=b'<x drone-dji:RelativeAltitude="+20.1" Camera:Yaw="1/2"/>'),
    ".png": encoded("PNG"),
    ".tif": encoded("TIFF"),
    ".webp": encoded("WEBP", lossless=True),
}
# Where to write what into a file, and where to cut it.
damage = st.tuples(
    st.lists(st.tuples(st.integers(0, 700), st.binary(min_size=1, max_size=6)), max_size=6),
    st.one_of(st.none(), st.integers(0, 900)),
)


def damaged(data: bytes, changes, cut) -> bytes:
    found = bytearray(data)
    for at, new in changes:
        found[at % len(found) : at % len(found) + len(new)] = new
    return bytes(found[:cut])


def require_one_line(error: Exception) -> None:
    text = str(error)
    assert text
    assert len(text) < 2000
    assert "\n" not in text.strip()


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("hostile")


# Pillow warns of damaged tags again when it decodes.
@pytest.mark.filterwarnings("ignore::UserWarning:PIL")
@FUZZ
@given(st.sampled_from(sorted(SAMPLES)), damage)
def test_a_damaged_photograph_is_read_or_refused(folder, suffix, how):
    path = folder / f"a{suffix}"
    path.write_bytes(damaged(SAMPLES[suffix], *how))
    for read in (read_exif, require_complete, read_rgb, read_mask):
        try:
            read(path)
        except (ImageError, GeoError) as error:
            require_one_line(error)


@FUZZ
@given(st.text(max_size=LONG) | st.binary(max_size=LONG).map(lambda data: data.decode("latin-1")))
def test_any_text_is_xmp_that_says_something_or_nothing(text):
    names = ("RtkFlag", "RtkStdLon", "GimbalYawDegree", "AltitudeType", "GPSXYAccuracy", "RelativeAltitude")
    for name in names:
        for xmp in (f'drone-dji:{name}="{text}"', f"<Camera:{name}>{text}</Camera:{name}>", f"{name}{text}"):
            rtk_of(xmp), motion_of(xmp), stated_std(xmp), height_datum(xmp), xmp_number(xmp, name)


def test_xmp_of_a_megabyte_takes_no_time_and_entities_are_only_text(tmp_path):
    bomb = "".join(f'<!ENTITY lol{i} "{f"&lol{i - 1};" * 10}">' for i in range(1, 10))
    xmp = f"<!DOCTYPE x [{bomb}]>" + "drone-dji:RelativeAltitude" * 40_000 + ' drone-dji:GimbalYawDegree = "&lol9;"'
    assert motion_of(xmp).gimbal_deg is None
    assert xmp_number(xmp, "RelativeAltitude") is None
    assert xmp_number("drone-dji:RelativeAltitude" + " " * 1_000_000 + '="1"', "RelativeAltitude") is None


def exif_segment(entries: list[tuple[int, int, int, bytes]]) -> bytes:
    """A JPEG with an IFD of GPS of one's own making: tag, type, count, value or its offset."""
    head = b"II*\0\x08\0\0\0"
    main = struct.pack("<H", 1) + struct.pack("<HHII", 0x8825, 4, 1, 26) + b"\0\0\0\0"
    gps = struct.pack("<H", len(entries))
    gps += b"".join(
        struct.pack("<HHI", tag, kind, count) + value[:4].ljust(4, b"\0") for tag, kind, count, value in entries
    )
    block = b"Exif\0\0" + head + main + gps + b"\0\0\0\0" + bytes(64)
    jpeg = SAMPLES[".jpg"]
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(block) + 2) + block + jpeg[2:]


@FUZZ
@given(
    st.lists(
        st.tuples(
            st.sampled_from([1, 2, 3, 4, 5, 6, 7, 29, 31]),
            st.integers(0, 13),
            st.sampled_from([0, 1, 2, 3, 300, 2**31, 2**32 - 1]),
            st.binary(min_size=4, max_size=4),
        ),
        max_size=5,
    )
)
def test_positions_of_any_making_are_read_or_left_out(folder, entries):
    path = folder / "gps.jpg"
    path.write_bytes(exif_segment(entries))
    head = read_exif(path)
    assert head.size_px == (16, 12)
    if head.lat_lon_height is not None:
        assert abs(head.lat_lon_height[0]) <= 90.0
        assert abs(head.lat_lon_height[1]) <= 180.0


def test_degrees_of_a_thousand_parts_and_hours_without_end_are_no_position_and_no_time(tmp_path):
    exif = Image.Exif()
    exif.get_ifd(0x8825).update(
        {1: "N", 2: (1.0,) * 500, 3: "E", 4: (1.0,) * 500, 7: (4e9, 0.0, 0.0), 29: "2024:06:01"}
    )
    Image.new("RGB", (8, 8)).save(tmp_path / "a.jpg", exif=exif)
    head = read_exif(tmp_path / "a.jpg")
    assert head.lat_lon_height[:2] == pytest.approx((1.0 + 1 / 60 + 1 / 3600,) * 2)
    assert head.taken is None


def test_names_of_cameras_obey_no_terminal(tmp_path):
    exif = Image.Exif()
    exif[271], exif[272] = "evil\x1b[2J\x07", "x" * 10_000
    Image.new("RGB", (8, 8)).save(tmp_path / "a.jpg", exif=exif)
    camera = read_exif(tmp_path / "a.jpg").camera
    assert camera.isprintable()
    assert len(camera) < 130


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(
            st.sampled_from(
                ["type", "features", "geometry", "geometries", "coordinates", "properties", "crs", "level", "name"]
            ),
            inner | st.sampled_from(["Feature", "FeatureCollection", "Point", "Polygon", "LineString", "EPSG:25832"]),
            max_size=5,
        )
    ),
    max_leaves=12,
)


@FUZZ
@given(json_values | st.binary(max_size=60))
def test_any_json_is_a_shoreline_or_refused(folder, content):
    path = folder / "shore.geojson"
    path.write_bytes(content if isinstance(content, bytes) else json.dumps(content).encode())
    try:
        points, _ = points_of_features(path, CRS)
        assert np.isfinite(points).all()
    except ConfigError as error:
        require_one_line(error)


@FUZZ
@given(
    st.text(alphabet='0123456789.,;-+eE:TZ\t\n"# aé\0', max_size=LONG),
    st.sampled_from(["time,level", "easting,northing,height,std"]),
)
def test_any_table_is_a_level_or_refused(folder, text, title):
    path = folder / "level.csv"
    path.write_text(f"{title}\n{text}\n", encoding="utf-8")
    read = read_series if title.startswith("time") else lambda table: points_of_surface(table, "shoreline", CRS)[0]
    try:
        for each in read(path):
            assert np.isfinite(each.level_m)
            assert each.std_m > 0.0
    except ConfigError as error:
        require_one_line(error)


@pytest.mark.parametrize(
    "name", ["../../etc/passwd", "/etc/passwd", "..\\..\\x.jpg", "a" * 5000, "\0", "x\x1b[2J", "con:"]
)
def test_names_in_clicks_reach_no_other_file(tmp_path, name):
    folder = small_survey(tmp_path / "s", toml=replaced((f"level_m = {LEVEL}", 'clicks = "clicks.csv"')))
    quoted = '"' + name.replace('"', '""') + '"'
    (folder / "clicks.csv").write_text(f"image,x,y,name\n{quoted},1,1,a\n0000.jpg,1,1,a\n", encoding="utf-8")
    with pytest.raises(SurveyError) as refused:
        load_survey(folder)
    require_one_line(refused.value)


def test_an_archive_is_no_photograph(tmp_path):
    path = tmp_path / "a.jpg"
    path.write_bytes(b"PK\x03\x04" + bytes(200))
    with pytest.raises(ImageError, match=r"a\.jpg is not an image that can be read"):
        read_exif(path)


def test_a_png_whose_text_unpacks_to_gigabytes_is_refused_or_read_without_it(tmp_path):
    text = zlib.compress(bytes(50_000_000), 9)
    chunk = b"zTXtComment\0\0" + text
    body = struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk))
    path = tmp_path / "a.png"
    path.write_bytes(SAMPLES[".png"][:33] + body + SAMPLES[".png"][33:])
    try:
        assert read_exif(path).size_px == (16, 12)
    except ImageError as error:
        require_one_line(error)
