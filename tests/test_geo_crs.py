"""CRS strings: what is accepted, what is refused and with which remedy, and the WKT 1 that goes into LAS."""

from __future__ import annotations

import pytest
from pyproj import CRS

from geo.compatibility import same_crs
from geo.crs import degrees_outside_area, height_unit_m, horizontal_crs, is_geographic, parse_crs, vertical_crs, wkt1
from geo.errors import GeoError, MissingVerticalDatum, UnknownCRS, UnsupportedCRS

COMPOUND = [
    "EPSG:25832+5778", "EPSG:4326+5773", "EPSG:32733+5773", "EPSG:2230+6360", "EPSG:2992+6360", "EPSG:32661+3855",
    "EPSG:32761+3855", "EPSG:3031+3855", "EPSG:27700+5701", "EPSG:2056+5728", "EPSG:28992+5709", "EPSG:27572+5720",
    "EPSG:4807+5720", "EPSG:5514+5705", "EPSG:3857+3855", "EPSG:3375+5714",
]  # fmt: skip
# Authorities that put northing first: WKT 1 without axes comes back with easting first and without its code.
NORTHING_FIRST = ["EPSG:2193+7839", "EPSG:2180+9651", "EPSG:3035+5730"]
THREE_D = ["EPSG:4979", "EPSG:32632+4979", "EPSG:25832+4937", "+proj=utm +zone=32 +datum=WGS84 +vunits=m"]


@pytest.mark.parametrize("text", COMPOUND)
def test_wkt1_of_a_compound_crs_keeps_both_epsg_codes(text):
    crs = parse_crs(text)
    again = CRS.from_wkt(wkt1(crs))
    codes = [int(code) for code in text.removeprefix("EPSG:").split("+")]
    assert wkt1(crs).startswith("COMPD_CS[")
    assert [part.to_epsg() for part in again.sub_crs_list] == codes


@pytest.mark.parametrize("text", NORTHING_FIRST)
def test_wkt1_of_a_northing_first_crs_is_the_same_system_with_easting_first(text):
    crs = parse_crs(text)
    again = CRS.from_wkt(wkt1(crs))
    assert [axis.direction for axis in again.axis_info] == ["east", "north", "up"]
    assert again.sub_crs_list[1].to_epsg() == int(text.split("+")[1])
    assert same_crs(crs, again)


@pytest.mark.parametrize("text", [*THREE_D, "+proj=utm +zone=32 +datum=WGS84 +vunits=us-ft"])
def test_wkt1_of_a_3d_crs_is_a_compound_above_the_ellipsoid_that_reads_back_as_3d(text):
    crs = parse_crs(text)
    text_1 = wkt1(crs)
    again = CRS.from_wkt(text_1)
    assert text_1.startswith("COMPD_CS[")
    assert 'VERT_DATUM["Ellipsoid",2002]' in text_1
    assert not again.is_compound
    assert len(again.axis_info) == 3
    assert height_unit_m(again) == pytest.approx(height_unit_m(crs), rel=1e-14)
    assert same_crs(crs, again)


def test_wkt1_of_metres_above_the_ellipsoid_has_the_name_that_gdal_gives_it():
    assert 'VERT_CS["Ellipsoid (metre)"' in wkt1(parse_crs("EPSG:32632+4979"))


def test_a_transformation_to_wgs84_attached_to_a_crs_is_put_aside():
    bound = parse_crs("+proj=utm +zone=32 +ellps=bessel +towgs84=598,73,418 +vunits=m")
    assert not horizontal_crs(bound).is_bound
    assert horizontal_crs(bound).ellipsoid.name == "Bessel 1841"


def test_parts_and_units_are_found_in_compound_and_3d_systems():
    feet = parse_crs("EPSG:2230+6360")
    assert vertical_crs(feet).to_epsg() == 6360
    assert height_unit_m(feet) == pytest.approx(1200 / 3937, rel=1e-14)
    assert vertical_crs(parse_crs("EPSG:4979")) is None
    assert is_geographic(parse_crs("EPSG:4326+5773"))
    assert not is_geographic(feet)


@pytest.mark.parametrize(
    ("text", "kind", "words"),
    [
        ("EPSG:25832", MissingVerticalDatum, ["no vertical part", "EPSG:25832+5778", "EPSG:25832+4937"]),
        ("EPSG:4326", MissingVerticalDatum, ["no vertical part", "EPSG:4979"]),
        ("+proj=utm +zone=32 +ellps=GRS80 +units=m", MissingVerticalDatum, ["no vertical part", "EPSG:25832+5778"]),
        ("EPSG:32632+5715", UnsupportedCRS, ["counts down", "+5714"]),
        ("EPSG:25832+5831", UnsupportedCRS, ["counts down", "upwards"]),
        ("EPSG:2046+9279", UnsupportedCRS, ["west and south", "easting and northing"]),
        ("EPSG:2065+5705", UnsupportedCRS, ["south and west", "easting and northing"]),
        ("EPSG:5778", UnsupportedCRS, ["heights only", "EPSG:25832+5778"]),
        ("EPSG:4978", UnsupportedCRS, ["Geocentric CRS", "EPSG:4979"]),
        ('LOCAL_CS["site",UNIT["metre",1]]', UnsupportedCRS, ["Engineering CRS"]),
        ("+proj=ob_tran +o_proj=longlat +o_lat_p=30 +lon_0=10 +ellps=GRS80", UnsupportedCRS, ["Derived Geographic"]),
        ("EPSG:8857+3855", UnsupportedCRS, ["cannot be written as WKT 1", "UTM zone"]),
        ("EPSG:99999", UnknownCRS, ["not a known coordinate reference system", "EPSG:25832+5778"]),
        ("EPSG:25832+25833", UnknownCRS, ["not a known coordinate reference system"]),
        ("gauss", UnknownCRS, ['crs in survey.toml is "gauss"']),
        ("", UnknownCRS, ["EPSG code with a vertical part"]),
    ],
)
def test_an_unfit_crs_is_refused_with_its_name_and_the_mend(text, kind, words):
    with pytest.raises(kind) as caught:
        parse_crs(text, where="crs in survey.toml")
    assert issubclass(kind, GeoError)
    assert issubclass(GeoError, ValueError)
    for word in ["crs in survey.toml", *words] if kind is not UnsupportedCRS else words:
        assert word in str(caught.value)


def test_a_long_wkt_is_cut_short_in_the_message():
    with pytest.raises(MissingVerticalDatum) as caught:
        parse_crs(CRS("EPSG:25832").to_wkt())
    assert len(str(caught.value)) < 300


def test_the_distance_to_the_area_of_use_is_counted_the_short_way_round():
    fiji = parse_crs("EPSG:3832+3855")  # an area that spans the antimeridian
    degree = 0.017453292519943295
    assert degrees_outside_area(fiji, 179.0 * degree, 0.0) == 0.0
    assert degrees_outside_area(fiji, -179.0 * degree, 0.0) == 0.0
    utm = parse_crs("EPSG:32632+3855")  # 6 to 12 degrees east, 0 to 84 north
    assert degrees_outside_area(utm, 15.0 * degree, 40.0 * degree) == pytest.approx(3.0)
    assert degrees_outside_area(utm, -9.0 * degree, 40.0 * degree) == pytest.approx(15.0)
    assert degrees_outside_area(utm, 9.0 * degree, -20.0 * degree) == pytest.approx(20.0)
    assert degrees_outside_area(parse_crs(THREE_D[3]), 2.0, 1.0) == 0.0  # no area known
