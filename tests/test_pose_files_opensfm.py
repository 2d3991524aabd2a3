"""OpenSfM and OpenDroneMap: poses, lenses, references, tracks and masks."""

import json

import numpy as np
import pytest
from foreign_block import CLOSE_PX, HEIGHT, LAT, LON, SIZE, draw_block, in_utm, load, most_missed_px, write_images
from PIL import Image
from scipy.spatial.transform import Rotation

from refract.lens import Lens
from survey.errors import PosesError
from survey.folder.found import find_survey
from survey.folder.survey import load_survey
from survey.init.draft import write_settings
from survey.plan.check import check_survey
from survey.pose_files import find_poses, read_poses, read_ties
from survey.pose_files.opensfm import read_opensfm
from survey.settings.config import SurveyConfig
from survey.settings.tables import InitOptions

REFERENCE = {"latitude": LAT, "longitude": LON, "altitude": HEIGHT}


def camera_json(lens) -> dict:
    """A camera of the kind brown: lengths in units of the longer side, the middle of the image at 0, 0."""
    longer = max(SIZE)
    return {
        "projection_type": "brown", "width": SIZE[0], "height": SIZE[1],
        "focal_x": lens.fx / longer, "focal_y": lens.fy / longer,
        # Pixels count from the centre of the first one there: the middle of the image is at (w - 1) / 2.
        "c_x": (lens.cx - 0.5 - (SIZE[0] - 1) / 2) / longer, "c_y": (lens.cy - 0.5 - (SIZE[1] - 1) / 2) / longer,
        "k1": lens.k[0], "k2": lens.k[1], "k3": lens.k[2], "p1": lens.p1, "p2": lens.p2,
    }  # fmt: skip


def block_json(block, names=None, **more) -> dict:
    shots = {}
    for i, name in enumerate(block.names):
        if names is None or name in names:
            shots[name] = {
                "rotation": Rotation.from_matrix(block.cams[i]).as_rotvec().tolist(),
                "translation": (-block.cams[i] @ block.centres[i]).tolist(), "camera": "v2 one", "orientation": 1,
            }  # fmt: skip
    points = {str(100 + i): {"coordinates": p.tolist(), "color": [1, 2, 3]} for i, p in enumerate(block.points)}
    return {"cameras": {"v2 one": camera_json(block.lens)}, "shots": shots, "points": points, **more}


def tracks_csv(block, header="OPENSFM_TRACKS_VERSION_v2\n") -> str:
    lines = [header]
    for i, name in enumerate(block.names):
        for j in block.seen(i):
            u, v = (block.pixels(i)[j] - 0.5 - (np.array(SIZE) - 1) / 2) / max(SIZE)
            lines.append(f"{name}\t{100 + j}\t{j}\t{u!r}\t{v!r}\t0.001\t1\t2\t3\t-1\t-1\n".replace("np.float64", ""))
    return "".join(lines).replace("(", "").replace(")", "")


@pytest.fixture(scope="module")
def block():
    return draw_block()


def write(folder, block, name="reconstruction.json", blocks=None, **more):
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps([block_json(block, **more)] if blocks is None else blocks))
    path.with_name("tracks.csv").write_text(tracks_csv(block))
    return path


def test_poses_and_lenses_put_points_where_the_photographs_show_them(tmp_path, block):
    write(tmp_path, block, reference_lla=REFERENCE)
    survey = load(tmp_path, block, "reconstruction.json")
    assert most_missed_px(survey, block) < CLOSE_PX
    assert survey.provenance.reprojection.rms_px < CLOSE_PX
    assert survey.provenance.reprojection.num_images == 6
    assert survey.provenance.tool == "OpenSfM"
    assert dict(check_survey(tmp_path)[0].rows)["tie points"].startswith("0.00 px rms")


