"""`bathynerf render`: pictures of a bed from poses in a file, and what is said where they cannot be made."""

import json
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import rasterio
from painted_survey import DEPTH_M, EXPOSURES, SLOPE, painted_survey, run_over
from PIL import Image
from plane_field import field_over, level_layer
from plane_survey import PlaneBed
from pyproj import CRS
from scipy.spatial.transform import Rotation

from fields.sweep.maps import HeightMap
from geo.frames import LocalFrame
from refract import FlatWater, PinholeCamera
from refract.lens import Lens
from survey.errors import OutputError, SurveyError
from survey.export.novel_views import attenuation_per_metre, log_exposures
from survey.export.render import flown, render, targets_of
from survey.folder.survey import load_survey
from survey.photos.cameras import View
from survey.progress import Progress
from survey.run.flight import load_flight, save_flight
from survey.run.folder import RunDir
from survey.run.stage_sweep import MAPS
from survey.run.stored_maps import save_maps
from survey.run.trained_field import save_layer_field
from survey.settings.config import CamerasConfig, SurveyConfig, dump_config

ORIGIN = (691000.0, 5334000.0, 500.0)
OPTICS = FlatWater((0.0, 0.0, 0.5))
TABLE = "image,easting,northing,height,omega,phi,kappa\n"
ABOVE = "nadir.jpg,691000,5334000,509,0,0,0\n"
LENS = CamerasConfig(size_px=(40, 30), focal_px=200.0)


@pytest.fixture
def frame():
    return LocalFrame(CRS("EPSG:25832+5783"), ORIGIN)


@pytest.fixture
def run(tmp_path, frame):
    """A run whose field is a level bed 2 m under the water at local z = 0.5."""
    with RunDir(tmp_path / "run") as folder:
        stage = folder.open_stage("field")
        # Straight down heights count from the water at local z = 0.5.
        save_layer_field(stage, field_over(level_layer(-1.5), OPTICS))
        stage = folder.finish_stage("field", {}, stage)
        result = folder.open_result("fine")
        unknown = SimpleNamespace(departure=None)
        save_flight(result, SimpleNamespace(frame=frame, water=OPTICS, bounds=None, observations=unknown, views=()))
        settings = dump_config(SurveyConfig(crs="EPSG:25832+5783", cameras=LENS))
        (result / "settings.toml").write_text(settings, encoding="utf-8")
        folder.publish(result, quality="fine", stages={"field": stage})
    return tmp_path / "run"


def poses(tmp_path, lines: str):
    path = tmp_path / "cameras.csv"
    path.write_text(TABLE + lines, encoding="utf-8")
    return path


@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
def test_a_camera_gets_four_pictures(run, tmp_path):
    (path,) = render(run, poses(tmp_path, ABOVE), tmp_path / "new" / "views", device="cpu", trained=True)
    assert path == tmp_path / "new" / "views" / "nadir.png"
    assert sorted(p.name for p in path.parent.iterdir()) == [
        "nadir.png", "nadir_distance.tif", "nadir_height.tif", "nadir_normal.png",
    ]  # fmt: skip
    with Image.open(path) as image:
        assert (image.mode, image.size) == ("RGBA", (40, 30))
    with rasterio.open(path.with_name("nadir_height.tif")) as raster:
        assert raster.descriptions == ("height of the bed over the plane of the water",)
        assert raster.units == ("metre",)
        assert np.isnan(raster.nodata)
    height = np.asarray(Image.open(path.with_name("nadir_height.tif")))
    assert height.dtype == np.float32
    np.testing.assert_allclose(height, -2.0, atol=5e-4)
    distance = np.asarray(Image.open(path.with_name("nadir_distance.tif")))
    assert distance.min() == pytest.approx(10.5, abs=2e-3)  # 8.5 m of air, 2 m of water
    up = np.asarray(Image.open(path.with_name("nadir_normal.png")))
    np.testing.assert_allclose(up, np.broadcast_to([127.5, 127.5, 255, 255], up.shape), atol=0.5)


