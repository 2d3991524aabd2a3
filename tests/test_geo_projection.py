"""From one CRS to another: heights and datums, and the scale of maps."""

from types import SimpleNamespace

import numpy as np
import pytest
from pyproj import CRS, Geod, Transformer
from stored_run import run_of, stored_points

from geo import transformation
from geo.compatibility import Reprojection
from geo.crs import horizontal_unit, parse_crs
from geo.errors import GeoError, PlaceMismatch
from geo.projection import ground_units_m, is_to_scale
from survey.export.export import export
from survey.export.registry import ExportOptions

SOURCE = parse_crs("EPSG:25832+5783")
POINTS = np.array([[691000.0, 5334000.0, 500.0], [691010.0, 5334020.0, 498.5], [np.nan, 5334020.0, 498.5]])


@pytest.mark.parametrize("target", ["EPSG:32632", "EPSG:4326", "EPSG:25833", "EPSG:3035"])
def test_a_horizontal_crs_keeps_the_heights(target):
    way = Reprojection.between(SOURCE, target)
    expected = Transformer.from_crs("EPSG:25832", target, always_xy=True).transform(*POINTS[:2, :2].T)
    found = way(POINTS)
    np.testing.assert_array_equal(found[:2], np.column_stack([*expected, POINTS[:2, 2]]))
    assert np.isnan(found[2]).all()
    assert way.crs.sub_crs_list[1].to_epsg() == 5783


def test_heights_of_the_same_datum_or_ellipsoid_stay():
    assert Reprojection.between(SOURCE, "EPSG:32632+5783").keeps_height
    way = Reprojection.between(parse_crs("EPSG:4979"), "EPSG:32632")
    assert way.keeps_height
    assert len(way.crs.axis_info) == 3
    np.testing.assert_allclose(way(np.array([[9.0, 0.0, 50.0]])), [[500000.0, 0.0, 50.0]], atol=1e-6)


def test_another_vertical_datum_needs_its_grid_which_is_named(monkeypatch):
    # Whatever grids this machine has.
    grids = [
        SimpleNamespace(short_name="egm96.tif", available=True),
        SimpleNamespace(short_name="egm08.tif", available=False),
    ]
    group = SimpleNamespace(best_available=False, unavailable_operations=[SimpleNamespace(grids=grids)])
    monkeypatch.setattr(transformation, "operations", lambda *_asked: group)
    source = parse_crs("EPSG:25832+5773")
    with pytest.raises(GeoError, match=r"--crs: the transformation from .*EGM96.* to .*EGM2008.* needs egm08\.tif"):
        Reprojection.between(source, "EPSG:25832+3855", where="--crs")


@pytest.mark.parametrize(
    ("target", "words"),
    [
        ("EPSG:26710", "is not known to PROJ; choose another CRS"),
        ("nope", "--crs is"), ("EPSG:5783", "--crs is"),
        ("EPSG:4978", "--crs is"),
    ],
)  # fmt: skip
def test_a_crs_that_is_unknown_has_no_place_or_no_known_way_is_refused(target, words):
    with pytest.raises(GeoError, match=words):
        Reprojection.between(SOURCE, target, where="--crs")


# Of a place at 9 degrees east, 47 degrees north; zones some degrees away are near enough to be meant.
NEAR = ["EPSG:32633", "EPSG:32631", "EPSG:3857", "EPSG:4326", "EPSG:3035"]
FAR = ["EPSG:32601", "EPSG:32732", "EPSG:32636", "EPSG:3031", "EPSG:32760"]


@pytest.mark.parametrize("code", [*NEAR, *FAR])
def test_a_crs_far_outside_its_area_is_refused(code):
    points = np.array([[5e5, 5.2e6, 400.0], [5e5 + 30.0, 5.2e6, 401.0]])
    way = Reprojection.between(parse_crs("EPSG:32632+5773"), code)
    if code in NEAR:
        assert np.isfinite(way(points)).all()
    else:
        with pytest.raises(PlaceMismatch, match=r"degrees outside the area that .* is made for; choose the CRS"):
            way(points)


