"""The one way between CRSs: units, accuracy, missing grids, and that nothing goes past it."""

from pathlib import Path

import numpy as np
import pytest
from pyproj import CRS, Transformer

from geo.compatibility import require_in_area
from geo.crs import horizontal_crs
from geo.errors import GeoError, PlaceMismatch, UnknownUnit
from geo.projection import metres_per_unit
from geo.transformation import WGS84, Transformation, height_scale, lon_lat, transformed

US_FOOT_M, FOOT_M = 1200.0 / 3937.0, 0.3048
PACKAGES = ("geo", "survey", "evaluation", "fields", "refract", "bathynerf")
# The door, and where one is made without a change of datum.
DOORS = {"geo/transformation.py", "geo/projection.py"}
MAKERS = ("Transformer.", "TransformerGroup(", "Proj(", "rasterio.warp", "osr.")


def test_no_other_file_makes_transformations_of_proj():
    root = Path(__file__).resolve().parent.parent
    makers = {
        path.relative_to(root).as_posix()
        for package in PACKAGES
        for path in (root / package).rglob("*.py")
        if any(maker in path.read_text(encoding="utf-8") for maker in MAKERS)
    }
    assert makers == DOORS


@pytest.mark.parametrize(
    ("source", "target", "place"),
    [("EPSG:4326", "EPSG:25832", (9.0, 48.0)), ("EPSG:25832", "EPSG:25833", (5e5, 5.2e6)),
     ("EPSG:4326", "EPSG:3857", (9.0, 48.0)), ("EPSG:25832", "EPSG:4258", (5e5, 5.2e6)),
     ("+proj=utm +zone=32 +ellps=GRS80 +units=us-ft +no_defs", "EPSG:25832", (5e5 / US_FOOT_M, 5.2e6 / US_FOOT_M))],
)  # fmt: skip
def test_a_map_of_the_same_datum_costs_no_accuracy(source, target, place):
    way = Transformation.between(CRS(source), CRS(target), np.array([place]))
    assert way.accuracy_m == 0.0
    assert way.warning("they") is None
    back = Transformation.between(CRS(target), CRS(source), np.array([way(*place)]))
    # A millionth of a degree is a decimetre; both ways are exact to far less.
    np.testing.assert_allclose(back(*way(*place)), place, rtol=0.0, atol=1e-4)


# Places by the published transformations of these datums: Britain, Austria, old and new North America.
SHIFTED = [("EPSG:27700", (1.716073973, 52.658007833)), ("EPSG:31254", (10.3, 47.0)), ("EPSG:26910", (-122.0, 41.0))]


@pytest.mark.parametrize(("crs", "place"), SHIFTED)
def test_a_shift_between_datums_says_its_accuracy_and_the_grid_that_a_better_one_needs(crs, place):
    way = Transformation.between(WGS84, CRS(crs), np.array([place]))
    warning = way.warning("GPS positions")
    if way.missing_grids:
        assert way.missing_grids[0] in warning
        with pytest.raises(GeoError, match=way.missing_grids[0].replace(".", r"\.")):
            transformed(WGS84, CRS(crs), np.array([[*place, 0.0]]), "it", "or else.")
    else:
        # Where the grid is installed the way is good to what it states.
        assert way.accuracy_m is not None
        assert way.accuracy_m > 0.0
        assert "GPS positions are transformed from WGS 84" in warning


@pytest.mark.parametrize("target", ["EPSG:32119+5703", "EPSG:2264+6360", "EPSG:2264+8228"])
@pytest.mark.parametrize("source", ["EPSG:2264+5703", "EPSG:2264+6360", "EPSG:2264+8228", "EPSG:32119+6360"])
def test_heights_of_one_datum_are_converted_between_their_units(source, target):
    scale = height_scale(CRS(source), CRS(target), "the heights")
    units = {"5703": 1.0, "6360": US_FOOT_M, "8228": FOOT_M}
    assert scale == pytest.approx(units[source[-4:]] / units[target[-4:]], rel=1e-12)


