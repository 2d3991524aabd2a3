"""Structure from motion: similarities, GPS positions into local, adjustment, and real photographs end to end."""

import csv
import math
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image
from pyproj import CRS, Geod
from scipy.spatial.transform import Rotation
from synthetic_block import synthetic_block

from geo.crs import parse_crs
from geo.errors import GeoError, UnwritableFile
from geo.frames import fit_similarity, robust_similarity
from refract import PinholeCamera
from survey.errors import ConfigError, PosesError, SurveyError
from survey.photos.exif import Exif, read_exif
from survey.photos.poses import CAM_FROM_OPK_CAM, grid_from_opk
from survey.settings.config import CamerasConfig
from survey.sfm import block as sfm_block
from survey.sfm import solve as sfm_solve
from survey.sfm.gps import gps_positions
from survey.sfm.gps_fit import MIN_STD_M, gps_std, line_of
from survey.sfm.poses import SfmResult, seconds_of_solve, solve_poses

# Some hundred roundings of coordinates of 1e3.
EXACT = 1e-10
UTM = "EPSG:32632+5773"


def turned_shifted(points: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, float, np.ndarray, np.ndarray]:
    scale, shift = rng.uniform(0.1, 20.0), rng.normal(0.0, 300.0, 3)
    rotation = Rotation.random(rng=rng).as_matrix()
    return scale * points @ rotation.T + shift, scale, rotation, shift


def head(position, *, focal_px: float | None = None, size: tuple[int, int] = (800, 600)) -> Exif:
    return Exif(size, position, focal_px, 1, "Maker Model", None)


# ------------------------------------------------------------------------------------------------ similarities


@pytest.mark.parametrize("num", [3, 20])
def test_a_similarity_is_recovered_to_rounding(rng, num):
    a = rng.normal(0.0, 10.0, (num, 3))
    b, scale, rotation, shift = turned_shifted(a, rng)
    found = fit_similarity(a, b)
    assert abs(found.scale - scale) < EXACT
    assert np.abs(found.rotation - rotation).max() < EXACT
    assert np.abs(found.shift - shift).max() < 1e3 * EXACT
    assert np.abs(found(a) - b).max() < 1e3 * EXACT


def test_a_similarity_never_mirrors(rng):
    a = rng.normal(0.0, 10.0, (20, 3))
    found = fit_similarity(a, a * [1.0, 1.0, -1.0])
    assert abs(np.linalg.det(found.rotation) - 1.0) < EXACT


def test_positions_that_are_wrong_are_found_and_do_not_pull(rng):
    a = rng.normal(0.0, 10.0, (40, 3)) * [1.0, 1.0, 0.1]
    b, scale, _, _ = turned_shifted(a, rng)
    wrong = np.arange(40) % 5 < 2
    b[wrong] += rng.normal(0.0, 50.0 * scale, (int(wrong.sum()), 3))
    found, agree = robust_similarity(a, b)
    assert (agree == ~wrong).all()
    assert np.abs(found(a[~wrong]) - b[~wrong]).max() < 1e3 * EXACT
    assert np.abs(fit_similarity(a, b)(a[~wrong]) - b[~wrong]).max() > 1.0


def test_noise_alone_makes_no_position_wrong(rng):
    a = rng.normal(0.0, 30.0, (200, 3)) * [1.0, 1.0, 0.05]
    _, agree = robust_similarity(a, a + rng.normal(0.0, 1.0, a.shape))
    assert agree.all()


def test_the_standard_deviation_of_positions_is_told_without_bias(rng):
    # Ten positions take up 7 of 30 degrees of freedom; 400 draws leave 1.3 % of the mean square to chance.
    a = rng.normal(0.0, 30.0, (10, 3))
    squares = []
    for _ in range(400):
        b = a + rng.normal(0.0, 0.5, a.shape)
        squares.append(gps_std(fit_similarity(a, b)(a) - b) ** 2)
    assert abs(np.mean(squares) / 0.25 - 1.0) < 0.04


