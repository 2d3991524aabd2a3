"""One position, height and time in all of the legal forms that EXIF and XMP have for them."""

import math
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from itertools import product

import pytest
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational

from survey.folder.headers import header_warnings
from survey.photos.exif import read_exif, without_void_fixes
from survey.photos.exif_values import altitude_reference, focal_px, focal_warning, position_of_gps
from survey.photos.xmp import height_datum, rtk_of, xmp_place
from survey.settings.config import SurveyConfig

GPS, NOTHING = ExifTags.GPS, SurveyConfig()
LAT, LON = -33.8567844, -151.2152967
XMP = (
    "<x:xmpmeta xmlns:x={q}adobe:ns:meta/{q}><rdf:RDF><rdf:Description drone-dji:GpsLatitude={q}-33.85678441{q} "
    "drone-dji:GpsLongitude={q}-151.21529672{q} drone-dji:AbsoluteAltitude={q}+12.50{q} drone-dji:RtkFlag={q}50{q} "
    "drone-dji:RtkStdLon={q}0.01{q} drone-dji:RtkStdLat={q}0.02{q} drone-dji:RtkStdHgt={q}0.03{q} "
    "drone-dji:AltitudeType={q}RtkAlt{q}/></rdf:RDF></x:xmpmeta>"
)


def dms(degrees: float, denominator: int = 100_000) -> tuple:
    whole, rest = divmod(abs(degrees) * 3600.0, 3600.0)
    minutes, seconds = divmod(rest, 60.0)
    return IFDRational(int(whole)), IFDRational(int(minutes)), IFDRational(round(seconds * denominator), denominator)


def decimal(degrees: float) -> tuple:
    return IFDRational(round(abs(degrees) * 10**7), 10**7), IFDRational(0), IFDRational(0)


def minutes(degrees: float) -> tuple:
    whole, rest = divmod(abs(degrees) * 60.0, 60.0)
    return IFDRational(int(whole)), IFDRational(round(rest * 10**6), 10**6), IFDRational(0)


def gps_of(form=dms, letters=("S", "W"), **places) -> dict:
    latitude, longitude = places.get("lat", LAT), places.get("lon", LON)
    return {
        GPS.GPSLatitude: form(latitude), GPS.GPSLatitudeRef: letters[0],
        GPS.GPSLongitude: form(longitude), GPS.GPSLongitudeRef: letters[1],
    }  # fmt: skip


@pytest.fixture
def head(tmp_path):
    def read(gps=None, details=None, xmp=None):
        exif, path = Image.Exif(), tmp_path / "a.jpg"
        if gps:
            exif.get_ifd(ExifTags.IFD.GPSInfo).update(gps)
        if details:
            exif.get_ifd(ExifTags.IFD.Exif).update(details)
        Image.new("RGB", (64, 48)).save(path, exif=exif, **({"xmp": xmp.encode()} if xmp else {}))
        return read_exif(path)

    return read


@pytest.mark.parametrize(
    ("form", "letters"),
    list(
        product([dms, decimal, minutes], [("S", "W"), ("s", "w"), ("South", "West"), ("SOUTH", "WEST"), ("S\0", "W ")])
    ),
)
def test_one_position_in_all_its_forms(head, form, letters):
    latitude, longitude, height = head(gps_of(form, letters)).lat_lon_height
    # A hundred-thousandth of a second is 0.3 mm, a ten-millionth of a degree a centimetre.
    assert latitude == pytest.approx(LAT, abs=1e-7)
    assert longitude == pytest.approx(LON, abs=1e-7)
    assert math.isnan(height)


@pytest.mark.parametrize("missing", [GPS.GPSLatitudeRef, GPS.GPSLongitudeRef])
@pytest.mark.parametrize("value", [None, "?"])
def test_a_position_without_its_hemisphere_is_none_and_that_is_said(head, missing, value):
    gps = {tag: each for tag, each in gps_of().items() if tag != missing} | ({} if value is None else {missing: value})
    found = head(gps)
    assert found.lat_lon_height is None
    (warning,) = header_warnings(NOTHING, {"a.jpg": found})
    assert "'s reference (" in warning
    assert head(gps, xmp=XMP.format(q='"')).lat_lon_height == (-33.85678441, -151.21529672, 12.5)


