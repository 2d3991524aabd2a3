"""CRSs: what is accepted, refused and written, and which are the same."""

import laspy
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyproj import CRS

from geo.compatibility import bounds_in_other_order, crs_difference, require_same_crs, require_same_place
from geo.crs import degrees_outside_area, height_unit_m, horizontal_crs, is_geographic, parse_crs, vertical_crs, wkt1
from geo.errors import GeoError, PlaceMismatch

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
    assert crs_difference(crs, again) is None


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
    assert crs_difference(crs, again) is None


def test_parts_and_units_are_found_in_compound_3d_and_bound_systems():
    assert 'VERT_CS["Ellipsoid (metre)"' in wkt1(parse_crs("EPSG:32632+4979"))
    # A transformation to WGS 84 attached to a CRS is put aside.
    bound = parse_crs("+proj=utm +zone=32 +ellps=bessel +towgs84=598,73,418 +vunits=m")
    assert not horizontal_crs(bound).is_bound
    assert horizontal_crs(bound).ellipsoid.name == "Bessel 1841"
    feet = parse_crs("EPSG:2230+6360")
    assert vertical_crs(feet).to_epsg() == 6360
    assert height_unit_m(feet) == pytest.approx(1200 / 3937, rel=1e-14)
    assert vertical_crs(parse_crs("EPSG:4979")) is None
    assert is_geographic(parse_crs("EPSG:4326+5773"))
    assert not is_geographic(feet)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("EPSG:25832", ["no vertical part", "EPSG:25832+5778", "EPSG:25832+4937"]),
        ("EPSG:4326", ["no vertical part", "EPSG:4979"]),
        (CRS("EPSG:25832").to_wkt(), ["no vertical part"]),
        ("+proj=utm +zone=32 +ellps=GRS80 +units=m", ["no vertical part", "EPSG:25832+5778"]),
        ("EPSG:32632+5715", ["counts down", "+5714"]),
        ("EPSG:25832+5831", ["counts down", "upwards"]),
        ("EPSG:2046+9279", ["west and south", "easting and northing"]),
        ("EPSG:2065+5705", ["south and west", "easting and northing"]),
        ("EPSG:5778", ["heights only", "EPSG:25832+5778"]),
        ("EPSG:4978", ["Geocentric CRS", "EPSG:4979"]),
        ('LOCAL_CS["site",UNIT["metre",1]]', ["Engineering CRS"]),
        ("+proj=ob_tran +o_proj=longlat +o_lat_p=30 +lon_0=10 +ellps=GRS80", ["Derived Geographic"]),
        ("EPSG:8857+3855", ["cannot be written as WKT 1", "UTM zone"]),
        ("EPSG:99999", ["not a known coordinate reference system", "EPSG:25832+5778"]),
        ("EPSG:25832+25833", ["not a known coordinate reference system"]),
        ("gauss", ['crs in survey.toml is "gauss"']),
        ("", ["EPSG code with a vertical part"]),
    ],
)
def test_an_unfit_crs_is_refused_with_its_name_and_the_mend(text, words):
    with pytest.raises(GeoError) as caught:
        parse_crs(text, where="crs in survey.toml")
    assert issubclass(GeoError, ValueError)
    assert str(caught.value).startswith(("crs in survey.toml", "the CRS"))
    for word in words:
        assert word in str(caught.value)
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


SYSTEMS = [
    "EPSG:25832+5778", "EPSG:4326+5773", "EPSG:4979", "EPSG:2230+6360", "EPSG:2193+7839", "EPSG:2180+9651",
    "EPSG:32761+3855", "EPSG:27700+5701", "EPSG:4807+5720", "EPSG:32632+4979", "EPSG:3035+5730", "EPSG:3857+3855",
]  # fmt: skip
HEIGHTS = CRS("EPSG:5703").to_wkt("WKT1_GDAL")


def site_grid(unit: str, metres: float) -> str:
    """WKT of coordinates that are not placed on the Earth, as surveying software writes them."""
    axes = 'AXIS["Easting",EAST],AXIS["Northing",NORTH]'
    return f'LOCAL_CS["site grid",LOCAL_DATUM["site",0],UNIT["{unit}",{metres}],{axes}]'


@pytest.mark.parametrize("text", SYSTEMS)
def test_a_crs_is_the_same_after_wkt_1_and_differs_from_all_others(text):
    again = CRS.from_wkt(wkt1(CRS(text)))
    assert [other for other in SYSTEMS if crs_difference(again, CRS(other)) is None] == [text]


@pytest.mark.parametrize(
    ("a", "b", "words"),
    [
        ("EPSG:25832+5778", "EPSG:25833+5778", "ETRS89 / UTM zone 32N against ETRS89 / UTM zone 33N"),
        ("EPSG:25832+5778", "EPSG:32632+5778", "ETRS89 / UTM zone 32N against WGS 84 / UTM zone 32N"),
        ("EPSG:25832+5778", "EPSG:25832+7837", "heights GHA height against DHHN2016 height"),
        ("EPSG:25832+5778", "EPSG:25832+4937", "heights GHA height against ellipsoidal height"),
        ("EPSG:26910+5703", "EPSG:26910+6360", r"heights NAVD88 height \(metre, up\) against NAVD88 height \(ftUS\)"),
        ("EPSG:26910+5714", "EPSG:26910+5715", r"\(metre, up\) against MSL depth \(metre, down\)"),
        ("EPSG:4326", "EPSG:32632", "WGS 84 against WGS 84 / UTM zone 32N"),
        ("EPSG:4326", "EPSG:4258", "WGS 84 against ETRS89"),
        ("EPSG:2994", "EPSG:2993", r"\(ft\) against .*\(m\)"),
        ("EPSG:27572", "EPSG:27571", "Lambert zone II against .*Lambert zone I"),
        (site_grid("metre", 1.0), site_grid("foot", 0.3048), r"site grid \(metre\) against site grid \(foot\)"),
        (site_grid("metre", 1.0), "EPSG:25832+5778", "site grid against ETRS89 / UTM zone 32N"),
        ("EPSG:5703", "EPSG:6360", r"NAVD88 height against NAVD88 height \(ftUS\)"),
    ],
)
def test_what_differs_is_said_and_refused(a, b, words):
    with pytest.raises(GeoError, match=rf"cloud\.las and ref\.las are in different .*{words}.*; convert one"):
        require_same_crs(CRS(a), CRS(b), "cloud.las", "ref.las")