def test_nothing_is_trusted_further_than_a_receiver_with_corrections():
    assert (gps_std(np.zeros((5, 3))) == MIN_STD_M).all()


def test_one_strip_is_a_line_and_two_are_none(rng):
    strip = np.stack([np.linspace(0.0, 200.0, 12), np.zeros(12), np.zeros(12)], axis=1)
    noise = rng.normal(0.0, 0.3, strip.shape)
    assert line_of(strip + noise, 0.3) is not None
    assert line_of(np.concatenate([strip, strip + np.array([0.0, 30.0, 0.0])]), 0.3) is None


# ------------------------------------------------------------------------------------- GPS positions into local


def some_heads() -> dict[str, Exif]:
    return {f"{i}.jpg": head((46.9 + 1e-4 * i, 10.17 + 2e-4 * i**2, 2127.0 + i)) for i in range(4)}


def test_gps_distances_are_kept_in_local():
    """Horizontal ones against geodesics on the ellipsoid, which are shorter than at the survey's height."""
    headers = {name: h for name, h in some_heads().items() if name != "1.jpg"}
    gps = gps_positions(headers, parse_crs(UTM), "crs")
    (lat_a, lon_a, h_a), (lat_b, lon_b, h_b) = (headers[n].lat_lon_height for n in ("0.jpg", "3.jpg"))
    _, _, metres = Geod(ellps="WGS84").inv(lon_a, lat_a, lon_b, lat_b)
    apart = gps.local["3.jpg"] - gps.local["0.jpg"]
    raised = metres * (1.0 + 0.5 * (h_a + h_b) / Geod(ellps="WGS84").a)
    # Radii of curvature differ by 0.3 %, of a raise of 5 cm; the plane leaves the ellipsoid by 1 mm in 100 m.
    assert abs(math.hypot(*apart[:2]) - raised) < 1e-3
    assert abs(apart[2] - (h_b - h_a)) < 5e-3
    assert any("heights in crs, above EGM96 height" in note for note in gps.notes)


def test_a_crs_without_heights_is_refused():
    with pytest.raises(GeoError):
        gps_positions(some_heads(), CRS("EPSG:32632"), "crs")


def test_heights_in_feet_stay_metres_in_local():
    headers = {f"{i}.jpg": head((46.84 + 1e-4 * i, -91.99, 200.0 + i)) for i in range(3)}
    gps = gps_positions(headers, parse_crs("EPSG:26915+6360"), "crs")
    assert abs(gps.local["2.jpg"][2] - gps.local["0.jpg"][2] - 2.0) < 1e-3


def test_ellipsoidal_heights_need_the_grid_of_the_geoid():
    with pytest.raises(ConfigError, match=r"grid us_nga_egm96_15\.tif is not installed"):
        gps_positions(some_heads(), parse_crs(UTM), "ellipsoidal")
    above = gps_positions(some_heads(), parse_crs("EPSG:4979"), "ellipsoidal")
    same = gps_positions(some_heads(), parse_crs("EPSG:4979"), "crs")
    assert all(np.abs(above.local[n] - same.local[n]).max() < 1e-6 for n in same.local)