def test_a_picture_is_seen_through_the_lens_of_its_camera(run, tmp_path):
    settings = RunDir(run).settings_path
    lens = replace(LENS, model="OPENCV", distortion=(2.0, 0.0, 0.01, -0.02))
    settings.write_text(dump_config(SurveyConfig(crs="EPSG:25832+5783", cameras=lens)), encoding="utf-8")
    (path,) = render(run, poses(tmp_path, ABOVE), tmp_path, device="cpu", trained=True)
    distance = np.asarray(Image.open(path.with_name("nadir_distance.tif")))
    # Over level water and a level bed the length of a path tells where it looks.
    camera = Lens("OPENCV", (200.0, 200.0, 20.0, 15.0, *lens.distortion), 40, 30).camera(np.zeros(3), np.eye(3))
    fall = camera.directions(camera.pixel_centres())[..., 2]
    in_water = np.sqrt(1.0 - (1.0 - fall**2) / FlatWater((0.0, 0.0, 0.0)).n_water ** 2)
    np.testing.assert_allclose(distance, 8.5 / fall + 2.0 / in_water, atol=2e-3)
    straight = replace(camera, distortion=None)
    assert np.abs(8.5 / straight.directions(camera.pixel_centres())[..., 2] - 8.5 / fall).max() > 4e-3


def test_a_camera_that_looks_elsewhere_is_named(run, tmp_path, capsys):
    lines = ABOVE + "far.jpg,691500,5334000,509,0,0,0\n"
    with Progress(verbosity=0):
        render(run, poses(tmp_path, lines), tmp_path, device="cpu", trained=True)
    assert "1 of 2 cameras see nothing of the bed: far.jpg" in capsys.readouterr().err
    assert not np.asarray(Image.open(tmp_path / "far.png")).any()


def test_a_run_without_a_field_is_told_how_to_get_one(tmp_path):
    with RunDir(tmp_path / "run"):
        pass
    with pytest.raises(SurveyError, match="has no trained field; run `bathynerf process` again with --field mdw"):
        render(tmp_path / "run", poses(tmp_path, ABOVE), tmp_path, trained=True)


def test_a_photograph_is_not_overwritten_by_the_picture_of_its_camera(run, tmp_path):
    views = tmp_path / "views"
    render(run, poses(tmp_path, ABOVE), views, device="cpu", trained=True)
    render(run, poses(tmp_path, ABOVE), views, device="cpu", trained=True, dry=True)
    Image.new("RGB", (40, 30)).save(views / "nadir.png")
    before = (views / "nadir.png").read_bytes()
    with pytest.raises(
        OutputError, match=r"-o names .*nadir\.png, which exists and is not a picture that render wrote"
    ):
        render(run, poses(tmp_path, ABOVE), views, device="cpu", trained=True)
    assert (views / "nadir.png").read_bytes() == before


@pytest.mark.parametrize("place", ["images", "images/views", "run/stages/field", "run/pictures"])
def test_pictures_do_not_go_among_photographs_nor_into_the_run_s_own_folders(run, tmp_path, place):
    (tmp_path / "survey.toml").write_text('crs = "EPSG:25832+5783"')
    (tmp_path / "images").mkdir()
    with pytest.raises(OutputError, match="whose files are read; name a folder elsewhere"):
        render(run, poses(tmp_path, ABOVE), tmp_path / place, device="cpu", trained=True)
    assert not list((tmp_path / "images").iterdir())


def test_a_camera_with_the_path_of_a_photograph_does_not_leave_the_folder(run, tmp_path):
    for name in ("../nadir.jpg", str(tmp_path / "nadir.jpg")):
        with pytest.raises(OutputError, match=rf"the camera {name} in .*cameras\.csv would be written outside of"):
            render(
                run, poses(tmp_path, ABOVE.replace("nadir.jpg", name)), tmp_path / "views", device="cpu", trained=True
            )
    assert not (tmp_path / "nadir.png").exists()


