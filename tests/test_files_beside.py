"""What other programs leave beside a file: it goes with the file that is replaced, or keeps it from being replaced."""

import sqlite3

import numpy as np
import pytest
import rasterio

from geo.crs import parse_crs
from geo.files import write_whole
from geo.raster import RasterBand, RasterForm, write_cog
from survey.errors import OutputError
from survey.export.registry import PRODUCTS
from survey.files.paths import ReadFiles, require_file

# Behind the name, or in place of the suffix; by the program that reads them: GDAL, QGIS and ArcGIS, SQLite, LAStools.
BESIDE = {
    ".tif": (".aux.xml", ".ovr", ".msk", ".msk.ovr", "*.tfw", "*.wld", "*.prj", "*.rrd", "*.aux"),
    ".bag": (".aux.xml", ".ovr", ".msk"),
    ".xyz": (".aux.xml", "*.prj"),
    ".gpkg": ("-wal", "-shm", "-journal", ".aux.xml"),
    ".laz": ("*.lax",),
    ".csv": ("*.csvt", "*.prj"),
}


def place(path, ending):
    return path.with_suffix(ending[1:]) if ending.startswith("*") else path.with_name(path.name + ending)


@pytest.mark.parametrize("suffix", sorted({suffix for each in PRODUCTS for suffix in each.suffixes if suffix}))
@pytest.mark.parametrize("is_there", [True, False])
def test_what_described_the_old_file_goes_with_it(tmp_path, suffix, is_there):
    path = tmp_path / f"a.b{suffix}"
    if is_there:
        path.write_bytes(b"old")
    stale = [place(path, ending) for ending in BESIDE.get(path.suffix, ())]
    others = [tmp_path / "a.prj", tmp_path / "a.b.c.tfw", tmp_path / "b.tif.aux.xml", path.with_suffix(".qml")]
    for each in (*stale, *others):
        each.write_bytes(b"beside")
    with write_whole(path) as stream:
        stream.write(b"new")
    assert sorted(tmp_path.iterdir()) == sorted([path, *others])


def test_a_projection_that_may_be_that_of_another_file_stays(tmp_path):
    for name in ("a.shp", "a.prj", "a.tfw"):
        (tmp_path / name).write_bytes(b"")
    with write_whole(tmp_path / "a.tif") as stream:
        stream.write(b"new")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.prj", "a.shp", "a.tif"]


@pytest.mark.parametrize("content", ["height", "slope"])
def test_gdal_states_the_statistics_of_the_new_raster(tmp_path, rng, content):
    path, form = tmp_path / "a.tif", RasterForm(
        parse_crs("EPSG:25832+5783"), (0.25, 0.0, 5e5, 0.0, -0.25, 5.2e6), (40, 30), (RasterBand(content),)
    )  # fmt: skip
    for mean in (580.0, 20.0):
        values = mean + rng.normal(size=(1, 40, 30)).astype(np.float32)
        write_cog(path, form, [(0, 0, values)])
        with rasterio.open(path, "r") as raster:
            found = raster.stats(indexes=[1])[0]
            assert found.mean == pytest.approx(values.mean(), abs=1e-3)
        # As `gdalinfo -stats` and QGIS leave them.
        path.with_name("a.tif.aux.xml").write_text(
            '<PAMDataset><PAMRasterBand band="1"><Metadata><MDI key="STATISTICS_MEAN">580</MDI></Metadata>'
            "</PAMRasterBand></PAMDataset>"
        )


def require(path):
    require_file("--x", path, ReadFiles.of(), kind="a file", is_of_kind=lambda _head: True)


@pytest.mark.parametrize("journal", ["-wal", "-journal"])
def test_changes_that_are_not_in_a_database_yet_keep_it(tmp_path, journal):
    path = tmp_path / "a.gpkg"
    sqlite3.connect(path).close()
    path.write_bytes(b"SQLite format 3\0")
    place(path, journal).write_bytes(b"")
    require(path)
    place(path, journal).write_bytes(b"changes")
    with pytest.raises(OutputError, match=rf"a\.gpkg{journal} holds changes .* close that program, or remove it"):
        require(path)
    path.unlink()
    require(path)


def test_what_people_wrote_about_a_file_keeps_it(tmp_path):
    path = tmp_path / "a.tif"
    (tmp_path / "a.qmd").write_text("<qgis/>")
    require(path)
    path.write_bytes(b"old")
    with pytest.raises(OutputError, match=r"a\.tif, which a\.qmd describes; remove or rename that file"):
        require(path)