@pytest.mark.parametrize(
    ("crs", "place", "grid"),
    [
        ("EPSG:26910+5703", (37.8, -122.5), "us_noaa_g2018u0.tif"),
        ("EPSG:6339+6360", (37.8, -122.5), "us_noaa_g2018u0.tif"),
        ("EPSG:25832+7837", (53.8, 9.0), "de_bkg_gcg2016.tif"),
        ("EPSG:2193+7839", (-40.0, 175.0), "nz_linz_nzgeoid2016.tif"),
        ("EPSG:7856+5711", (-33.0, 152.0), "au_ga_AUSGeoid2020_20180201.tif"),
        ("EPSG:28356+5711", (-33.0, 152.0), "au_ga_AUSGeoid09_V1.01.tif"),
        ("EPSG:32632+3855", (51.0, 9.0), "us_nga_egm08_25.tif"),
    ],
)
def test_the_grid_that_is_missing_is_one_of_the_geoid_and_not_of_horizontal_datums(crs, place, grid):
    headers = {f"{i}.jpg": head((place[0] + 1e-4 * i, place[1], 30.0)) for i in range(3)}
    with pytest.raises(ConfigError, match=rf"the grid {grid} is not installed; install with pyproj sync --file {grid}"):
        gps_positions(headers, parse_crs(crs), "ellipsoidal")


def test_a_vertical_datum_of_another_country_is_said_not_to_hold_at_the_place():
    headers = {f"{i}.jpg": head((53.8 + 1e-4 * i, 9.0, 30.0)) for i in range(3)}
    with pytest.raises(ConfigError, match="PROJ does not have here"):
        gps_positions(headers, parse_crs("EPSG:25832+5703"), "ellipsoidal")


def test_images_without_positions_are_told_what_to_give():
    headers = some_heads() | {"1.jpg": head(None), "2.jpg": head((46.9, 10.2, math.nan))}
    with pytest.raises(PosesError, match=r"3 of 4 images have a GPS .* 2 of them with a height.*\[cameras\] poses"):
        gps_positions(headers, parse_crs(UTM), "crs")
    headers |= {"4.jpg": head((46.9, 10.171, 2127.0))}
    gps = gps_positions(headers, parse_crs(UTM), "crs")
    assert sorted(gps.local) == ["0.jpg", "3.jpg", "4.jpg"]
    assert "2 of 5 images have no position" in gps.notes[-1]


def test_an_unknown_kind_of_gps_height_is_named():
    with pytest.raises(ConfigError, match='gps_height is "geoid", expected "crs" or "ellipsoidal"'):
        gps_positions(some_heads(), parse_crs(UTM), "geoid")


# --------------------------------------------------------------------------------------------- synthetic blocks


def test_poses_and_lenses_of_a_block_project_as_pycolmap_does():
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 5, 40
    options.camera_model_id, options.camera_params = pycolmap.CameraModelId.SIMPLE_PINHOLE, [1280.0, 500.0, 390.0]
    pycolmap.set_random_seed(0)
    block = pycolmap.synthesize_dataset(options)
    similarity = fit_similarity(np.eye(3), 7.0 * np.roll(np.eye(3), 1, axis=0) + [10.0, 20.0, 30.0])
    sfm_block.transform(block, similarity)
    points = sfm_block.points_of(block)
    worst = 0.0
    for name, (centre, cam_from_local) in sfm_block.poses_of(block).items():
        camera: PinholeCamera = sfm_block.lens_of(block, name).pinhole(centre, cam_from_local)
        image = block.find_image_with_name(name)
        seen = {p.point3D_id: p.xy for p in image.points2D if p.has_point3D()}
        pixels = camera.project(points, None)
        worst = max(worst, np.abs(pixels - [seen[number] for number in sorted(block.points3D)]).max())
    assert worst < 1e-8


def test_a_focal_length_that_parallel_views_cannot_tell_is_put_back(rng):
    block, centres = synthetic_block(rng, focal=1130.0)
    notes = sfm_solve.reset_focals(block, dict.fromkeys(centres, 889.0))
    assert sfm_block.camera_of(block, "00.jpg").focal_length == 889.0
    # Seen from as high as before, the ground is that much nearer.
    depths = [
        centre[2] - np.median(sfm_block.points_of(block)[:, 2]) for centre, _ in sfm_block.poses_of(block).values()
    ]
    assert np.median(depths) == pytest.approx(40.0 * 889.0 / 1130.0, rel=0.02)
    assert block.compute_mean_reprojection_error() < 0.5
    assert "889 px, is kept instead of the solved 1130 px" in notes[0]