def test_a_flight_along_cameras_is_a_video(run, tmp_path):
    keys = ABOVE + "later.jpg,691001,5334000,510,0,0,0\nlast.jpg,691001,5334001,509,0,0,20\n"
    (path,) = render(run, poses(tmp_path, keys), tmp_path / "v", device="cpu", trained=True, video_s=0.4)
    assert path == tmp_path / "v" / "flight.mp4"
    assert [each.name for each in path.parent.iterdir()] == ["flight.mp4"]
    video = cv2.VideoCapture(str(path))
    frames = []
    while (read := video.read())[0]:
        frames.append(read[1])
    assert np.array(frames).shape == (10, 30, 40, 3)
    # Compressed, but the same bed: what a key shows alone.
    render(run, poses(tmp_path, keys), tmp_path / "p", device="cpu", trained=True)
    with Image.open(tmp_path / "p" / "nadir.png") as picture:
        alone = np.asarray(picture).astype(int)
    assert np.abs(frames[0][..., ::-1].astype(int) - alone[..., :3] * (alone[..., 3:] > 0)).mean() < 8.0
    path.write_bytes(b"notes of somebody")
    with pytest.raises(OutputError, match="exists and is not an MP4"):
        render(run, poses(tmp_path, keys), tmp_path / "v", device="cpu", trained=True, video_s=0.4)
    assert path.read_bytes() == b"notes of somebody"
    with pytest.raises(SurveyError, match="a video needs two cameras at least"):
        render(run, poses(tmp_path, ABOVE), tmp_path / "v", device="cpu", trained=True, video_s=1.0)


def test_a_flight_passes_its_keys_and_does_not_overshoot():
    place = np.array([[0.0, 0.0, 9.0], [4.0, 0.0, 9.0], [4.0, 3.0, 12.0]])
    turns = Rotation.from_euler("zx", [[0, 180], [30, 170], [90, 160]], degrees=True).as_matrix()
    keys = [PinholeCamera(at, turn, 50.0, 50.0, 20.0, 15.0, 41, 30) for at, turn in zip(place, turns, strict=True)]
    cameras = flown(keys, 2.04)
    assert len(cameras) == 51
    for at, key in ((0, 0), (25, 1), (50, 2)):
        np.testing.assert_allclose(cameras[at].centre, place[key], atol=1e-9)
        np.testing.assert_allclose(cameras[at].cam_from_local, turns[key], atol=1e-9)
    centres = np.array([camera.centre for camera in cameras])
    assert (centres >= place.min(axis=0) - 1e-9).all()
    assert (centres <= place.max(axis=0) + 1e-9).all()
    assert {(camera.width, camera.height) for camera in cameras} == {(40, 30)}


def test_a_camera_path_of_nerfstudio_is_in_the_local_frame_of_the_run(run, frame, tmp_path):
    matrix = np.eye(4)  # Looks down from 9 m over the origin, in a frame a tenth as large and 2 m higher
    matrix[2, 3] = 0.1 * (9.0 + 2.0)
    views = [{"camera_to_world": matrix.ravel().tolist(), "fov": 40.0}]
    given = {"render_width": 60, "render_height": 40, "camera_path": views}
    (tmp_path / "path.json").write_text(json.dumps(given))
    lifted = np.eye(4)[:3]
    lifted[2, 3] = 2.0
    beside = {"transform": lifted.tolist(), "scale": 0.1}
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps(beside))
    (target,) = targets_of(RunDir(run), frame, tmp_path / "path.json", tmp_path / "out")
    np.testing.assert_allclose(target.camera.centre, [0.0, 0.0, 9.0], atol=1e-9)
    np.testing.assert_allclose(target.camera.cam_from_local, np.diag([1.0, -1.0, -1.0]), atol=1e-9)


