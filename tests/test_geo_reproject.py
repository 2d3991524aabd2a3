"""Points from one CRS into another: in plan by PROJ, in height only with a grid."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from pyproj import Transformer

from geo import transformation
from geo.crs import parse_crs
from geo.errors import MissingGrid, MissingVerticalDatum, PlaceMismatch, UnknownCRS, UnsupportedCRS
from geo.reproject import Reprojection

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


def test_the_same_heights_named_again_are_the_same_heights():
    assert Reprojection.between(SOURCE, "EPSG:32632+5783").keeps_height


def test_ellipsoidal_heights_stay_on_the_same_ellipsoid():
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
    with pytest.raises(MissingGrid, match=r"--crs: the transformation from .*EGM96.* to .*EGM2008.* needs egm08\.tif"):
        Reprojection.between(source, "EPSG:25832+3855", where="--crs")


def test_a_way_that_proj_only_guesses_is_refused():
    with pytest.raises(UnsupportedCRS, match="is not known to PROJ; choose another CRS"):
        Reprojection.between(SOURCE, "EPSG:26710")


@pytest.mark.parametrize(
    ("target", "error"), [("nope", UnknownCRS), ("EPSG:5783", UnsupportedCRS), ("EPSG:4978", MissingVerticalDatum)]
)
def test_a_crs_that_is_unknown_or_has_no_place_is_refused(target, error):
    with pytest.raises((error, UnsupportedCRS), match="--crs is"):
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