@pytest.mark.parametrize(
    ("focal", "tilt_deg", "nominal", "said"),
    [
        (1130.0, 25.0, 889.0, 0),  # convergent views tell the focal length
        (905.0, 0.0, 889.0, 0),  # EXIF is not better than that
        (1130.0, 0.0, None, 1),  # nothing to put back, but a warning
    ],
)
def test_other_focal_lengths_are_left_alone(rng, focal, tilt_deg, nominal, said):
    block, centres = synthetic_block(rng, focal=focal, tilt_deg=tilt_deg)
    notes = sfm_solve.reset_focals(block, dict.fromkeys(centres, nominal))
    assert sfm_block.camera_of(block, "00.jpg").focal_length == focal
    assert len(notes) == said


def test_images_outside_all_blocks_are_named(rng):
    block, _ = synthetic_block(rng)
    names = [f"{i:02d}.jpg" for i in range(18)]
    assert sfm_solve.left_out([block], names) == []
    (note,) = sfm_solve.left_out([block], [*names, "flight 18.jpg", "flight 19.jpg"])
    assert "some images match too little; left out: flight 18.jpg, flight 19.jpg" in note


# ---------------------------------------------------------------------------------------------- whole and errors


def test_nadir_photographs_get_their_true_poses_and_keep_them(data_dir, tmp_path):
    """Nine nadir views of data/quick, where straight rays show no contradiction, and one of another place."""
    told: list[str] = []
    folder = tmp_path / "two words"
    folder.mkdir()
    paths, stranger = [folder / f"{i:04d}.jpg" for i in range(9)], folder / "0009.jpg"
    for path in paths:
        shutil.copy(data_dir / "quick" / "images" / path.name, path)
    shutil.copy(data_dir / "river" / "images" / "0000.jpg", stranger)
    crs, work = parse_crs("EPSG:25832+5778"), tmp_path / "work"
    cameras = CamerasConfig(focal_px=900.0)
    result = solved([*paths, stranger], work, cameras, crs, told.append)
    with (data_dir / "quick" / "cameras.csv").open(newline="") as file:
        truth = {row["image"]: row for row in csv.DictReader(file)}
    assert [view.name for view in result.views] == [path.name for path in paths]
    for view in result.views:
        row = {key: float(value) for key, value in truth[view.name].items() if key != "image"}
        point = np.array([row["easting"], row["northing"], row["height"]])
        # GPS noise is 2 cm; its mean over nine views moves the block, refraction and lens bend it by as much.
        assert np.abs(view.camera.centre - result.frame.local_from_crs(point)).max() < 0.25
        grid_from_cam = grid_from_opk(*np.radians([row["omega"], row["phi"], row["kappa"]])) @ CAM_FROM_OPK_CAM
        apart = view.camera.cam_from_local @ result.frame.local_from_grid(point) @ grid_from_cam
        # 2 cm in each of nine positions, 8 m across, tilt the block by 0.14 degrees, and straight rays bend it: a start
        # for the adjustment.
        assert np.degrees(Rotation.from_matrix(apart).magnitude()) < 1.5
    assert any("left out: 0009.jpg" in note for note in result.notes)
    assert len(result.ties) > 500
    assert np.bincount(result.ties.point).min() >= 3
    assert told[0].startswith("structure from motion: features of 10 images")
    assert not (work / ".work.part").exists()
    seconds = seconds_of_solve(work)
    assert seconds > 0.0

    again = solved([*paths, stranger], work, cameras, crs, told.append)
    assert "poses of 9 images from" in told[-2]
    assert seconds_of_solve(work) == seconds
    assert seconds_of_solve(tmp_path / "elsewhere") is None
    assert (again.ties.pixel == result.ties.pixel).all()
    assert (again.gps_residual_m == result.gps_residual_m).all()
    assert again.frame == result.frame
    assert again.notes == result.notes
    for old, new in zip(result.views, again.views, strict=True):
        assert (old.camera.centre == new.camera.centre).all()
        assert (old.camera.cam_from_local == new.camera.cam_from_local).all()
        assert old.lens == new.lens


