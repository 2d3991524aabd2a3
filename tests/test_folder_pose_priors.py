"""What is known of the poses besides the photographs: where it comes from, and in which frame it is."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import ExifTags, Image
from pyproj import CRS
from small_survey import E0, HEADER, LEVEL, N0, replaced, small_survey, unposed, write_image

from geo.errors import GeoError
from geo.frames import LocalFrame
from geo.transformation import WGS84, Transformation
from survey.errors import ImageError
from survey.folder.found import find_survey
from survey.folder.pose_priors import (
    PosePrior,
    accuracy_of_gps,
    accuracy_of_priors,
    common_plan_std,
    common_up_std,
    common_up_std_of_exif,
    priors_of_gps,
)
from survey.folder.sfm_views import require_solvable
from survey.folder.survey import load_survey
from survey.photos.cameras import View
from survey.photos.xmp import Rtk
from survey.sfm.gps import gps_positions
from survey.sfm.solve import sensors_of
from survey.stage_key import stage_key

# Twice the way from crs to local is exact to 2e-8 m, and seconds of arc in EXIF have seven digits: 3 micrometres.
ROUNDING_M = 1e-5


def gps_priors(found, origin: tuple[float, float, float] = (E0, N0, LEVEL)) -> dict[str, PosePrior]:
    """Priors of views with no more than the name: they do not look at cameras."""
    views = [View(name, Path(name), None, None) for name in found.images]
    return priors_of_gps(found, LocalFrame(found.crs, origin), views)


def test_poses_of_a_file_are_known_to_what_survey_toml_says(tmp_path):
    toml = replaced(("[water]", "position_std_m = [0.02, 0.03, 0.05]\nrotation_std_deg = 0.01\n[water]"))
    survey = load_survey(small_survey(tmp_path / "s", toml=toml))
    assert list(survey.observations.priors) == [view.name for view in survey.views]
    for view in survey.views:
        prior = survey.observations.priors[view.name]
        assert (prior.position == view.camera.centre).all()
        assert prior.position_std.tolist() == [0.02, 0.03, 0.05]
        assert prior.rotation_std_deg.tolist() == [0.01, 0.01, 0.01]
        assert prior.source == "survey.toml"


def test_poses_of_a_file_without_an_accuracy_are_of_unknown_accuracy(tmp_path):
    survey = load_survey(small_survey(tmp_path / "s", gps=True))
    prior = survey.observations.priors["0001.jpg"]
    assert (prior.position_std, prior.rotation_std_deg, prior.source) == (None, None, "poses file")
    assert accuracy_of_priors(survey.observations.priors) == "4 of 4 positions of unknown accuracy (poses file)"


@pytest.mark.parametrize("fall", [0.0, 20.0])
def test_gps_positions_are_in_the_frame_of_the_views_however_far_it_was_lowered(tmp_path, fall):
    found = find_survey(unposed(tmp_path / "s", ("[water]", "position_std_m = 0.04\n[water]")))
    frame = LocalFrame(found.crs, (E0 + 4.0, N0 - 3.0, LEVEL + 20.0 - fall))
    priors = gps_priors(found, frame.origin)
    aside = np.array([[1.0, 1.0, 0.0], [-1.0, -1.0, 0.0]])
    expected = [[E0 + 3.0 * i, N0 - 2.0 * i, LEVEL + 20.0] + aside[i % 2] for i in range(4)]
    local = np.array([prior.position for prior in priors.values()])
    assert np.abs(local - frame.local_from_crs(expected)).max() < ROUNDING_M
    # As the residuals of structure from motion have it: straight down from the frame of the positions.
    gps = gps_positions(found.headers, found.crs, "crs")
    below = gps_priors(found, (*gps.frame.origin[:2], gps.frame.origin[2] - fall))
    assert np.abs(below["0002.jpg"].position - (gps.local["0002.jpg"] + [0.0, 0.0, fall])).max() < ROUNDING_M
    # Nine metres from the origin, local and crs differ by scale and convergence only.
    assert np.abs(local[:, 2] - fall).max() < 1e-3
    assert {prior.source for prior in priors.values()} == {"survey.toml"}
    assert priors["0000.jpg"].position_std.tolist() == [0.04, 0.04, 0.04]


@pytest.mark.parametrize(
    ("good", "other", "std", "source"),
    [
        (
            {"rtk": Rtk(50, (0.011, 0.012, 0.025))},
            {"rtk": Rtk(34, (0.01, 0.01, 0.02))},
            (0.011, 0.012, 0.025),
            "XMP RTK",
        ),
        ({"std_m": (0.02, 0.02, 0.03)}, {"std_m": (1.2, 1.2, 1.7)}, (0.02, 0.02, 0.03), "stated accuracy"),
    ],
)
def test_a_fixed_receiver_and_centimetres_of_another_maker_are_believed_and_no_other(
    tmp_path, good, other, std, source
):
    found = find_survey(unposed(tmp_path / "s"))
    headers = dict(found.headers)
    headers["0000.jpg"] = replace(headers["0000.jpg"], **good)
    headers["0001.jpg"] = replace(headers["0001.jpg"], **other)
    found = replace(found, headers=headers)
    priors = gps_priors(found)
    assert [prior.source for prior in priors.values()] == [source, "GPS EXIF", "GPS EXIF", "GPS EXIF"]
    assert (tuple(priors["0000.jpg"].position_std), priors["0001.jpg"].position_std) == (std, None)
    assert [prior.common_up_std for prior in priors.values()] == [0.0, 80.0, 80.0, 80.0]
    assert common_up_std(priors) == common_up_std_of_exif(found.config.cameras, found.headers) == 0.0
    assert accuracy_of_gps(found.config.cameras, found.headers) == accuracy_of_priors(priors)
    assert accuracy_of_priors(priors) == (
        f"1 of 4 positions good to {std[0]}, {std[1]} and {std[2]} m east, north and up ({source}); "
        "3 of 4 positions of unknown accuracy (GPS EXIF)"
    )


@pytest.mark.parametrize(("stated", "common"), [("0.05", 0.0), ("2.0", 2.0), ("[3.0, 3.0, 70.0]", 70.0)])
def test_heights_that_are_good_to_decimetres_or_worse_have_their_error_in_common(tmp_path, stated, common):
    found = find_survey(unposed(tmp_path / "s", ("[water]", f"position_std_m = {stated}\n[water]")))
    assert common_up_std(gps_priors(found)) == common
    assert common_up_std_of_exif(found.config.cameras, found.headers) == common
    posed = load_survey(small_survey(tmp_path / "p", toml=replaced(("[water]", f"position_std_m = {stated}\n[water]"))))
    assert common_up_std(posed.observations.priors) == 0.0


BRITISH = (1.3107334884, 52.6276035206)  # WGS 84 of a place that OSTN15 has at 624161, 308459.58


def british(folder: Path, cameras: str) -> Path:
    """Photographs with GPS positions about a public place, in the national grid; PROJ has no grid of its datum."""
    folder = small_survey(folder, toml=None)
    (folder / "cameras.csv").unlink()
    for i, image in enumerate(sorted((folder / "images").iterdir())):
        lon, lat = BRITISH[0] + 3e-5 * (i % 2), BRITISH[1] + 3e-5 * (i // 2)
        write_image(image, FocalLengthIn35mmFilm=50)
        with_gps(image, lon, lat, 22.0)
    head = 'crs = "EPSG:27700+5701"\n[cameras]\nfocal_px = 100.0\n'
    (folder / "survey.toml").write_text(f"{head}{cameras}\n[water]\nlevel_m = 2.0\n")
    return folder


def with_gps(path: Path, lon: float, lat: float, height: float) -> None:
    with Image.open(path) as image:
        exif = image.getexif()
        gps = exif.get_ifd(ExifTags.IFD.GPSInfo)
        for ref, tag, letter, value in ((1, 2, "N", lat), (3, 4, "E", lon)):
            gps[ref], gps[tag] = letter, (int(value), int(value % 1 * 60), round(value * 60 % 1 * 60, 7))
        gps[5], gps[6] = b"\0", height
        image.save(path, quality=90, exif=exif)


def is_grid_missing() -> bool:
    return bool(Transformation.between(WGS84, CRS("EPSG:27700"), np.array([BRITISH])).missing_grids)


needs_no_grid = pytest.mark.skipif(not is_grid_missing(), reason="the grid of OSTN15 is installed")


def test_photographs_without_poses_have_the_size_of_the_settings(tmp_path):
    with pytest.raises(ImageError, match=r"0000\.jpg has 64 x 48 pixels, expected 800 x 600"):
        require_solvable(find_survey(british(tmp_path / "s", "size_px = [800, 600]")))


@needs_no_grid
@pytest.mark.parametrize("std", ["0.02", "[0.05, 0.05, 9.0]"])
def test_good_positions_are_refused_where_a_grid_would_keep_them_good(tmp_path, std):
    with pytest.raises(GeoError, match=r"GPS positions are good to 0.0[25] m, .* has 2 m: .*OSTN15.*or give 3 contr"):
        require_solvable(find_survey(british(tmp_path / "s", f"position_std_m = {std}")))


@needs_no_grid
@pytest.mark.parametrize(("cameras", "std"), [("", None), ("position_std_m = 2.5", 2.5)])
def test_what_a_change_of_datums_costs_is_shared_by_all_positions_and_said(tmp_path, cameras, std):
    found = find_survey(british(tmp_path / "s", cameras))
    priors = gps_priors(found, (624161.0, 308459.0, 2.0))
    assert {prior.common_plan_std for prior in priors.values()} == {2.0} == {common_plan_std(priors)}
    assert any("with an accuracy of 2 m by PROJ" in warning for warning in found.findings.warnings)
    assert accuracy_of_gps(found.config.cameras, found.headers, found.datum) == accuracy_of_priors(priors)
    assert "plus 2 m in plan in common" in accuracy_of_priors(priors)
    # Where control decides they are widened by it.
    held = priors["0000.jpg"].held_by_control()
    assert held.common_plan_std == 0.0
    assert (None if held.position_std is None else held.position_std[:2].tolist()) == (std and [np.hypot(std, 2.0)] * 2)


@needs_no_grid
def test_poses_of_a_file_count_as_exact_and_are_refused_alike(tmp_path):
    folder = british(tmp_path / "s", 'poses = "cameras.csv"\nmodel = "PINHOLE"\nsize_px = [64, 48]')
    lines = [
        f"{i:04d}.jpg,{BRITISH[0] + 3e-5 * (i % 2):.8f},{BRITISH[1] + 3e-5 * (i // 2):.8f},22.0,0,0,0" for i in range(4)
    ]
    text = "\n".join(["# CoordinateSystem: EPSG:4326", HEADER, *lines])
    (folder / "cameras.csv").write_text(text + "\n")
    with pytest.raises(GeoError, match=r"the poses are taken as exact, .* has 2 m: .*OSTN15"):
        load_survey(folder)
    toml = (folder / "survey.toml").read_text()
    (folder / "survey.toml").write_text(toml.replace("focal_px", "position_std_m = 2.0\nfocal_px"))
    assert load_survey(folder).plan_std_m == 2.0


def test_a_photograph_without_a_position_or_its_height_has_no_prior(tmp_path):
    found = find_survey(unposed(tmp_path / "s", ("[water]", "position_std_m = 0.04\n[water]")))
    headers = dict(found.headers)
    lat, lon, _ = headers["0003.jpg"].lat_lon_height
    headers["0003.jpg"] = replace(headers["0003.jpg"], lat_lon_height=(lat, lon, float("nan")))
    found = replace(found, headers=headers)
    priors = gps_priors(found)
    assert (priors["0003.jpg"].position, priors["0003.jpg"].position_std) == (None, None)
    assert "1 of 4 positions not known" in accuracy_of_priors(priors)
    assert accuracy_of_gps(found.config.cameras, found.headers) == accuracy_of_priors(priors)


def test_priors_make_a_key_that_changes_with_them(tmp_path):
    def key_of(std: str) -> str:
        toml = replaced(("[water]", f"position_std_m = {std}\n[water]"))
        return stage_key(load_survey(small_survey(tmp_path / std, toml=toml)).observations.priors)

    assert key_of("0.02") != key_of("0.03")
    assert key_of("0.02") == key_of("[0.02, 0.02, 0.02]")


@pytest.mark.parametrize("told_by", ["camera", "serial", "focal_warning"])
def test_photographs_of_two_cameras_get_a_lens_for_each(tmp_path, told_by):
    found = find_survey(unposed(tmp_path / "s"))
    headers = {
        name: replace(head, **{told_by: f"camera {i % 2}"}) for i, (name, head) in enumerate(found.headers.items())
    }
    sensors = sensors_of(headers, None)
    assert [sensor.names for sensor in sensors] == [("0000.jpg", "0002.jpg"), ("0001.jpg", "0003.jpg")]
