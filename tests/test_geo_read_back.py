"""What was written is read again before it takes its place: rasters and clouds with one fault after the other."""

from __future__ import annotations

import errno
from pathlib import Path

import numpy as np
import pytest
import rasterio

from geo.crs import parse_crs
from geo.errors import UnwritableFile
from geo.files import scratch_array
from geo.las import write_cloud
from geo.raster import RasterBand, RasterForm, stored_crs, write_bag, write_cog
from geo.read_back import ValueSums, require_cloud, require_raster

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


def test_ellipsoidal_heights_of_a_projected_crs_are_in_a_bag(tmp_path, rng):
    form = form_of("EPSG:32632+4979", nodata=1e6)
    write_bag(tmp_path / "a.bag", form, [(0, 0, np.nan_to_num(values(rng), nan=1e6))], {})
    with rasterio.open(tmp_path / "a.bag") as raster:
        assert "UTM zone 32N" in raster.crs.to_wkt()
        assert "ellipsoidal height" in raster.crs.to_wkt()


def test_a_bag_on_a_full_disk_is_refused_in_words_of_the_system_alone(tmp_path, rng, monkeypatch, capfd):
    def full(_path, _data):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    form = form_of("EPSG:32632+4979", nodata=1e6)
    with pytest.raises(UnwritableFile, match=r"a\.bag: no space is left on the disk"):
        write_bag(tmp_path / "a.bag", form, [(0, 0, np.nan_to_num(values(rng), nan=1e6))], {})
    assert list(tmp_path.iterdir()) == []
    # HDF5 writes to the standard error of the process.
    assert capfd.readouterr().err == ""


def changed(path, how: str) -> None:
    data = bytearray(path.read_bytes())
    if how == "cut":
        data = data[: len(data) // 2]
    elif how == "zeros":
        data[len(data) // 2 :] = bytes(len(data) - len(data) // 2)
    path.write_bytes(data)


@pytest.mark.parametrize("how", ["cut", "zeros", "moved", "another value", "no crs", "another crs"])
def test_a_raster_with_a_fault_does_not_take_its_place(tmp_path, rng, how):
    form, whole = form_of("EPSG:25832+5783"), values(rng)
    path = tmp_path / "a.tif"
    write_cog(path, form, [(0, 0, whole)])
    sums = [ValueSums(form.nodata) for _ in form.bands]
    for each, band in zip(sums, whole, strict=True):
        each.add(band)
    require_raster(path, path, form.crs, form.transform, SHAPE, sums)
    if how in ("cut", "zeros"):
        changed(path, how)
    else:
        with rasterio.open(path) as raster:
            profile, read = raster.profile | {"driver": "GTiff"}, raster.read()
        profile |= {"no crs": {"crs": None}, "another crs": {"crs": "EPSG:25833+5783"}}.get(how, {})
        profile |= {"transform": rasterio.Affine(*form.transform[:5], 5.3e6)} if how == "moved" else {}
        read[0, 50, 50] += 1.0 if how == "another value" else 0.0
        with rasterio.open(path, "w", **profile) as raster:
            raster.write(read)
    with pytest.raises(UnwritableFile, match=r"cannot write .*a\.tif: "):
        require_raster(path, path, form.crs, form.transform, SHAPE, sums)


@pytest.mark.parametrize("suffix", ["las", "laz"])
@pytest.mark.parametrize("how", ["whole", "cut", "another point", "one point less"])
def test_a_cloud_with_a_fault_does_not_take_its_place(tmp_path, rng, suffix, how):
    num, path = 500, tmp_path / f"a.{suffix}"
    points = rng.uniform(0.0, 10.0, (num, 3)) + np.array([5e5, 5.2e6, 100.0])
    ones = np.ones(num)
    write_cloud(
        path, points, parse_crs("EPSG:25832+5783"), rgb=np.zeros((num, 3), np.uint8), depth_m=ones, std_m=0.01 * ones,
        num_views=ones.astype(int), incidence_deg=ones, is_wet=ones > 0.0,
    )  # fmt: skip
    import laspy

    las, sums = laspy.read(path), ValueSums()
    for axis in (las.X, las.Y, las.Z):
        sums.add(np.asarray(axis, dtype=np.int32))
    if how == "cut":
        changed(path, "cut")
    elif how != "whole":
        if how == "another point":
            las.points.X[7] += 1
        else:
            las.points = las.points[1:]
        las.write(path)
    with path.open("rb") as stream:
        if how == "whole":
            require_cloud(stream, path, num, sums)
            return
        with pytest.raises(UnwritableFile, match=r"cannot write .*: read again, "):
            require_cloud(stream, path, num, sums)


def test_sums_do_not_depend_on_the_order_and_leave_out_what_is_no_data(rng):
    whole = rng.normal(size=1000).astype(np.float32)
    first, second = ValueSums(nodata=-9999.0), ValueSums(nodata=-9999.0)
    first.add(whole)
    for part in np.array_split(rng.permutation(whole), 7):
        second.add(np.concatenate([part, np.float32([np.nan, -9999.0])]))
    assert (first.count, first.total) == (second.count, second.total)


def test_scratch_is_reserved_before_it_is_mapped_and_its_folder_is_named(tmp_path):
    array = scratch_array(tmp_path / "small", "f4", (10, 20))
    assert array.shape == (10, 20)
    assert not array.any()
    with pytest.raises(UnwritableFile, match=r"scratch of \d+ MB does not fit into .*TMPDIR"):
        scratch_array(tmp_path / "large", "f8", (10**8, 10**8))
