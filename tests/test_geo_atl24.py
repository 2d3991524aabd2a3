"""ICESat-2 ATL24 as a reference: files in the layout of the product, drawn over a level bed."""

from dataclasses import replace

import numpy as np
import pytest
from compare_plane import compared, grid, write_las
from pyproj import CRS, Transformer

from geo import GeoError, LocalFrame
from geo.atl24 import read_atl24
from survey.errors import ControlError
from survey.folder.control import find_control
from survey.photos.exif import Exif
from survey.settings.tables import ControlConfig

h5py = pytest.importorskip("h5py", reason="h5py is not installed: pip install 'bathynerf[atl24]'")

ON_GEOID = CRS("EPSG:32632+3855")
FRAME = LocalFrame(ON_GEOID, (500000.0, 5194736.0, -4.0))
# The product lies lower than the cloud by so much, and its photons scatter; the geoid over the ellipsoid.
LOWER_M, STD_M, UNDULATION_M = 0.20, 0.15, 48.0
TYPES = {
    "lon_ph": "f8", "lat_ph": "f8", "delta_time": "f8", "ellipse_h": "f4", "ortho_h": "f4", "surface_h": "f4",
    "class_ph": "i1", "confidence": "f8", "low_confidence_flag": "u1", "sensor_depth_exceeded": "u1",
    "sigma_tvu": "f4", "sigma_thu": "f4", "x_atc": "f8", "y_atc": "f4", "index_ph": "i4", "index_seg": "i4",
    "night_flag": "u1", "invalid_kd": "u1", "invalid_wind_speed": "u1",
}  # fmt: skip


@pytest.fixture(scope="module")
def cloud(tmp_path_factory):
    """A level bed 4 m under the geoid, of 40 m by 40 m."""
    return write_las(tmp_path_factory.mktemp("atl24") / "c.las", FRAME.crs_from_local(4.0 * grid(0.0625)), crs=ON_GEOID)


@pytest.fixture(scope="module")
def granule(tmp_path_factory):
    """Two beams 10 m apart: bed, every tenth photon sea surface, every seventh of low confidence and 3 m too high."""
    path, rng = tmp_path_factory.mktemp("atl24") / "ATL24_drawn_01.h5", np.random.default_rng(3)
    with h5py.File(path, "w") as file:
        file["ancillary_data/atlas_sdp_gps_epoch"] = [1198800018.0]
        for beam, x in (("gt1l", -5.0), ("gt2r", 5.0)):
            along = np.arange(-60.0, 60.0, 0.35)
            number = np.arange(len(along))
            is_surface, is_low = number % 10 == 0, number % 7 == 1
            local = np.column_stack([np.full(len(along), x), along, np.zeros(len(along))])
            lon, lat = Transformer.from_crs(32632, 4326, always_xy=True).transform(
                *FRAME.crs_from_local(local)[:, :2].T
            )
            height = -4.0 - LOWER_M + rng.normal(0.0, STD_M, len(along)) + 3.0 * is_low
            height = np.where(is_surface, 0.0, height)
            values = {
                "lon_ph": lon, "lat_ph": lat, "ortho_h": height, "ellipse_h": height + UNDULATION_M,
                "class_ph": np.where(is_surface, 41, 40), "low_confidence_flag": is_low, "sigma_tvu": STD_M,
                "sigma_thu": 7.0,
            }  # fmt: skip
            for name, kind in TYPES.items():
                file[f"{beam}/{name}"] = np.broadcast_to(values.get(name, 0), len(along)).astype(kind)
        file.create_group("gt3l")
    return path


def test_photons_of_the_bed_are_check_points_with_their_own_uncertainty(cloud, granule):
    found = compared(cloud, granule)
    asprs = found["asprs"]
    # 343 photons of each beam, of which 115 lie over the cloud, less one in ten and one in seven.
    assert 150 < asprs["n_checkpoints"] < 190
    residuals = [row["residual_m"] for row in asprs["residuals"] if row["residual_m"] is not None]
    assert np.mean(residuals) == pytest.approx(LOWER_M, abs=4.0 * STD_M / np.sqrt(len(residuals)))
    assert np.std(residuals) == pytest.approx(STD_M, rel=0.2)
    assert any("0.15 m in height and 7.0 m in place" in note for note in found["notes"])