def test_poses_off_the_map_are_refused(run, tmp_path):
    with pytest.raises(SurveyError, match=r"of nadir\.jpg in .*cameras\.csv is not on the map"):
        render(run, poses(tmp_path, ABOVE.replace("691000", "1e11")), tmp_path, device="cpu", trained=True)


@pytest.fixture
def photographed(tmp_path):
    """The folder of a survey with painted photographs in four exposures, and a run with exact height maps."""
    survey = painted_survey(tmp_path / "s")
    path = run_over(survey, tmp_path / "painted run")
    bed = PlaneBed(survey.water, survey.water.point[2] - DEPTH_M, SLOPE)
    with RunDir(path) as folder:
        stages = {name: folder.stages_path / stage for name, stage in folder.result()["stages"].items()}
        stage = folder.open_stage("sweep")
        save_maps(stage / MAPS, HeightMap, [map_of(bed, number, view) for number, view in enumerate(survey.views)])
        stages["sweep"] = folder.finish_stage("sweep", {}, stage)
        result = folder.open_result("standard")
        (result / "plan.json").write_text(json.dumps({"image_scale": 1.0}))
        (result / "settings.toml").write_text(dump_config(survey.config), encoding="utf-8")
        save_flight(result, survey)
        folder.publish(result, quality="standard", stages=stages)
    return tmp_path / "s", path


def map_of(bed: PlaneBed, number: int, view: View) -> HeightMap:
    height = bed.true_height(view.camera).astype(np.float32)
    confirmed, score = np.full(height.shape, 3, dtype=np.uint8), np.ones(height.shape, dtype=np.float16)
    return HeightMap(number, height, score, confirmed, 0.0 * score)


def test_a_lens_that_no_file_has_is_that_of_the_run(photographed, tmp_path):
    folder, run = photographed
    given, flight = RunDir(run), load_flight(run)
    given.settings_path.write_text(dump_config(SurveyConfig(crs=flight.frame.crs.to_string())))
    lens = flight.views[0].lens
    targets = targets_of(given, flight.frame, folder / "cameras.csv", tmp_path / "views")
    assert {(each.camera.width, each.camera.fx) for each in targets} == {(lens.width, lens.focal[0])}
    # Of several each photograph has its own, and other cameras have none.
    other, first = replace(lens, params=(50.0, *lens.params[1:])), load_survey(folder).views[0].name
    views = [replace(view, lens=other if view.name == first else view.lens) for view in flight.views]
    save_flight(run, replace(load_survey(folder), views=views))
    targets = targets_of(given, flight.frame, folder / "cameras.csv", tmp_path / "views")
    assert [each.camera.fx == 50.0 for each in targets] == [each.name == first for each in targets]
    table = (folder / "cameras.csv").read_text().replace(first, "new.jpg")
    (folder / "more.csv").write_text(table)
    with pytest.raises(SurveyError, match=r"has no lens for new\.jpg, and the photographs of the run have several"):
        targets_of(given, flight.frame, folder / "more.csv", tmp_path / "views")


def test_photographs_are_rendered_in_a_common_exposure(photographed, tmp_path):
    folder, run = photographed
    factors = []
    for path in render(run, folder / "cameras.csv", tmp_path / "views"):
        rgba, own = (np.asarray(Image.open(each), dtype=float) for each in (path, folder / "images" / path.name))
        seen = rgba[..., 3] == 255
        assert seen.mean() > 0.99
        factor = np.median(rgba[seen][:, :3] / own[seen])
        assert np.sqrt(np.mean((rgba[seen][:, :3] / factor - own[seen]) ** 2)) < 3.0
        factors.append(factor)
    np.testing.assert_allclose(np.array(factors) * EXPOSURES, np.mean(np.array(factors) * EXPOSURES), rtol=0.02)
    np.testing.assert_allclose(np.mean(np.log(factors)), 0.0, atol=0.02)