@pytest.mark.parametrize(
    ("reference", "altitude", "height", "datum"),
    [
        (b"\x00", 12.5, 12.5, None), (b"\x01", 12.5, -12.5, None), (b"\x02", 12.5, 12.5, "mean sea level"),
        (b"\x03", 12.5, -12.5, "mean sea level"), (b"1", 12.5, -12.5, None), (b"3", 12.5, -12.5, "mean sea level"),
        (b"0", 12.5, 12.5, None), (None, 12.5, 12.5, None), (b"\x01\x00", 12.5, -12.5, None),
        (b"\x00\x00", 12.5, 12.5, None), (b"\x03\0\0\0", 12.5, -12.5, "mean sea level"), (b"1\0", 12.5, -12.5, None),
        (b"\x01", 4294967295.0, math.nan, None), (1, 12.5, -12.5, None),
    ],
)  # fmt: skip
def test_one_height_in_all_its_forms(head, reference, altitude, height, datum):
    gps = gps_of() | {GPS.GPSAltitude: IFDRational(round(10 * altitude), 10)}
    found = head(gps | ({} if reference is None else {GPS.GPSAltitudeRef: reference}))
    assert found.lat_lon_height[2] == pytest.approx(height, nan_ok=True)
    assert found.height_datum == datum


@pytest.mark.parametrize("date", [None, "2024:06:01", "0000:00:00", "unset", "2024-06-01"])
def test_a_clock_that_is_not_set_hides_no_other(head, date):
    gps = {GPS.GPSTimeStamp: (IFDRational(8), IFDRational(30), IFDRational(0))}
    gps |= {} if date is None else {GPS.GPSDateStamp: date}
    base = ExifTags.Base
    details = {base.DateTimeOriginal: "2024:06:01 10:30:00", base.OffsetTimeOriginal: "+02:00"}
    assert head(gps, details).taken == datetime(2024, 6, 1, 8, 30, tzinfo=UTC)


@pytest.mark.parametrize("details", [{}, {ExifTags.Base.DateTimeOriginal: "2024:06:01 10:30:00"}])
@pytest.mark.parametrize(
    ("text", "seconds"),
    [
        ("2024-06-01T08:30:00.5", 0.5), ("2024:06:01 08:30:00.500000", 0.5), ("2024-06-01T08:30:01Z", 1.0),
        ("2024-06-01 08:30:00.1234567+00:00", 0.123456), ("0", None), ("", None), ("2024-13-01T08:30:00", None),
    ],
)  # fmt: skip
def test_the_utc_of_the_exposure_in_xmp_is_the_time_of_a_photograph(head, text, seconds, details):
    right = None if seconds is None else datetime(2024, 6, 1, 8, 30, tzinfo=UTC) + timedelta(seconds=seconds)
    assert head({}, details, f'<x drone-dji:UTCAtExposure="{text}"/>').taken == right


LOCAL, EARLIER = "2024:06:01 10:30:00", "2024:06:01 10:29:00"
BASE = ExifTags.Base


@pytest.mark.parametrize("offset", ["+02:00", "+02:00\0", " +02:00", "+0200"])
@pytest.mark.parametrize(
    "details",
    [
        {BASE.OffsetTimeOriginal: "{}"},
        {BASE.OffsetTimeDigitized: "{}"},
        {BASE.OffsetTime: "{}"},
        {BASE.OffsetTimeDigitized: "{}", BASE.DateTimeDigitized: LOCAL},
        # The standard writes blanks where a camera does not know its zone.
        {BASE.OffsetTimeOriginal: "   :  ", BASE.OffsetTime: "{}"},
        {BASE.OffsetTimeOriginal: "{}", BASE.OffsetTime: "-05:00"},
        # Digitised, or changed, by a computer elsewhere.
        {BASE.DateTimeDigitized: EARLIER, BASE.OffsetTimeDigitized: "-05:00", BASE.OffsetTime: "{}"},
        {BASE.TimeZoneOffset: 2},
        {BASE.TimeZoneOffset: (2, -5)},
        {BASE.TimeZoneOffset: 99, BASE.OffsetTimeOriginal: "{}"},
    ],
)
def test_the_offset_of_the_clock_in_all_tags_that_exif_has_for_it(head, details, offset):
    of = {tag: value.format(offset) if isinstance(value, str) else value for tag, value in details.items()}
    assert head({}, {BASE.DateTimeOriginal: LOCAL} | of).taken == datetime(2024, 6, 1, 8, 30, tzinfo=UTC)


@pytest.mark.parametrize(
    "details",
    [{}, {BASE.OffsetTimeOriginal: "unset"}, {BASE.OffsetTimeDigitized: "+02:00", BASE.DateTimeDigitized: EARLIER},
     {BASE.TimeZoneOffset: 99}, {BASE.TimeZoneOffset: "two"}],
)  # fmt: skip
def test_an_offset_that_says_nothing_of_the_exposure_is_none(head, details):
    assert head({}, {BASE.DateTimeOriginal: LOCAL} | details).taken is None


@pytest.mark.parametrize("quote", ['"', "'"])
def test_xmp_in_both_quotes(quote):
    text = XMP.format(q=quote)
    assert rtk_of(text).std_m == (0.01, 0.02, 0.03)
    assert height_datum(text) == "ellipsoidal"
    place, step_deg = xmp_place(text)
    assert place[0] == -33.85678441
    assert step_deg == 1e-8


