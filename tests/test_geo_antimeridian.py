"""Shapes across the meridian of 180 degrees: cut there, with all of their area and none beside it."""

import json
from itertools import pairwise

import numpy as np
import pytest
import shapely
from pyproj import CRS, Transformer
from shapely import Polygon

from geo.compatibility import Reprojection, crosses, require_at
from geo.crs import middle_lon_lat, parse_crs
from geo.errors import GeoError, PlaceMismatch
from geo.transformation import WGS84, Transformation
from geo.vectors import Layer, cut_line, cut_polygon, write_geojson
from survey.photos.exif import Exif, utm_code_of

FIJI = CRS("EPSG:3460")


def jumping(plan: np.ndarray) -> np.ndarray:
    """Places with longitudes from 0 to 360 as WGS 84 counts them."""
    return np.column_stack([np.where(plan[:, 0] > 180.0, plan[:, 0] - 360.0, plan[:, 0]), plan[:, 1]])


def continued(ring: np.ndarray) -> np.ndarray:
    """The inverse; 180 and -180 are one meridian."""
    return np.column_stack([np.where(ring[:, 0] < 0.0, ring[:, 0] + 360.0, ring[:, 0]), ring[:, 1]])


def closed(ring: np.ndarray) -> np.ndarray:
    return np.concatenate([ring, ring[:1]])


def star(middle: tuple[float, float], radius: float, seed: int, corners: int = 40) -> np.ndarray:
    """A closed ring with deep bays, which crosses a meridian through it many times."""
    rng = np.random.default_rng(seed)
    angle = np.linspace(0.0, 2.0 * np.pi, corners, endpoint=False)
    length = radius * rng.uniform(0.2, 1.0, corners)
    return closed(np.array(middle) + length[:, None] * np.column_stack([np.cos(angle), np.sin(angle)]))


def comb(teeth: int) -> np.ndarray:
    """A ring whose teeth all cross the meridian."""
    west, east = 179.0, 181.0
    corners = [(178.5, 0.0)]
    for tooth in range(teeth):
        y = 0.5 * tooth
        corners += [(east, y), (east + 0.1 * tooth, y + 0.2), (west, y + 0.25), (west, y + 0.45)]
    return closed(np.array([*corners, (178.5, 0.5 * teeth)]))


def polygon_of(rings: list[np.ndarray]) -> Polygon:
    return Polygon(rings[0], rings[1:])


POLYGONS = {
    **{f"star {seed}": [star((180.0, 0.0), 2.0, seed)] for seed in range(6)},
    **{f"comb {teeth}": [comb(teeth)] for teeth in (1, 2, 5)},
    "a hole on each side": [
        closed(np.array([[178.0, -2.0], [182.0, -2.0], [182.0, 2.0], [178.0, 2.0]])),
        star((179.0, 0.0), 0.5, 1), star((181.0, 0.5), 0.5, 2),
    ],
    "a hole across": [
        closed(np.array([[178.0, -2.0], [182.0, -2.0], [182.0, 2.0], [178.0, 2.0]])), star((180.2, 0.0), 1.0, 3),
    ],
    "two holes across and one beside": [
        closed(np.array([[178.0, -3.0], [182.0, -3.0], [182.0, 3.0], [178.0, 3.0]])),
        star((180.1, -1.5), 1.0, 4), star((179.9, 1.5), 1.0, 5), star((181.3, 0.0), 0.4, 6),
    ],
    "a comb with holes": [comb(4), star((180.3, 0.1), 0.08, 7), star((179.6, 1.1), 0.05, 8)],
}  # fmt: skip


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("name", POLYGONS)
def test_a_polygon_that_was_cut_covers_the_same_places(name, turned):
    rings = [ring[::-1] if turned else ring for ring in POLYGONS[name]]
    parts = cut_polygon([jumping(ring) for ring in rings])
    assert len(parts) >= 2
    for part in parts:
        for ring in part:
            assert np.array_equal(ring[0], ring[-1])
            assert (np.abs(ring[:, 0]) <= 180.0).all()
            assert np.ptp(ring[:, 0]) < 10.0
    assert sum(polygon_of(part).area for part in parts) == pytest.approx(polygon_of(rings).area, rel=1e-9)
    places = np.random.default_rng(1).uniform([177.5, -3.2], [182.5, 3.2], (4000, 2))
    cut = [polygon_of([continued(ring) for ring in part]) for part in parts]
    within = sum(shapely.contains_xy(part, places).astype(int) for part in cut)
    np.testing.assert_array_equal(within, shapely.contains_xy(polygon_of(rings), places).astype(int))