def test_the_topocentric_file_of_a_finished_project_comes_before_the_one_in_grid_coordinates(tmp_path, block):
    opensfm = tmp_path / "opensfm"
    write(tmp_path, block, "opensfm/reconstruction.topocentric.json")
    (opensfm / "reference_lla.json").write_text(json.dumps(REFERENCE))
    (opensfm / "reconstruction.json").write_text("[]")
    (tmp_path / "odm_georeferencing").mkdir()
    assert find_poses(tmp_path) == [opensfm / "reconstruction.topocentric.json"]
    for named in ("opensfm/reconstruction.json", "opensfm", "."):
        survey = load(tmp_path, block, named)
        assert most_missed_px(survey, block) < CLOSE_PX
    (opensfm / "reconstruction.topocentric.json").unlink()
    with pytest.raises(PosesError, match=r"is in grid coordinates, .* put OpenDroneMap's reconstruction\.topocentric"):
        read_poses(opensfm / "reconstruction.json")


def test_without_a_reference_the_poses_are_in_the_frame_of_local(tmp_path, block):
    write(tmp_path, block, reference_lla={"latitude": 0.0, "longitude": 0.0, "altitude": 0.0})
    (tmp_path / "reference_lla.json").unlink(missing_ok=True)
    origin = in_utm(np.zeros((1, 3)))[0].tolist()
    survey = load(tmp_path, block, "reconstruction.json", f"[local]\norigin = {origin}")
    assert most_missed_px(survey, block) < CLOSE_PX


def test_heights_above_the_ellipsoid_need_the_grid_that_gps_height_asks_for(tmp_path, block):
    write(tmp_path, block, reference_lla=REFERENCE)
    survey = load(tmp_path, block, "reconstruction.json", cameras='gps_height = "ellipsoidal"', crs="EPSG:25832+4937")
    assert most_missed_px(survey, block) < CLOSE_PX


def test_of_a_block_in_pieces_the_largest_is_used_and_the_rest_is_named(tmp_path, block):
    pieces = [block_json(block, block.names[:2]), block_json(block, block.names[2:])]
    for piece in pieces:
        piece["reference_lla"] = REFERENCE
    write(tmp_path, block, blocks=pieces)
    survey = load(tmp_path, block, "reconstruction.json")
    assert [view.name for view in survey.views] == list(block.names[2:])
    assert any(
        "a block in 2 pieces" in warning and "of 2, are left out" in warning for warning in survey.findings.warnings
    )


def test_masks_are_taken_where_opensfm_and_opendronemap_keep_them(tmp_path, block):
    write(tmp_path / "a", block, reference_lla=REFERENCE)
    (tmp_path / "a" / "masks").mkdir()
    mask = Image.fromarray(np.full(SIZE[::-1], 255, dtype=np.uint8))
    mask.save(tmp_path / "a" / "masks" / "0001.jpg.png")
    survey = load(tmp_path / "a", block, "reconstruction.json")
    assert [view.mask_path is not None for view in survey.views] == [False, True, False, False, False, False]
    write(tmp_path / "b", block, "opensfm/reconstruction.topocentric.json", reference_lla=REFERENCE)
    write_images(tmp_path / "b", block.names)
    mask.save(tmp_path / "b" / "images" / "0002_mask.png")
    survey = load(tmp_path / "b", block, "opensfm")
    assert [view.mask_path and view.mask_path.name for view in survey.views] == [
        None,
        None,
        "0002_mask.png",
        *[None] * 3,
    ]