@pytest.mark.parametrize("denominator", [1, 10, 1000])
def test_a_position_with_more_digits_in_xmp_is_taken_from_there(head, denominator):
    gps = gps_of(lambda degrees: dms(degrees, denominator))
    near = head(gps, xmp=XMP.format(q='"'))
    assert near.lat_lon_height[:2] == (
        (-33.85678441, -151.21529672) if denominator > 1 else head(gps).lat_lon_height[:2]
    )
    coarse = XMP.format(q='"').replace("33.85678441", "33.86").replace("151.21529672", "151.22")
    assert head(gps, xmp=coarse).lat_lon_height[:2] == head(gps).lat_lon_height[:2]


def test_a_position_in_xmp_of_another_place_is_not_taken(head):
    gps = gps_of(lambda degrees: dms(degrees, 10), lat=LAT + 0.01)
    assert head(gps, xmp=XMP.format(q='"')).lat_lon_height[0] == pytest.approx(LAT + 0.01, abs=2e-5)


def calibration(focal: float, centre: float | None = None) -> str:
    at = "" if centre is None else f'drone-dji:CalibratedOpticalCenterX="{centre}" '
    return f'<a drone-dji:CalibratedFocalLength="{focal}" {at}/>'


@pytest.mark.parametrize(
    ("film", "xmp", "expected", "words"),
    [
        (63, calibration(900.0), 900.0, ""),
        (
            63,
            calibration(1194.67),
            896.0,
            "1195 px in XMP that belongs to another size; the 35 mm equivalent",
        ),
        (63, calibration(1800.0), 896.0, "belongs to another size"),
        (None, calibration(900.0, 256.0), 900.0, ""),
        (None, calibration(1800.0, 512.0), None, "belongs to another size; nothing else tells"),
        (None, calibration(1800.0), 1800.0, "of the size that the camera made"),
        (63, "", 896.0, ""),
    ],
)
def test_a_calibration_of_another_size_is_not_used_and_said(film, xmp, expected, words):
    details = {} if film is None else {ExifTags.Base.FocalLengthIn35mmFilm: film}
    assert focal_px((512, 384), details, xmp) == expected
    assert words in focal_warning((512, 384), details, xmp)
    assert bool(words) == bool(focal_warning((512, 384), details, xmp))


@pytest.mark.parametrize(
    ("value", "expected"),
    [("Below Sea Level", 1), ("above sea level", 0), ("\x01", 1), ((1,), 1), ([3, 0], 3), (1.0, 1), ("", None),
     ("?", None)],
)  # fmt: skip
def test_the_reference_of_a_height_in_other_types(value, expected):
    assert altitude_reference({GPS.GPSAltitudeRef: value}) == expected


@pytest.mark.parametrize(
    "value", [IFDRational(0, 0), (IFDRational(47), IFDRational(1, 0), IFDRational(0)), "47 N", b"\xff", (), "478 5"]
)
def test_a_latitude_that_cannot_be_read_is_said(value):
    position, fault = position_of_gps(gps_of() | {GPS.GPSLatitude: value})
    assert position is None
    assert fault == "a latitude and longitude that can be read"


@pytest.mark.parametrize(
    "value", [IFDRational(338567844, 10**7), "33.8567844", b"33.8567844\0", (IFDRational(338567844, 10**7),)]
)
def test_a_latitude_as_one_number_is_in_degrees(value):
    assert position_of_gps(gps_of() | {GPS.GPSLatitude: value})[0][0] == pytest.approx(LAT)


@pytest.mark.parametrize("prefix", ["drone-dji", "ns1", "d-x"])
@pytest.mark.parametrize("quote", ['"', "'"])
def test_the_prefix_of_a_namespace_is_free(head, prefix, quote):
    xmp = XMP.format(q=quote).replace("drone-dji:", f"{prefix}:")
    xmp = xmp.replace(
        "<rdf:Description", f"<rdf:Description xmlns:{prefix}={quote}http://www.dji.com/drone-dji/1.0/{quote}"
    )
    assert head(xmp=xmp).lat_lon_height == (-33.85678441, -151.21529672, 12.5)
    assert head(xmp=xmp).rtk.std_m == (0.01, 0.02, 0.03)