def test_shapes_on_one_side_stay_as_they_are():
    for shift in (-60.0, -2.5, 2.5, 100.0):
        ring = jumping(star((180.0 + shift, 0.0), 2.0, 1))
        assert cut_polygon([ring])[0][0] is ring
        assert cut_line(ring)[0] is ring


@pytest.mark.parametrize("seed", range(5))
def test_a_line_that_was_cut_runs_through_the_same_places(seed):
    rng = np.random.default_rng(seed)
    line = np.column_stack([180.0 + rng.uniform(-1.0, 1.0, 30), np.linspace(0.0, 1.0, 30)])
    parts = cut_line(jumping(line))
    assert not any(crosses(part) for part in parts)
    assert sum(np.linalg.norm(np.diff(part, axis=0), axis=1).sum() for part in parts) == pytest.approx(
        np.linalg.norm(np.diff(line, axis=0), axis=1).sum()
    )
    for before, after in pairwise(parts):
        assert abs(before[-1, 0]) == abs(after[0, 0]) == 180.0
        assert before[-1, 1] == after[0, 1]


@pytest.mark.parametrize("kind", ["LineString", "Polygon"])
def test_geojson_across_the_meridian_has_no_shape_around_the_earth(tmp_path, kind):
    to_grid = Transformer.from_crs(4326, FIJI, always_xy=True)
    ring = np.column_stack(to_grid.transform(*jumping(star((180.0, -17.0), 0.001, 2)).T))
    beside = np.column_stack(to_grid.transform(*jumping(star((179.9, -17.0), 0.001, 2)).T))
    shapes = [[ring], [beside]] if kind == "Polygon" else [ring, beside]
    warning = write_geojson(tmp_path / "s.geojson", Layer("shapes", kind, shapes, FIJI))
    said = json.loads((tmp_path / "s.geojson").read_text())
    first, second = (feature["geometry"] for feature in said["features"])
    assert (first["type"], second["type"]) == (f"Multi{kind}", kind)
    for part in first["coordinates"]:
        assert np.ptp(np.array(part[0] if kind == "Polygon" else part)[:, 0]) < 0.01
    # PROJ knows the datum of Fiji to a metre or so, and says it.
    assert said["bathynerf"]["accuracy_of_wgs84_m"] > 0.0
    assert "by PROJ: an error common to all" in warning


def test_a_geographic_crs_is_refused_on_the_meridian_with_what_is_the_matter():
    crs = CRS("EPSG:3460+5714")
    east, north = Transformer.from_crs(4326, FIJI, always_xy=True).transform([179.9999, -179.9999], [-17.0, -17.0])
    points = np.column_stack([east, north, [0.0, 1.0]])
    way = Reprojection.between(crs, "EPSG:4326")
    with pytest.raises(GeoError, match=r"lies on the meridian of 180 degrees, .* projected CRS of the place"):
        way(points)
    assert np.isfinite(way(points[:1])).all()


@pytest.mark.parametrize("lon", [(179.99, 179.98, -179.99, -179.98), (179.9, 179.8, -179.99), (-179.9, 179.99, -179.8)])
def test_photographs_on_both_sides_have_their_middle_and_their_zone_at_the_meridian(lon):
    places = np.column_stack([lon, np.full(len(lon), -17.0)])
    middle = middle_lon_lat(places)
    assert abs(middle[0]) >= 179.9
    assert middle[1] == -17.0
    zone = utm_code_of({str(x): Exif((64, 48), (-17.0, x, 10.0), None, 1, "", None) for x in lon})
    assert zone in (32701, 32760)
    crs = parse_crs(f"EPSG:{zone}+5773")
    require_at(crs, places, "the photographs", "crs")
    assert np.isfinite(Transformation.between(WGS84, crs, places)(*places.T)).all()
    with pytest.raises(PlaceMismatch, match=r"photographs \(about latitude -17\.000, longitude -?1\d\d\.\d+\) lie"):
        require_at(parse_crs("EPSG:25832+5778"), places, "the photographs", "crs")