def test_heights_without_a_unit_are_asked_for_where_the_plan_has_another_one_than_the_survey():
    metres, feet = CRS("EPSG:32119+5703"), CRS("EPSG:2264+6360")
    assert height_scale(CRS("EPSG:32119"), metres, "they") == 1.0
    assert height_scale(CRS("EPSG:2264"), feet, "they") == 1.0
    assert height_scale(CRS("EPSG:4326"), feet, "they") == pytest.approx(1.0 / US_FOOT_M)
    for source, target in (("EPSG:2264", metres), ("EPSG:32119", feet)):
        with pytest.raises(UnknownUnit, match=r"they have no unit: .* name the CRS with its vertical part"):
            height_scale(CRS(source), target, "they")
        assert height_scale(CRS(source), target, "they", unit_m=2.0) in (2.0, pytest.approx(2.0 / US_FOOT_M))
    with pytest.raises(GeoError, match="are above the ellipsoid, expected above NAVD88"):
        height_scale(CRS("EPSG:4979"), metres, "they")


@pytest.mark.parametrize(
    ("crs", "place", "expected"),
    [("EPSG:25832+5783", (5e5, 5.2e6), (1.0 / 0.9996, 1.0 / 0.9996)),
     ("EPSG:2264+6360", (2e6, 6e5), (US_FOOT_M, US_FOOT_M)),
     # Web Mercator stretches by one over the cosine of the latitude.
     ("EPSG:3857+5773", (1e6, 6.1e6), (0.6713, 0.6692)),
     ("EPSG:4979", (9.0, 48.0), (74_627.0, 111_200.0))],
)  # fmt: skip
def test_metres_in_a_unit_of_the_map(crs, place, expected):
    # Scale of State Plane and of the sphere: parts in a thousand.
    np.testing.assert_allclose(metres_per_unit(CRS(crs), np.array([place])), expected, rtol=2e-3)


def test_places_far_outside_the_area_of_a_crs_are_refused_and_others_have_a_longitude_and_a_latitude():
    require_in_area(CRS("EPSG:25832+5783"), np.array([[5e5, 5.2e6]]), "they")
    with pytest.raises(PlaceMismatch, match=r"they lie .* degrees outside the area that OSGB36"):
        require_in_area(CRS("EPSG:27700+5701"), np.array([[5e6, 5.2e6]]), "they")
    found = lon_lat(CRS("EPSG:25832"), np.array([[5e5, 5.2e6], [np.nan, 0.0]]))
    np.testing.assert_allclose(found[0], [9.0, 46.953], atol=1e-3)
    assert not np.isfinite(found[1]).all()


BESSEL = "+proj=utm +zone=32 +ellps=bessel"
HELMERT = "+towgs84=598.1,73.7,418.2,0.202,0.045,-2.455,6.7"


@pytest.mark.parametrize(
    ("source", "accuracy"),
    [
        # Far outside its area PROJ knows no operation of this datum; nor of one without a name, on another ellipsoid.
        ("EPSG:27700", None), (BESSEL, None), (f"{BESSEL} {HELMERT}", None), ("+proj=longlat +ellps=intl", None),
        ("+proj=utm +zone=32 +ellps=GRS80", 0.0), ("+proj=utm +zone=32 +ellps=WGS84", 0.0), ("EPSG:32632", 0.0),
        ("EPSG:25833", 0.0), ("EPSG:4326", 0.0),
    ],
)  # fmt: skip
@pytest.mark.parametrize("is_back", [False, True])
def test_what_proj_knows_no_operation_for_is_not_called_exact(source, accuracy, is_back):
    ends, place = (CRS(source), CRS("EPSG:25832+7837")), np.array([[589012.0, 5194736.0]])
    if not is_back:
        place = np.column_stack(Transformer.from_crs("EPSG:25832", ends[0], always_xy=True).transform(*place.T))
    way = Transformation.between(*(ends[::-1] if is_back else ends), place)
    assert way.accuracy_m == accuracy
    assert (way.warning("places") is None) == (accuracy == 0.0)