def test_photographs_that_were_moved_are_found_by_the_folder_of_their_survey(photographed, tmp_path):
    folder, run = photographed
    folder.rename(tmp_path / "moved")
    with pytest.raises(SurveyError, match=r"is not there any more; name the folder of the survey with --survey DIR"):
        render(run, tmp_path / "moved" / "cameras.csv", tmp_path / "views")
    table = tmp_path / "moved" / "cameras.csv"
    assert len(render(run, table, tmp_path / "views", survey=str(tmp_path / "moved"))) == len(EXPOSURES)


def test_a_run_without_height_maps_says_what_is_missing(tmp_path):
    survey = painted_survey(tmp_path / "s")
    run = run_over(survey, tmp_path / "painted run")
    with pytest.raises(SurveyError, match="has no finished stage sweep; run the same `bathynerf process` again"):
        render(run, tmp_path / "s" / "cameras.csv", tmp_path / "views")


ABSORPTION = (0.3, 0.1, 0.05)


def test_what_water_takes_along_a_path_is_told_from_the_colours_of_the_bed(rng):
    bed, slant = rng.normal(4.0, 0.5, (500, 3)), rng.uniform(1.0, 1.3, (12, 500))
    lengths = slant * rng.uniform(0.5, 6.0, 500)
    shown = bed - lengths[..., None] * ABSORPTION
    shown[rng.random(lengths.shape) < 0.3] = np.nan
    np.testing.assert_allclose(attenuation_per_metre(shown, lengths), np.negative(ABSORPTION), rtol=1e-3)


def test_dry_photographs_have_no_change_with_the_path(rng):
    shown = rng.normal(4.0, 0.5, (5, 40, 3))
    assert not attenuation_per_metre(shown, np.zeros((5, 40))).any()


@pytest.mark.parametrize("along", [0.4, -0.4, 0.0])
def test_exposures_that_go_with_the_path_are_told_from_the_water(rng, along):
    bed, depth, slant = rng.normal(4.0, 0.5, (800, 3)), rng.uniform(0.5, 3.0, 800), rng.uniform(1.0, 1.2, (6, 800))
    # Half of the views look more obliquely, and are exposed otherwise.
    lengths = depth * slant + 0.5 * (np.arange(6) < 3)[:, None]
    exposure = along * (np.arange(6) < 3) + 0.1 * rng.normal(size=6)
    shown = bed - lengths[..., None] * ABSORPTION + exposure[:, None, None] + 0.02 * rng.normal(size=(6, 800, 3))
    shown[rng.random(lengths.shape) < 0.3] = np.nan
    # 0.02 over lengths that differ by 0.1 m in 3000 colours: 0.004 for one standard deviation.
    np.testing.assert_allclose(attenuation_per_metre(shown, lengths), np.negative(ABSORPTION), atol=0.016)
    found = log_exposures(shown, lengths)
    np.testing.assert_allclose(found, np.repeat(exposure[:, None], 3, axis=1) - exposure.mean(), atol=0.015)


def test_where_lengths_are_those_of_the_views_exposures_explain_all(rng):
    bed, longer = rng.normal(4.0, 0.5, (300, 3)), np.array([0.5, 0.5, 0.5, 0.0, 0.0, 0.0])
    lengths = rng.uniform(1.0, 3.0, 300) + longer[:, None]
    apart = np.array([0.4, 0.4, 0.4, 0.0, 0.0, 0.0])[:, None] - longer[:, None] * ABSORPTION
    shown = bed + apart[:, None] + 0.01 * rng.normal(size=(6, 300, 3))
    assert np.abs(attenuation_per_metre(shown, lengths)).max() < 0.01
    np.testing.assert_allclose(log_exposures(shown, lengths), apart - apart.mean(axis=0), atol=0.01)


def test_no_water_brightens_the_bed_with_the_path(rng):
    lengths = rng.uniform(1.0, 6.0, (5, 200))
    shown = rng.normal(4.0, 0.5, (200, 3)) + 0.2 * lengths[..., None]
    assert not attenuation_per_metre(shown, lengths).any()