@pytest.mark.parametrize(
    ("camera", "model", "params"),
    [
        ({"projection_type": "perspective", "focal": 0.8, "k1": 0.1, "k2": -0.2}, "OPENCV",
         (512.0, 512.0, 320.0, 240.0, 0.1, -0.2, 0.0, 0.0)),
        ({"focal": 0.8}, "OPENCV", (512.0, 512.0, 320.0, 240.0, 0.0, 0.0, 0.0, 0.0)),
        ({"projection_type": "fisheye", "focal": 0.8, "k1": 0.1, "k2": -0.2}, "OPENCV_FISHEYE",
         (512.0, 512.0, 320.0, 240.0, 0.1, -0.2, 0.0, 0.0)),
        ({"projection_type": "fisheye_opencv", "focal_x": 0.8, "focal_y": 0.75, "c_x": 0.01, "c_y": -0.02, "k1": 0.1,
          "k2": -0.2, "k3": 0.03, "k4": 0.04}, "OPENCV_FISHEYE",
         (512.0, 480.0, 326.4, 227.2, 0.1, -0.2, 0.03, 0.04)),
        ({"projection_type": "radial", "focal_x": 0.8, "focal_y": 0.75, "c_x": 0.01, "c_y": -0.02, "k1": 0.1,
          "k2": -0.2}, "OPENCV", (512.0, 480.0, 326.4, 227.2, 0.1, -0.2, 0.0, 0.0)),
    ],
)  # fmt: skip
def test_cameras_are_those_of_the_formulas_of_opensfm(tmp_path, block, camera, model, params):
    made = block_json(block)
    made["cameras"]["v2 one"] = {"width": SIZE[0], "height": SIZE[1], **camera}
    (pose, *_) = read_poses(write(tmp_path, block, blocks=[made])).poses
    assert pose.lens.model == model
    assert pose.lens.params == pytest.approx(params)
    assert isinstance(pose.lens, Lens)


@pytest.mark.parametrize("header", ["", "OPENSFM_TRACKS_VERSION_v1\n", "OPENSFM_TRACKS_VERSION_v2\n"])
def test_tracks_of_all_versions_are_read_and_points_without_any_are_not_counted(tmp_path, block, header):
    path = write(tmp_path, block)
    path.with_name("tracks.csv").write_text(tracks_csv(block, header))
    ties = read_ties(path)
    assert (ties.num_views == sum(np.isin(np.arange(60), block.seen(i)).astype(int) for i in range(6))).all()
    path.with_name("tracks.csv").unlink()
    assert read_ties(path) is None


def test_the_points_of_berlin_fall_where_the_formulas_of_opensfm_put_them(data_dir):
    """In normalised coordinates and the topocentric frame of the file, as OpenSfM's doc/geometry.rst has them."""
    folder = data_dir / "real" / "opensfm_berlin"
    (data,) = json.loads((folder / "reconstruction_example.json").read_text())
    squares = []
    for line in (folder / "tracks_example.csv").read_text().splitlines()[1:]:
        name, track, _, u, v, *_ = line.split("\t")
        if track in data["points"]:
            shot = data["shots"][name]
            camera = data["cameras"][shot["camera"]]
            turn = Rotation.from_rotvec(shot["rotation"])
            x, y, z = turn.apply(data["points"][track]["coordinates"]) + shot["translation"]
            r2 = (x * x + y * y) / z**2
            scale = camera["focal"] * (1.0 + r2 * (camera["k1"] + camera["k2"] * r2)) / z
            squares.append(((x * scale - float(u)) ** 2 + (y * scale - float(v)) ** 2) * camera["width"] ** 2)
    found = find_survey(folder, config=SurveyConfig(crs="EPSG:32633+5773", dry=True))
    survey = load_survey(folder, found=found)
    # The reference itself keeps some mismatches: 2.5 px rms, 0.8 px median.
    assert survey.provenance.reprojection.num_seen == len(squares) == 3082
    assert survey.provenance.reprojection.rms_px == pytest.approx(np.sqrt(np.mean(squares)), abs=1e-6)
    assert survey.provenance.reprojection.median_px == pytest.approx(np.sqrt(np.median(squares)), abs=1e-6)
    heights = survey.frame.crs_from_local([view.camera.centre for view in survey.views])[:, 2]
    # Its altitude of 0 is a height in crs; the tangent plane lies 0.8 mm under the ellipsoid at 100 m.
    expected = [
        (-Rotation.from_rotvec(shot["rotation"]).inv().apply(shot["translation"]))[2]
        for _, shot in sorted(data["shots"].items())
    ]
    assert heights == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        # None: the whole file.
        (None, "", "is not valid JSON"), (None, "[" * 100_000, "is nested too deeply|is not valid JSON"),
        (None, "[1]", "is not a list of reconstructions"), (None, "[]", "is not a list of reconstructions"),
        (None, '[{"shots": {"a": {"camera": "x"}}}]', "the camera of a is not in the file"),
        ('"width": 640', '"width": 1e999', "width is inf, expected a finite number"),
        ('"width": 640', f'"width": {"9" * 10_000}', "width is inf, expected a finite"),
        ('"width": 640', '"width": 640.5', "expected whole numbers"),
        ('"projection_type": "brown"', '"projection_type": "spherical"', "spherical is not supported"),
        ('"k1": -0.08', '"k1": NaN', "k1 is nan"),
        ('"k1": -0.08', '"k1": "x"', "k1 is x"),
        ('"camera": "v2 one"', '"camera": "v2 two"', "the camera of 0000.jpg is not in the file"),
        ('"rotation": [', '"rotation": [NaN, ', "the pose of 0000.jpg is not a finite rotation"),
        (f'"latitude": {LAT}', '"latitude": 95', "its reference is .* expected latitude"),
    ],
)  # fmt: skip
def test_a_spoilt_reconstruction_is_refused_in_one_sentence(tmp_path, block, old, new, words):
    path = write(tmp_path, block, reference_lla=REFERENCE)
    text = path.read_text()
    assert old is None or old in text
    path.write_text(new if old is None else text.replace(old, new, 1))
    with pytest.raises(PosesError, match=words):
        read_opensfm(path)