def test_they_are_check_points_beside_another_reference_and_of_a_survey(cloud, granule, tmp_path):
    reference = write_las(tmp_path / "r.las", FRAME.crs_from_local(4.0 * grid(0.125)), crs=ON_GEOID)
    found = compared(cloud, reference, checkpoints=granule)
    assert found["asprs"]["n_checkpoints"] == compared(cloud, granule)["asprs"]["n_checkpoints"]
    assert any("no tide enters" in note for note in found["notes"])
    low, high = FRAME.crs_from_local(np.array([[-4.0, -4.0, 0.0], [4.0, 4.0, 0.0]]))[:, :2]
    lons, lats = Transformer.from_crs(32632, 4326, always_xy=True).transform(*np.array([low, high]).T)
    headers = {str(i): Exif((640, 480), (lats[i], lons[i], 60.0), None, 1, "", 16.0) for i in (0, 1)}
    control, findings = find_control(granule.parent, ControlConfig(checkpoints=granule.name), ON_GEOID, headers)
    # The box of the positions, 16 m larger on each side, is that of the cloud; one position has the same beams.
    over_cloud = found["asprs"]["n_checkpoints"] + found["asprs"]["n_not_covered"]
    assert len(control.checkpoints) == pytest.approx(over_cloud, abs=2)
    one, config = {"0": headers["0"]}, ControlConfig(checkpoints=granule.name)
    assert len(find_control(granule.parent, config, ON_GEOID, one)[0].checkpoints) > 0.7 * over_cloud
    low = find_control(granule.parent, config, ON_GEOID, {"0": replace(one["0"], above_start_m=None)}, 48.0)[0]
    assert 0.5 * over_cloud < len(low.checkpoints) < 0.7 * over_cloud
    far = {"0": replace(one["0"], lat_lon_height=(0.0, 0.0, 60.0))}
    with pytest.raises(GeoError, match=r"0\.0001, 16 m \(the flying height\) about the GPS positions; get"):
        find_control(granule.parent, config, ON_GEOID, far)
    point = control.checkpoints[0]
    assert point.std_m == pytest.approx((7.0, 7.0, STD_M))
    assert point.place[2] == pytest.approx(-4.0 - LOWER_M, abs=5.0 * STD_M)
    assert any("no tide enters" in sentence for sentence in findings.assumptions)
    with pytest.raises(ControlError, match="have none: compare the cloud by bathynerf compare"):
        find_control(granule.parent, ControlConfig(checkpoints=granule.name), ON_GEOID, {})


def test_ellipsoidal_heights_are_used_where_the_cloud_has_these(granule):
    places = FRAME.crs_from_local(4.0 * grid(2.0))
    found = read_atl24(granule, CRS("EPSG:32632").to_3d(), places)
    assert np.median(found.points[:, 2]) == pytest.approx(-4.0 - LOWER_M + UNDULATION_M, abs=0.1)
    on_geoid = read_atl24(granule, ON_GEOID, places)
    np.testing.assert_allclose(found.points[:, :2], on_geoid.points[:, :2], atol=1e-6)
    assert (found.extra["std_plan"] == 7.0).all()


def test_other_files_and_places_are_refused(granule, tmp_path):
    with pytest.raises(GeoError, match=r"none of the \d+ photons of the bed .* lies over the survey, at longitude"):
        read_atl24(granule, ON_GEOID, FRAME.crs_from_local(grid(1.0) + np.array([5000.0, 0.0, 0.0])))
    (tmp_path / "other.h5").write_bytes(b"no HDF5")
    with h5py.File(tmp_path / "empty.h5", "w") as file:
        file.create_group("gt1l")
    for name in ("other.h5", "empty.h5"):
        with pytest.raises(GeoError, match=r"cannot be read as ATL24 .* download the granule again"):
            read_atl24(tmp_path / name, ON_GEOID, FRAME.crs_from_local(grid(1.0)))
