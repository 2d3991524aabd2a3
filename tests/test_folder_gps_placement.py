"""Blocks with axes and a scale of their own, in each format that can hold one, against GPS positions in EXIF."""

import json
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pycolmap
import pytest
from foreign_block import SIZE as SIZE_PX
from foreign_block import ForeignBlock, draw_block, ecef_from_enu, in_ecef, in_utm, most_missed_px
from scipy.spatial.transform import Rotation
from small_survey import write_image
from test_pose_files_metashape import calibration
from test_pose_files_nerfstudio import transforms
from test_pose_files_opensfm import block_json
from test_pose_files_tables import lens_toml

from geo.frames import Similarity
from survey.errors import ConfigError, PosesError
from survey.folder.gps_placement import GpsFit
from survey.folder.survey import load_survey

# EXIF has seconds to seven digits and heights to millimetres, and poses move by no more: 25 m away and with 520 px that
# is less than this.
CLOSE_PX = 0.2
UTM_CRS = "EPSG:25832+5778"


def changed(block: ForeignBlock, similarity: Similarity) -> ForeignBlock:
    """The block in other axes and another unit."""
    cams = block.cams @ similarity.rotation.T
    return replace(block, centres=similarity(block.centres), cams=cams, points=similarity(block.points))


def photo_angles(cam_from_world: np.ndarray) -> np.ndarray:
    photo = np.diag([1.0, -1.0, -1.0])
    return Rotation.from_matrix((photo @ cam_from_world).T).as_euler("XYZ", degrees=True)


def colmap_text(folder: Path, block: ForeignBlock) -> str:
    (folder / "sparse").mkdir()
    lens = block.lens
    numbers = [lens.fx, lens.fy, lens.cx, lens.cy, lens.k[0], lens.k[1], lens.p1, lens.p2, lens.k[2], 0, 0, 0]
    (folder / "sparse/cameras.txt").write_text(
        f"1 FULL_OPENCV {SIZE_PX[0]} {SIZE_PX[1]} {' '.join(map(str, numbers))}\n"
    )
    lines = []
    for number, name in enumerate(block.names, start=1):
        turn = block.cams[number - 1]
        x, y, z, w = Rotation.from_matrix(turn).as_quat()
        pose = " ".join(f"{v:.17g}" for v in (w, x, y, z, *(-turn @ block.centres[number - 1])))
        seen, pixels = block.seen(number - 1), block.pixels(number - 1)
        lines.append(
            f"{number} {pose} 1 {name}\n"
            + " ".join(f"{x:.17g} {y:.17g} {p + 1}" for p, (x, y) in zip(seen, pixels[seen], strict=True))
        )
    (folder / "sparse/images.txt").write_text("\n".join(lines) + "\n")
    rows = [(p, [v for v in range(len(block.names)) if p in block.seen(v)]) for p in range(len(block.points))]
    (folder / "sparse/points3D.txt").write_text(
        "".join(
            f"{p + 1} {' '.join(f'{v:.17g}' for v in block.points[p])} 9 9 9 0.1 "
            + " ".join(f"{v + 1} {np.flatnonzero(block.seen(v) == p)[0]}" for v in views) + "\n"
            for p, views in rows if views
        )
    )  # fmt: skip
    return "sparse"


def colmap_binary(folder: Path, block: ForeignBlock) -> str:
    colmap_text(folder, block)
    (folder / "binary").mkdir()
    pycolmap.Reconstruction(folder / "sparse").write_binary(folder / "binary")
    return "binary"


def nerfstudio(folder: Path, block: ForeignBlock) -> str:
    (folder / "transforms.json").write_text(json.dumps(transforms(block)))
    return "transforms.json"


def opensfm(folder: Path, block: ForeignBlock) -> str:
    (folder / "reconstruction.json").write_text(json.dumps([block_json(block)]))
    return "reconstruction.json"


def metashape(folder: Path, block: ForeignBlock) -> str:
    cameras = ""
    for name, centre, cam in zip(block.names, block.centres, block.cams, strict=True):
        matrix = np.vstack([np.column_stack([cam.T, centre]), [0, 0, 0, 1]])
        text = " ".join(f"{v:.17g}" for v in matrix.ravel())
        cameras += f'<camera label="{name}" sensor_id="0" enabled="true"><transform>{text}</transform></camera>'
    unit = (
        "<transform><rotation>1 0 0 0 1 0 0 0 1</rotation><translation>0 0 0</translation><scale>1</scale></transform>"
    )
    (folder / "cameras.xml").write_text(
        f'<document><chunk><sensors><sensor id="0" type="frame">{calibration(block.lens)}</sensor></sensors>'
        f"{unit}<cameras>{cameras}</cameras></chunk></document>"
    )
    return "cameras.xml"