@pytest.mark.parametrize(
    ("a", "b"),
    [
        ("EPSG:25832+5778", "EPSG:25832"),
        ("EPSG:25832+5778", "+proj=utm +zone=32 +ellps=GRS80 +units=m"),
        ("EPSG:32632+5773", "+proj=utm +zone=32 +datum=WGS84 +units=m"),
        ("EPSG:7415", "EPSG:28992+5709"),
        (f'COMPD_CS["site",{site_grid("metre", 1.0)},{HEIGHTS}]', site_grid("metre", 1.0)),
    ],
)
def test_what_one_of_them_leaves_out_is_no_difference(a, b):
    assert crs_difference(CRS(a), CRS(b)) is None
    assert crs_difference(CRS(b), CRS(a)) is None
    require_same_crs(CRS(a), None, "cloud.las", "ref.ply")
    require_same_crs(None, None, "cloud.las", "ref.ply")


@pytest.mark.parametrize(
    ("name", "same", "other"),
    [
        ("autzen_trim.laz", "EPSG:2994", "EPSG:2992"),
        ("test1_4.las", "EPSG:2903", "EPSG:2904"),
        ("file_with_both_wkt_and_geotiff_vlrs.las", "EPSG:6880", "EPSG:6879"),
        ("simple.copc.laz", "EPSG:2991+6360", "EPSG:2991+5703"),
    ],
)
def test_systems_as_other_programs_write_them_are_recognised(data_dir, name, same, other):
    with laspy.open(data_dir / "real/laspy_las" / name) as reader:
        crs = reader.header.parse_crs()
    assert crs_difference(crs, CRS(same)) is None
    assert crs_difference(crs, CRS(other)) is not None


def test_boxes_that_touch_are_at_the_same_place_and_others_are_refused():
    here = np.array([[589000.0, 5194700.0, 2100.0], [589020.0, 5194750.0, 2105.0]])
    require_same_place(here, here + np.array([20.0, 0.0, 900.0]), "cloud.las", "ref.ply")
    with pytest.raises(PlaceMismatch, match=r"easting 589000 to 589020.*do not overlap; check that both"):
        require_same_place(here, here + np.array([0.0, 1000.0, 0.0]), "cloud.las", "ref.ply")
    with pytest.raises(PlaceMismatch, match=r"easting and northing seem to be swapped.*in ref\.ply"):
        require_same_place(here, here[:, [1, 0, 2]], "cloud.las", "ref.ply")


@settings(max_examples=200)
@given(
    east=st.floats(1e5, 9e5), north=st.floats(1e6, 9e6),
    sides=st.tuples(st.floats(1.0, 5e3), st.floats(1.0, 5e3)),
    share=st.tuples(st.floats(0.1, 0.9), st.floats(0.1, 0.9)),
)  # fmt: skip
def test_bounds_in_the_order_of_other_programs_are_told_from_their_own(east, north, sides, share):
    places = np.array([[east, north, 0.0], [east + sides[0], north + sides[1], 5.0]])
    low, high = places[0, :2] + 0.4 * np.array(share) * sides, places[1, :2]
    right = (*low.tolist(), *high.tolist())
    other = (right[0], right[2], right[1], right[3])
    assert bounds_in_other_order(right, places) is None
    assert bounds_in_other_order(other, places) == right
    # Northing first, as maps of some countries have it.
    for order in ((1, 0, 3, 2), (1, 3, 0, 2)):
        assert bounds_in_other_order(tuple(right[i] for i in order), places) == right
    # In their own order they stand wherever they lie: beside the places, or far from them.
    for shift in (0.9, 1.5, 100.0):
        moved = np.add(right, shift * np.tile(sides, 2))
        assert bounds_in_other_order(tuple(moved.tolist()), places) is None


def test_bounds_that_may_be_in_either_order_stand():
    # About the origin of a local grid both orders are rectangles of like size that hold the data.
    places = np.array([[0.0, 0.0], [40.0, 40.0]])
    assert bounds_in_other_order((0.0, 10.0, 20.0, 30.0), places) is None
    # Here the second is above the fourth as it stands.
    assert bounds_in_other_order((10.0, 30.0, 5.0, 25.0), places) == (10.0, 5.0, 30.0, 25.0)
    # Beside all places they stand, too.
    places = np.array([[589000.0, 5194700.0], [589010.0, 5194710.0]])
    for bounds in ((589012.0, 5194736.0, 589017.0, 5194742.0), (588900.0, 5194000.0, 588950.0, 5194020.0)):
        assert bounds_in_other_order(bounds, places) is None