def test_tracks_that_are_damaged_are_refused(tmp_path, block):
    path = write(tmp_path, block)
    path.with_name("tracks.csv").write_text("OPENSFM_TRACKS_VERSION_v2\n0000.jpg\t100\t1\tnone\t0.1\n")
    with pytest.raises(PosesError, match=r"tracks\.csv is damaged"):
        read_ties(path)


def test_a_track_whose_place_overflows_is_left_out(tmp_path, block):
    path = write(tmp_path, block)
    lines = tracks_csv(block).splitlines()
    whole = path.with_name("tracks.csv").write_text("\n".join(lines)) and read_ties(path)
    parts = lines[1].split("\t")
    lines[1] = "\t".join([*parts[:3], "1e308", *parts[4:]])
    path.with_name("tracks.csv").write_text("\n".join(lines))
    assert len(read_ties(path).pixel) == len(whole.pixel) - 1


def test_without_positions_in_exif_the_poses_tell_the_zone(tmp_path, block):
    write(tmp_path, block, reference_lla=REFERENCE)
    write_images(tmp_path, block.names)
    path = write_settings(tmp_path, InitOptions(dry=True))
    assert "the UTM zone of the poses" in path.read_text(encoding="utf-8")
    survey = load_survey(tmp_path)
    assert survey.config.crs == "EPSG:32632+5773"
    assert most_missed_px(survey, block) < CLOSE_PX


def test_names_that_lead_out_of_the_folder_are_names_only(tmp_path, block):
    made = block_json(block, reference_lla=REFERENCE)
    shots = made["shots"]
    shots["../../../../etc/passwd"] = dict(shots["0000.jpg"])
    shots["/etc/0001.jpg"] = dict(shots["0000.jpg"])
    shots["C:\\photos\\0002.jpg"] = shots.pop("0002.jpg")
    write(tmp_path, block, blocks=[made])
    survey = load(tmp_path, block, "reconstruction.json")
    assert [view.name for view in survey.views] == list(block.names)
    assert all(view.path.parent == tmp_path / "images" for view in survey.views)
    assert most_missed_px(survey, block) < CLOSE_PX
    (left_out,) = [text for text in survey.findings.warnings if "without an image" in text]
    assert "../../../../etc/passwd" in left_out