def lines(folder: Path, block: ForeignBlock) -> str:
    rows = [
        f"{name} {' '.join(f'{v:.12f}' for v in (*centre, *photo_angles(cam)))}"
        for name, centre, cam in zip(block.names, block.centres, block.cams, strict=True)
    ]
    (folder / "eo.txt").write_text("name x y z omega phi kappa\n" + "\n".join(rows) + "\n")
    return "eo.txt"


def table(folder: Path, block: ForeignBlock) -> str:
    rows = [row.replace(" ", ",") for row in (lines(folder, block), (folder / "eo.txt").read_text())[1].splitlines()]
    (folder / "eo.txt").unlink()
    (folder / "cameras.csv").write_text("\n".join(["image,easting,northing,height,omega,phi,kappa", *rows[1:]]) + "\n")
    return "cameras.csv"


LOCAL_FORMATS = (colmap_text, colmap_binary, nerfstudio, opensfm, metashape)
FORMATS = (*LOCAL_FORMATS, lines, table)


@cache
def photograph(name: str, place: tuple[float, ...] | None) -> bytes:
    with TemporaryDirectory() as folder:
        write_image(Path(folder) / name, size=SIZE_PX, gps=place)
        return (Path(folder) / name).read_bytes()


@dataclass
class Draw:
    """A survey of the block as a file has it, with true GPS positions."""

    folder: Path
    more: str = ""
    gps_std_m: float = 0.0
    num_gps: int = 6

    def load(self, write, block: ForeignBlock, crs: str = UTM_CRS):
        true, rng = draw_block(), np.random.default_rng(3)
        self.folder.mkdir(exist_ok=True)
        (self.folder / "images").mkdir()
        for number, (name, place) in enumerate(zip(true.names, in_utm(true.centres), strict=True)):
            noisy = tuple((place + rng.normal(size=3) * self.gps_std_m).tolist())
            (self.folder / "images" / name).write_bytes(photograph(name, noisy if number < self.num_gps else None))
        poses = write(self.folder, block)
        lens = lens_toml(true) if write in (lines, table) else ""
        (self.folder / "survey.toml").write_text(
            f'crs = "{crs}"\ndry = true\n[cameras]\nposes = "{poses}"\n{lens}\n{self.more}\n'
        )
        return load_survey(self.folder)


def random_similarity(rng, scales=(0.02, 50.0)) -> Similarity:
    scale = float(np.exp(rng.uniform(*np.log(scales))))
    return Similarity(scale, Rotation.random(rng=rng).as_matrix(), rng.normal(size=3) * 30.0)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("write", FORMATS)
def test_poses_with_axes_and_a_scale_of_their_own_are_placed_by_gps_and_it_is_said(tmp_path, write, seed):
    free = random_similarity(np.random.default_rng(seed))
    survey = Draw(tmp_path / "s").load(write, changed(draw_block(), free))
    assert most_missed_px(survey, draw_block()) < CLOSE_PX
    (said,) = [text for text in survey.findings.assumptions if "are their own" in text]
    assert f"a scale of {1.0 / free.scale:.4g} and a rotation by" in said
    assert {prior.source for prior in survey.observations.priors.values()} == {"GPS EXIF"}
    if write in (colmap_text, colmap_binary):
        assert survey.provenance.reprojection.rms_px < CLOSE_PX


def test_millimetres_are_a_scale(tmp_path):
    unit = Similarity(5000.0, np.eye(3), np.zeros(3))
    survey = Draw(tmp_path / "s").load(colmap_text, changed(draw_block(), unit))
    assert most_missed_px(survey, draw_block()) < CLOSE_PX


@pytest.mark.parametrize("write", LOCAL_FORMATS)
def test_metric_poses_east_north_and_up_keep_axes_and_scale(tmp_path, write):
    moved = Similarity(1.0, np.eye(3), np.array([40.0, -30.0, 7.0]))
    survey = Draw(tmp_path / "s").load(write, changed(draw_block(), moved))
    assert most_missed_px(survey, draw_block()) < CLOSE_PX
    assert any("axes and scale are kept" in text for text in survey.findings.assumptions)


@pytest.mark.parametrize("seed", range(1))
@pytest.mark.parametrize("write", LOCAL_FORMATS)
def test_an_origin_that_contradicts_the_gps_positions_is_refused_with_the_scale(tmp_path, write, seed):
    free = random_similarity(np.random.default_rng(100 + seed))
    origin = ", ".join(f"{v:.3f}" for v in in_utm(np.zeros((1, 3)))[0])
    with pytest.raises(PosesError, match=f"only with a scale of {1.0 / free.scale:.4g} and .*remove .local. origin"):
        Draw(tmp_path / "s", more=f"[local]\norigin = [{origin}]").load(write, changed(draw_block(), free))


