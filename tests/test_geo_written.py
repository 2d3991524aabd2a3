"""What was written is opened once more before it takes its place."""

import laspy
import numpy as np
import pytest
import rasterio
from compare_plane import write_las
from small_disk import file_size_limit

from geo.crs import parse_crs
from geo.errors import UnwritableFile
from geo.files import scratch_array
from geo.raster import RasterBand, RasterForm, stored_crs, write_bag, write_cog

CODES = ["EPSG:25832+5783", "EPSG:32632+4979", "EPSG:2264+6360", "EPSG:4979", "EPSG:4326+5773", "EPSG:3857+5773"]
SHAPE = (90, 70)


def form_of(code: str, nodata=float("nan")) -> RasterForm:
    crs = parse_crs(code)
    transform = (1e-6, 0.0, 9.0, 0.0, -1e-6, 48.0) if crs.is_geographic else (0.25, 0.0, 5e5, 0.0, -0.25, 5.2e6)
    return RasterForm(crs, transform, SHAPE, (RasterBand("height", "metre"), RasterBand("std", "metre")), nodata=nodata)


def values(rng) -> np.ndarray:
    found = rng.normal(size=(2, *SHAPE)).astype(np.float32)
    found[:, :20] = np.nan
    return found


@pytest.mark.parametrize("code", CODES)
def test_every_crs_of_a_survey_reads_from_a_raster_as_it_was_written(tmp_path, rng, code):
    form = form_of(code)
    write_cog(tmp_path / "a.tif", form, [(0, 0, values(rng))])
    # Copied elsewhere alone: nothing may stand in a file beside it.
    assert [path.name for path in tmp_path.iterdir()] == ["a.tif"]
    with rasterio.open(tmp_path / "a.tif") as raster:
        assert raster.crs is not None
        says = raster.tags().get("HEIGHT_DATUM")
    assert (says is None) == (stored_crs(form.crs) == form.crs)


def test_ellipsoidal_heights_are_in_a_bag_and_a_full_disk_refuses_it_in_words_of_the_system_alone(tmp_path, rng, capfd):
    form, parts = form_of("EPSG:32632+4979", nodata=1e6), [(0, 0, np.nan_to_num(values(rng), nan=1e6))]
    write_bag(tmp_path / "a.bag", form, parts, {})
    with rasterio.open(tmp_path / "a.bag") as raster:
        assert "UTM zone 32N" in raster.crs.to_wkt()
        assert "ellipsoidal height" in raster.crs.to_wkt()
    (tmp_path / "a.bag").unlink()
    with pytest.raises(UnwritableFile, match=r"a\.bag: .*write elsewhere"), file_size_limit(1000):
        write_bag(tmp_path / "a.bag", form, parts, {})
    assert list(tmp_path.iterdir()) == []
    # HDF5 writes to the standard error of the process.
    assert capfd.readouterr().err == ""


def test_a_raster_that_was_cut_short_does_not_take_its_place(tmp_path, rng, monkeypatch):
    copy = rasterio.shutil.copy

    def cut(source, target, **options):
        copy(source, target, **options)
        target.write_bytes(target.read_bytes()[: target.stat().st_size // 2])

    monkeypatch.setattr(rasterio.shutil, "copy", cut)
    with pytest.raises(UnwritableFile, match=r"cannot write .*a\.tif"):
        write_cog(tmp_path / "a.tif", form_of("EPSG:25832+5783"), [(0, 0, rng.normal(size=(2, *SHAPE)))])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_a_cloud_that_was_cut_short_does_not_take_its_place(tmp_path, rng, monkeypatch, suffix):
    close = laspy.LasWriter.close

    def cut(writer):
        close(writer)
        writer.dest.truncate(writer.dest.seek(0, 2) // 2)

    monkeypatch.setattr(laspy.LasWriter, "close", cut)
    points = rng.uniform(0.0, 10.0, (500, 3)) + np.array([5e5, 5.2e6, 100.0])
    with pytest.raises(UnwritableFile, match=r"cannot write .*a\.la"):
        write_las(tmp_path / f"a.{suffix}", points, parse_crs("EPSG:25832+5783"))
    assert list(tmp_path.iterdir()) == []


def test_scratch_is_reserved_before_it_is_mapped_and_its_folder_is_named(tmp_path):
    array = scratch_array(tmp_path / "small", "f4", (10, 20))
    assert array.shape == (10, 20)
    assert not array.any()
    with pytest.raises(UnwritableFile, match=r"scratch of \d+ MB does not fit into .*TMPDIR"):
        scratch_array(tmp_path / "large", "f8", (10**8, 10**8))