LON, LAT = 11.36, 47.93
# Conformal, equal-area and equidistant ones, degrees, and feet; whether coordinates are lengths on the ground.
SYSTEMS = {
    "EPSG:25832": True, "EPSG:25833": True, "EPSG:3035": True, "EPSG:3857": False,
    "EPSG:3395": False, "EPSG:4087": False, "EPSG:4326": False, "EPSG:4258": False,
    "+proj=tmerc +lat_0=47 +lon_0=11 +units=us-ft +ellps=GRS80": True,
    "+proj=merc +lat_ts=0 +units=us-ft +ellps=GRS80": False,
}  # fmt: skip


@pytest.mark.parametrize(("code", "true"), SYSTEMS.items())
def test_a_unit_is_as_long_as_on_the_ellipsoid(code, true):
    crs = CRS(code)
    x, y = Transformer.from_crs(crs.geodetic_crs, crs, always_xy=True).transform(LON, LAT)
    units = ground_units_m(crs, np.array([x, y]))
    back = Transformer.from_crs(crs, crs.geodetic_crs, always_xy=True)
    step = 1e-4 if crs.is_geographic else 10.0
    for axis, unit in zip(step * np.eye(2), units, strict=True):
        (lon0, lat0), (lon1, lat1) = (
            back.transform(*(np.array([x, y]) - axis)),
            back.transform(*(np.array([x, y]) + axis)),
        )
        length = Geod(ellps="GRS80").inv(lon0, lat0, lon1, lat1)[2]
        # The place is rounded to a kilometre, and surveyors' grids to a hundredth.
        assert length == pytest.approx(2.0 * step * unit, rel=0.01 if true else 0.001)
    assert is_to_scale(crs, np.array([x, y])) is true
    if true:
        assert (units == horizontal_unit(crs)).all()


@pytest.mark.parametrize("code", [code for code in SYSTEMS if code.startswith("EPSG")])
def test_a_plane_is_equally_steep_in_every_crs(tmp_path, code):
    """A slope of 20 degrees, and cells of a decimetre on the ground, in `export --dem --crs`."""
    rasterio = pytest.importorskip("rasterio")
    along = np.arange(0.0, 3.0, 0.02)
    x, y = (part.ravel() for part in np.meshgrid(along, along))
    east, north = Transformer.from_crs(4258, 25832, always_xy=True).transform(LON, LAT)
    height = 500.0 + np.tan(np.radians(20.0)) * (0.6 * x + 0.8 * y)
    points = np.column_stack([x + round(east), y + round(north), height])
    run = run_of(stored_points(points, CRS("EPSG:25832+7837")), tmp_path / "run")
    export(run, options=ExportOptions(resolution_m=0.1, crs=code), dem=tmp_path / "s.tif")
    with rasterio.open(tmp_path / "s.tif") as raster:
        units = ground_units_m(CRS(code), np.array(raster.xy(0, 0)))
        down, right = np.gradient(raster.read(1, masked=True).filled(np.nan), *(units * raster.res)[::-1])
        slope = np.degrees(np.arctan(np.hypot(down, right)))
        assert min(raster.shape) >= 25
        assert max(raster.shape) <= 37
    assert np.nanmedian(slope) == pytest.approx(20.0, abs=0.15)


def test_a_map_that_proj_cannot_compute_is_a_sentence():
    """As a damaged .prj has it: PROJ reads the text, and refuses to compute."""
    text = CRS("EPSG:25832").to_wkt("WKT1_GDAL").replace('"scale_factor",0.9996', '"scale_factor",-0.9996')
    with pytest.raises(GeoError, match="PROJ cannot compute"):
        ground_units_m(CRS.from_wkt(text), np.array([589012.0, 5194736.0]))
