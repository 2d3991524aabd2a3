"""What an adjustment writes is read back as it was, and its cameras can be given back as [cameras] poses."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from small_survey import TOML, replaced, small_survey

from refract.lens import Lens
from survey.adjust.applied import CAMERAS, apply_adjustment, write_cameras
from survey.adjust.refine import adjust_survey
from survey.adjust.result.adjustment import read_adjustment, write_adjustment
from survey.errors import SurveyError
from survey.folder.survey import Survey, load_survey
from survey.photos.poses import PoseFrame
from survey.pose_files import read_poses, read_ties
from survey.run import products
from tests.block_survey import assert_same, drawn_adjustment, survey_of
from tests.drawn_block import draw_block


@pytest.fixture(scope="module")
def adjusted():
    survey = survey_of(draw_block(3, num_points=60, num_views=12, dry_share=0.35))
    return survey, adjust_survey(survey, use_windows=False)


def test_an_adjustment_is_read_as_it_was_written(adjusted, tmp_path):
    _, found = adjusted
    write_adjustment(tmp_path, found)
    assert_same(read_adjustment(tmp_path), found)
    assert found.control, "a block without control would not show that control is read"
    assert found.statistics.gps_std_m is not None


def test_a_folder_without_an_adjustment_is_refused(tmp_path):
    with pytest.raises(SurveyError, match="has no adjustment"):
        read_adjustment(tmp_path)


def test_cameras_csv_and_the_colmap_model_have_the_adjusted_poses(adjusted, tmp_path):
    survey, found = adjusted
    applied = apply_adjustment(survey, found)
    write_cameras(tmp_path, applied, found)
    by_table, by_model = read_poses(tmp_path / CAMERAS), read_poses(tmp_path / "sparse")
    assert (by_table.frame, by_model.frame) == (PoseFrame.GRID, PoseFrame.LOCAL)
    # Both are poses of an adjustment with bent rays, which no warning of straight ones fits.
    assert (by_table.tool, by_model.tool) == (None, None)
    in_crs, in_local = by_table.poses, by_model.poses
    centres = np.array([pose.centre for pose in in_crs])
    local_from_grid = survey.frame.local_from_grid(centres)
    # The file has hundredths of a millimetre and 1e-8 degrees.
    np.testing.assert_allclose(survey.frame.local_from_crs(centres), found.poses.centres, atol=2e-5)
    for number, (first, second, view) in enumerate(zip(in_crs, in_local, applied.views, strict=True)):
        assert first.name == second.name == view.name
        rotation = first.cam_from_world @ local_from_grid[number].T
        np.testing.assert_allclose(rotation, view.camera.cam_from_local, atol=1e-9)
        np.testing.assert_allclose(second.cam_from_world, view.camera.cam_from_local, atol=1e-12)
        np.testing.assert_allclose(second.centre, view.camera.centre, atol=1e-9)
        assert second.lens == view.lens


def test_the_points_of_the_model_are_where_straight_rays_meet_with_their_tracks(adjusted, tmp_path):
    survey, found = adjusted
    applied = apply_adjustment(survey, found)
    write_cameras(tmp_path, applied, found)
    ties = read_ties(tmp_path / "sparse")
    assert ties is not None
    assert ties.names == tuple(view.name for view in applied.views)
    # All points but those that fewer than three photographs show.
    counts = np.bincount(found.residuals.point, minlength=len(found.points))
    np.testing.assert_array_equal(ties.num_views, counts[counts >= 3])
    np.testing.assert_array_equal(np.bincount(ties.point), ties.num_views)
    true = found.points[counts >= 3]
    dry = np.asarray(applied.water.depth(true)) <= 0.0
    assert 3 < dry.sum() < len(true) - 3
    np.testing.assert_allclose(ties.points[dry], true[dry], atol=0.02)
    # A bed looks a quarter less deep, and more from the side.
    share = np.asarray(applied.water.depth(ties.points[~dry])) / np.asarray(applied.water.depth(true[~dry]))
    assert 0.55 < np.quantile(share, 0.05) < np.quantile(share, 0.95) < 0.77
    # Straight rays to them fall nearer to the pixels than those to the true places.

    def misses(places: np.ndarray) -> np.ndarray:
        pixels = [view.camera.project(places, None) for view in applied.views]
        return np.linalg.norm(np.array(pixels)[ties.image, ties.point] - ties.pixel, axis=1)

    assert np.median(misses(ties.points)) < 0.2 * np.median(misses(true))


LENS = Lens("FULL_OPENCV", (101.3, 101.2, 31.7, 24.4, 0.02, -0.01, 1e-4, -2e-4, 0.003, 0.0, 0.0, 0.0), 64, 48)
GIVEN_BACK = {
    "sparse": 'poses = "sparse"\n',
    "cameras.csv": (
        'poses = "adjusted.csv"\nmodel = "FULL_OPENCV"\nsize_px = [64, 48]\nfocal_px = [101.3, 101.2]\n'
        "principal_point_px = [31.7, 24.4]\n"
        "distortion = [0.02, -0.01, 1e-4, -2e-4, 0.003, 0.0, 0.0, 0.0]\n"
    ),
}


def with_moved_cameras(survey: Survey) -> Survey:
    """The survey with cameras that an adjustment moved and turned a little, and another lens."""
    rng = np.random.default_rng(12)
    views = []
    for view in survey.views:
        turn = Rotation.from_rotvec(0.02 * rng.standard_normal(3)).as_matrix()
        centre = view.camera.centre + 0.05 * rng.standard_normal(3)
        views.append(replace(view, lens=LENS, camera=LENS.pinhole(centre, turn @ view.camera.cam_from_local)))
    return replace(survey, views=tuple(views))


@pytest.mark.parametrize("is_spaced", [False, True])
@pytest.mark.parametrize("name", GIVEN_BACK)
def test_the_adjusted_cameras_can_be_given_back(tmp_path, name, is_spaced):
    folder = small_survey(tmp_path / "small")
    if is_spaced:
        for path in sorted((folder / "images").iterdir()):
            path.rename(path.with_name(f"DJI {path.stem} (2).jpg"))
        cameras = folder / "cameras.csv"
        cameras.write_text(re.sub(r"^(\d+)\.jpg", r"DJI \1 (2).jpg", cameras.read_text(), flags=re.MULTILINE))
    adjusted = with_moved_cameras(load_survey(folder))
    write_cameras(tmp_path, adjusted)
    assert (tmp_path / "sparse" / "images.bin").exists() is is_spaced
    (tmp_path / "sparse").rename(folder / "sparse")
    (tmp_path / "cameras.csv").rename(folder / "adjusted.csv")
    before = TOML.index("[water]")
    origin = list(adjusted.frame.origin)
    (folder / "survey.toml").write_text(
        TOML[: TOML.index("[cameras]")]
        + f"[cameras]\n{GIVEN_BACK[name]}"
        + TOML[before:]
        + f"[local]\norigin = {origin}\n"
    )
    again = load_survey(folder)
    assert [view.name for view in again.views] == [view.name for view in adjusted.views]
    for view, true in zip(again.views, adjusted.views, strict=True):
        place = again.frame.crs_from_local(view.camera.centre[None])
        np.testing.assert_allclose(adjusted.frame.local_from_crs(place)[0], true.camera.centre, atol=1e-6)
        # Level at the two origins is not the same; at 20 m, 5e-8 rad are a micrometre.
        axes, true_axes = (survey.frame.local_from_grid(place)[0] for survey in (again, adjusted))
        grid, true_grid = view.camera.cam_from_local @ axes, true.camera.cam_from_local @ true_axes
        np.testing.assert_allclose(grid, true_grid, atol=5e-8)
        assert view.lens == LENS


@pytest.mark.parametrize("is_binary", [False, True])
def test_a_result_has_all_files_of_the_model(tmp_path, is_binary):
    """The binary ones too, which programs read that cut names at spaces in text."""
    stage, result = tmp_path / "adjust", tmp_path / "result"
    (stage / "sparse").mkdir(parents=True)
    result.mkdir()
    write_adjustment(stage, drawn_adjustment()[1])
    names = {f"{name}.{'bin' if is_binary else 'txt'}" for name in ("cameras", "images", "points3D")}
    names |= {"cameras.txt", "images.txt", "points3D.txt"}
    for name in (*(f"sparse/{name}" for name in names), "cameras.csv"):
        (stage / name).write_text(name)
    assert products.adjustment_of(result, {"adjust": stage}) is not None
    assert {path.name for path in (result / "sparse").iterdir()} == names


def test_the_model_says_how_it_is_given_back(tmp_path):
    survey = load_survey(small_survey(tmp_path / "small"))
    write_cameras(tmp_path, survey)
    first = (tmp_path / "sparse" / "cameras.txt").read_text(encoding="utf-8").splitlines()[0]
    east, north, up = survey.frame.origin
    assert first.endswith(f"[local] origin = [{float(east)!r}, {float(north)!r}, {float(up)!r}]")


def test_where_shutters_roll_the_files_say_how_far_the_cameras_flew_and_are_given_back(tmp_path):
    toml = replaced(("[water]", "rolling_shutter_s = 0.047\nspeed_m_s = 5\n[water]"))
    folder = small_survey(tmp_path / "small", toml=toml)
    survey = load_survey(folder)
    write_cameras(tmp_path, survey)
    first = (tmp_path / "sparse" / "cameras.txt").read_text(encoding="utf-8").splitlines()[0]
    assert 'poses = "sparse", rolling_shutter_s = 0.047 and [local]' in first
    head, *lines = (tmp_path / "cameras.csv").read_text(encoding="utf-8").splitlines()
    assert head.split(",")[-3:] == ["flown_east", "flown_north", "flown_up"]
    for line, view in zip(lines, survey.views, strict=True):
        np.testing.assert_allclose(np.array(line.split(",")[-3:], float), view.camera.motion * 47, atol=1e-7)
    (tmp_path / "cameras.csv").replace(folder / "cameras.csv")
    again = load_survey(folder)
    for view, true in zip(again.views, survey.views, strict=True):
        np.testing.assert_allclose(view.camera.motion, true.camera.motion, rtol=1e-6)