@pytest.mark.parametrize("vertical", ["", " +vunits=m"])
def test_the_way_to_wgs_84_that_a_nameless_crs_gives_is_taken(vertical):
    source = CRS(f"{BESSEL} {HELMERT}{vertical} +no_defs")
    at = Transformer.from_crs("EPSG:25832", f"{BESSEL} {HELMERT}", always_xy=True).transform(589012.0, 5194736.0)
    assert np.hypot(at[0] - 589012.0, at[1] - 5194736.0) > 100.0
    way = Transformation.between(source, CRS("EPSG:25832+7837"), np.array([at]))
    assert np.column_stack(way(*np.array([at]).T)) == pytest.approx(np.array([[589012.0, 5194736.0]]), abs=1e-3)
    # A datum with a name has better operations than those of its text.
    text, spheroid = CRS("EPSG:31468").to_wkt("WKT1_GDAL"), 'AUTHORITY["EPSG","7004"]]'
    named = CRS.from_wkt(text.replace(spheroid, f"{spheroid},TOWGS84[600,70,420,0,0,0,0]"))
    assert named.is_bound
    known = Transformation.between(CRS("EPSG:31468"), CRS("EPSG:25832"), np.array([[4468000.0, 5311480.0]]))
    by_text = Transformation.between(named, CRS("EPSG:25832"), np.array([[4468000.0, 5311480.0]]))
    assert np.column_stack(by_text(4468000.0, 5311480.0)) == pytest.approx(
        np.column_stack(known(4468000.0, 5311480.0)), abs=0.01
    )


@pytest.mark.parametrize("name", [
    "unknown", "Unnamed", "Unknown based on Bessel 1841 ellipsoid", "Not_specified_based_on_Bessel_1841_ellipsoid",
    "D_Unknown_based_on_Bessel", "undefined", "user", "D_User_Defined", "local datum",
])  # fmt: skip
def test_the_way_to_wgs_84_counts_whatever_a_datum_is_called_that_proj_does_not_know(name):
    text = CRS(f"{BESSEL} {HELMERT}").to_wkt("WKT1_GDAL")
    begin = text.index('DATUM["') + len('DATUM["')
    source = CRS.from_wkt(text[:begin] + name + text[text.index('"', begin) :])
    assert source.is_bound
    place = np.array([[589012.0, 5194736.0]])
    at = np.column_stack(Transformer.from_crs("EPSG:25832", f"{BESSEL} {HELMERT}", always_xy=True).transform(*place.T))
    way = Transformation.between(source, CRS("EPSG:25832+7837"), at)
    assert np.column_stack(way(*at.T)) == pytest.approx(place, abs=1e-3)
    assert way.accuracy_m is None


@pytest.mark.parametrize(("text", "is_known"), [
    (f"{BESSEL} {HELMERT}", True),  # an operation of unknown accuracy
    (BESSEL, False),
    ("+proj=tmerc +lat_0=47 +lon_0=10 +ellps=GRS80", True),  # may be the datum of the other
    ("EPSG:31254", True),
    ("EPSG:31466", True),  # outside the area of every operation
])  # fmt: skip
def test_a_way_between_datums_of_which_none_is_known_is_refused(text, is_known):
    source, target = CRS(text), CRS("EPSG:25832+7837")
    lon_lat = Transformer.from_crs(horizontal_crs(source).geodetic_crs, horizontal_crs(source), always_xy=True)
    way = Transformation.between(source, target, np.column_stack(lon_lat.transform(np.array([10.2]), np.array([46.9]))))
    assert way.is_known is is_known
    if is_known:
        way.require_known("points", "or give others")
    else:
        with pytest.raises(GeoError, match=r"no operation between the datums .*, or give others"):
            way.require_known("points", "or give others")


@pytest.mark.parametrize(("code", "place", "least", "most"), [
    ("EPSG:27700", (600000.0, -400000.0), 2.0, 60.0),
    ("EPSG:31370", (900000.0, 200000.0), 1.0, 30.0),
    ("EPSG:4277", (12.0, 47.0), 2.0, 60.0),
    ("EPSG:4269", (11.0, 47.0), 1.0, 10.0),
])  # fmt: skip
def test_outside_their_areas_operations_are_as_good_as_they_agree(code, place, least, most):
    way = Transformation.between(CRS(code), CRS("EPSG:4326"), np.array([place]))
    assert least <= way.accuracy_m <= most
    assert way.is_known
    assert "outside the area of each operation that PROJ knows, which are good to" in way.warning("places")
    # Of one alone nothing is known there.
    alone = Transformation.between(CRS("EPSG:31254"), CRS("EPSG:4326"), np.array([[80000.0, 5.9e6]]))
    assert alone.accuracy_m is None
    assert "an unknown accuracy" in alone.warning("places")
