"""Lengths on the ground of one unit of a map, whatever the CRS."""

from __future__ import annotations

import numpy as np
import pytest
from pyproj import CRS, Geod, Transformer
from stored_run import run_of, stored_points

from geo.crs import horizontal_unit
from geo.errors import UnsupportedCRS
from geo.projection import ground_units_m, is_to_scale
from survey.export.export import export
from survey.export.product import ExportOptions

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
    """A slope of 20 degrees, and cells of a decimetre on the ground, in `export --slope --crs`."""
    rasterio = pytest.importorskip("rasterio")
    along = np.arange(0.0, 3.0, 0.02)
    x, y = (part.ravel() for part in np.meshgrid(along, along))
    east, north = Transformer.from_crs(4258, 25832, always_xy=True).transform(LON, LAT)
    height = 500.0 + np.tan(np.radians(20.0)) * (0.6 * x + 0.8 * y)
    points = np.column_stack([x + round(east), y + round(north), height])
    run = run_of(stored_points(points, CRS("EPSG:25832+7837")), tmp_path / "run")
    export(run, options=ExportOptions(resolution_m=0.1, crs=code), slope=tmp_path / "s.tif")
    with rasterio.open(tmp_path / "s.tif") as raster:
        slope = raster.read(1, masked=True).compressed()
        assert min(raster.shape) >= 25
        assert max(raster.shape) <= 37
    assert np.median(slope) == pytest.approx(20.0, abs=0.15)


def test_a_map_that_proj_cannot_compute_is_a_sentence():
    """As a damaged .prj has it: PROJ reads the text, and refuses to compute."""
    text = CRS("EPSG:25832").to_wkt("WKT1_GDAL").replace('"scale_factor",0.9996', '"scale_factor",-0.9996')
    with pytest.raises(UnsupportedCRS, match="PROJ cannot compute"):
        ground_units_m(CRS.from_wkt(text), np.array([589012.0, 5194736.0]))