def solved(paths, work, cameras=CamerasConfig(), crs=parse_crs(UTM), report=None) -> SfmResult:
    images = {path.name: path for path in paths}
    headers = {name: read_exif(path) for name, path in images.items()}
    return solve_poses(images, headers, cameras, crs, work, report=report)


def noise_images(folder: Path, rng: np.random.Generator) -> list[Path]:
    paths = []
    for i in range(3):
        exif = Image.Exif()
        exif.get_ifd(0x8825).update(
            {1: "N", 2: (46.0, 54.0, 0.2 * i), 3: "E", 4: (10.0, 10.0, 0.3 * i * i), 5: b"\x00", 6: 2100.0 + i}
        )
        paths.append(folder / f"{i}.jpg")
        Image.fromarray(rng.integers(0, 255, (120, 160, 3), dtype=np.uint8)).save(paths[-1], exif=exif)
    return paths


def test_photographs_that_do_not_match_are_refused_with_a_mend(tmp_path, rng):
    paths = noise_images(tmp_path, rng)
    with pytest.raises(PosesError, match=r"placed 0 of 3 images, expected at least 3.*\[cameras\] poses"):
        solved(paths, tmp_path / "work")
    assert list((tmp_path / "work").iterdir()) == []


def test_stored_poses_that_do_not_belong_to_the_photographs_are_not_used_without_a_word(tmp_path, rng):
    paths, told = noise_images(tmp_path, rng), []
    work = tmp_path / "work"
    work.mkdir()
    (work / "solved.json").write_text('{"key": "of other photographs"}')
    with pytest.raises(PosesError):
        solved(paths, work, report=told.append)
    assert "has poses of other photographs, settings" in told[0]


def test_pixels_that_are_not_square_are_refused():
    with pytest.raises(SurveyError, match="square pixels; give one number"):
        _ = CamerasConfig(focal_px=(900.0, 910.0)).square_focal_px


def test_a_workspace_that_cannot_be_written_is_named(tmp_path, rng):
    paths = noise_images(tmp_path, rng)
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(UnwritableFile, match=r"cannot write .*file"):
        solved(paths, tmp_path / "file" / "work")


def test_pictures_can_be_written_after_pycolmap_was_loaded(tmp_path):
    """pycolmap's own zlib corrupts the heap of a process that loads the system's after it."""
    code = (
        "import survey.sfm.block, pycolmap, numpy as np; from PIL import Image; "
        "noise = np.random.default_rng(0).integers(0, 255, (900, 900, 3), dtype=np.uint8); "
        f"Image.fromarray(noise).save({str(tmp_path / 'noise.png')!r})"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode()


@pytest.mark.slow
def test_a_real_beach_is_placed_by_its_positions_with_the_focal_length_of_its_exif(data_dir, tmp_path):
    """brighton_beach: 18 nadir photographs; focal length put back. A bent block, where the adjustment starts."""
    folder = data_dir / "real" / "brighton_beach" / "images"
    result = solved(sorted(folder.iterdir()), tmp_path, crs=parse_crs("EPSG:32615+5773"))
    assert len(result.views) == 18
    assert float(re.search(r"with \d+ points, ([\d.]+) px", " ".join(result.notes))[1]) < 0.6
    assert any("is kept instead of the solved" in note for note in result.notes)
    residual = np.sqrt((result.gps_residual_m**2).mean(axis=0))
    # Strips of a drone without corrections lie up to 1 m apart; its barometer is good to 0.2 m, and the block is bent.
    assert residual[:2].max() < 0.8
    assert residual[2] < 0.3