@pytest.mark.parametrize(
    ("latitude", "longitude"),
    [("33,51.407064S", "151,12.917802W"), ("33,51,24.42384S", "151,12,55.06812W"),
     ("33,51.407064s", "151,12,55.06812w")],
)  # fmt: skip
@pytest.mark.parametrize(("reference", "height"), [("0", 12.5), ("1", -12.5), ("3", -12.5)])
@pytest.mark.parametrize("form", ['exif:{}="{}"', "<exif:{0}>{1}</exif:{0}>"])
def test_a_position_that_a_program_rewrote_as_xmp_is_read(head, latitude, longitude, reference, height, form):
    values = {"GPSLatitude": latitude, "GPSLongitude": longitude, "GPSAltitude": "125/10", "GPSAltitudeRef": reference}
    found = head(xmp="<x>" + " ".join(form.format(*each) for each in values.items()) + "</x>").lat_lon_height
    assert found == pytest.approx((LAT, LON, height), abs=1e-7)
    skydio = XMP.format(q='"').replace("drone-dji:Gps", "drone-skydio:").replace("drone-dji:Abs", "drone-skydio:Abs")
    assert head(xmp=skydio).lat_lon_height == (-33.85678441, -151.21529672, 12.5)


@pytest.mark.parametrize("datum", ["TOKYO", "NAD27", "OSGB 36", "GCJ-02", "PZ-90"])
def test_a_position_on_another_datum_is_named(head, datum):
    found = head(gps_of() | {GPS.GPSMapDatum: datum})
    assert found.gps_datum == datum
    assert any(
        f"on {datum} by EXIF or XMP, which is taken as WGS 84" in said
        for said in header_warnings(NOTHING, {"a.jpg": found})
    )
    assert head(gps_of(), xmp='<x Camera:HorizCS="EPSG:2056"/>').gps_datum == "EPSG:2056"


@pytest.mark.parametrize("datum", [
    "WGS-84", "WGS84\0", "wgs 84", "", "  ", "ITRF2014", "ETRS89", "unknown", "WGS-1984", "WGS 1984", "GCS_WGS_1984",
    "World Geodetic System 1984", "4326", "GDA2020", "EPSG:7844", "JGD2011", "SIRGAS 2000",
])  # fmt: skip
def test_wgs_84_by_any_name_is_no_other_datum(head, datum):
    assert head(gps_of() | {GPS.GPSMapDatum: datum}).gps_datum == ""
    assert head(gps_of(), xmp='<x Camera:HorizCS="EPSG:4326"/>').gps_datum == ""


def test_only_the_namespace_of_exif_itself_gives_a_position(head):
    place = '{0}:GPSLatitude="33,51.407064S" {0}:GPSLongitude="151,12.917802W"'
    given = '<x xmlns:{0}="http://ns.adobe.com/exif/1.0/{1}" ' + place + "/>"
    assert head(xmp=given.format("e", "")).lat_lon_height[:2] == pytest.approx((LAT, LON), abs=1e-7)
    assert head(xmp=given.format("aux", "aux/")).lat_lon_height is None


@pytest.mark.parametrize(("zoom", "is_doubted"), [(None, False), (0.0, False), (1.0, False), (2.0, True)])
def test_a_digital_zoom_is_named(zoom, is_doubted):
    details = {ExifTags.Base.FocalLengthIn35mmFilm: 24} | (
        {} if zoom is None else {ExifTags.Base.DigitalZoomRatio: zoom}
    )
    assert ("digital zoom of 2 by EXIF" in focal_warning((512, 384), details, "")) is is_doubted


@pytest.mark.parametrize("status", ["V", "v", b"V\0", "Void"])
def test_positions_that_a_receiver_calls_void_count_only_where_there_are_no_others(head, status):
    void, valid = head(gps_of() | {GPS.GPSStatus: status}), head(gps_of() | {GPS.GPSStatus: "A"})
    assert void.is_void
    assert not valid.is_void
    assert not head(gps_of()).is_void
    among = without_void_fixes({"a": void, "b": valid})
    assert among["a"].lat_lon_height is None
    assert among["b"] == valid
    assert any("GPSStatus is V" in line and "not used" in line for line in header_warnings(NOTHING, among))
    others = without_void_fixes({"a": void, "b": void, "c": valid, "d": replace(void, serial="2"), "e": void})
    assert all(each.lat_lon_height is not None for each in others.values())
    alone = without_void_fixes({"a": void})
    assert alone["a"].lat_lon_height is not None
    assert any("GPSStatus is V" in line and "is used" in line for line in header_warnings(NOTHING, alone))


@pytest.mark.parametrize(
    ("error", "axis"),
    [(IFDRational(14142, 10**6), 0.01), (IFDRational(5), 3.53553), (IFDRational(0), None),
     (IFDRational(1, 0), None)],
)  # fmt: skip
def test_the_positioning_error_of_exif_is_the_accuracy_of_the_position(head, error, axis):
    found = head(gps_of() | {GPS.GPSHPositioningError: error}).std_m
    assert found is None if axis is None else found == pytest.approx((axis, axis, 2.0 * axis), rel=1e-4)