@pytest.mark.parametrize("write", LOCAL_FORMATS)
def test_the_right_origin_is_obeyed(tmp_path, write):
    origin = ", ".join(f"{v:.6f}" for v in in_utm(np.zeros((1, 3)))[0])
    draw = Draw(tmp_path / "s", more=f"[local]\norigin = [{origin}]", gps_std_m=1.5)
    survey = draw.load(write, draw_block())
    assert most_missed_px(survey, draw_block()) < CLOSE_PX
    assert not any("GPS" in text for text in survey.findings.warnings)


@pytest.mark.parametrize("write", [colmap_text, nerfstudio, opensfm])
@pytest.mark.parametrize("origin", ["", "[local]\norigin = [589012.0, 5194736.0, 0.0]"])
def test_metres_from_the_centre_of_the_earth_are_recognised(tmp_path, write, origin):
    earth = Similarity(1.0, ecef_from_enu(), in_ecef(np.zeros((1, 3)))[0])
    for num_gps in (6, 0):
        survey = Draw(tmp_path / str(num_gps), more=origin, num_gps=num_gps).load(write, changed(draw_block(), earth))
        assert most_missed_px(survey, draw_block()) < CLOSE_PX
        assert any("ECEF" in text for text in survey.findings.assumptions)


@pytest.mark.parametrize("write", [colmap_text, nerfstudio, opensfm])
def test_coordinates_in_crs_are_recognised(tmp_path, write):
    block = draw_block()
    grid = Rotation.from_euler("z", _grid_north_deg(), degrees=True).as_matrix()
    in_crs = replace(block, centres=in_utm(block.centres), cams=block.cams @ grid.T, points=in_utm(block.points))
    for num_gps in (6, 0):
        survey = Draw(tmp_path / str(num_gps), num_gps=num_gps).load(write, in_crs)
        # Along 15 m the grid turns by no more than 1e-6.
        assert most_missed_px(survey, block) < CLOSE_PX
        assert any("are coordinates in ETRS89 / UTM zone 32N" in text for text in survey.findings.assumptions)


def _grid_north_deg() -> float:
    east, north = in_utm(np.array([[0.0, 0.0, 0.0], [0.0, 100.0, 0.0]]))[:, :2].T
    return float(np.degrees(np.arctan2(-(east[1] - east[0]), north[1] - north[0])))


def test_numbers_of_no_frame_are_refused(tmp_path):
    far = Similarity(1.0, np.eye(3), np.array([3.2e5, 7.1e5, 0.0]))
    with pytest.raises(PosesError, match="which is in no local frame, nor in ETRS89"):
        Draw(tmp_path / "s").load(colmap_text, changed(draw_block(), far))


@pytest.mark.parametrize(
    ("draw", "error", "words"),
    [
        ({"num_gps": 0}, ConfigError, "0 of 6 photographs with a pose have one with a height, expected 4"),
        ({"num_gps": 2}, ConfigError, "2 of 6 photographs"),
        ({"num_gps": 3}, PosesError, "GPS positions, .* line|3 GPS positions fit them, and 4 are needed"),
        ({"gps_std_m": 6.0}, PosesError, "tell the scale only to|lie on one line|GPS positions fit them"),
    ],
)
def test_a_block_that_gps_cannot_place_is_refused_with_the_reason(tmp_path, draw, error, words):
    free = random_similarity(np.random.default_rng(5))
    with pytest.raises(error, match=words):
        Draw(tmp_path / "s", **draw).load(colmap_text, changed(draw_block(), free))


@pytest.mark.parametrize("std_m", [0.0, 0.02, 0.5, 3.0])
def test_metric_blocks_are_not_called_free_by_noise_and_free_ones_are(rng, std_m):
    for num, size_m in ((4, 20.0), (30, 20.0), (30, 300.0)):
        for _ in range(3):
            centres = rng.uniform(-1.0, 1.0, (num, 3)) * size_m * [1.0, 1.0, 0.05]
            positions = centres + rng.normal(size=(num, 3)) * std_m + [1e3, -2e3, 50.0]
            assert not GpsFit.of(centres, positions).is_free
            free = random_similarity(rng, (0.02, 0.4))
            if size_m > 40.0 * std_m and num > 4:
                assert GpsFit.of(free(centres), positions).is_free
