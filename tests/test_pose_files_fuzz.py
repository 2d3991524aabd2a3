"""No file of poses, however damaged, ends in anything but poses or one clear sentence."""

from __future__ import annotations

import json

import numpy as np
import pycolmap
import pytest
from foreign_block import draw_block
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from test_pose_files_metashape import cameras_xml
from test_pose_files_nerfstudio import transforms
from test_pose_files_opensfm import REFERENCE, block_json, tracks_csv
from test_pose_files_pix4d import CAMERAS, EXTERNAL
from test_pose_files_pix4d import write as write_pix4d
from test_pose_files_tables import metashape_opk, opk_deg, rows, table

from survey.errors import PosesError
from survey.pose_files import find_poses, read_poses, read_ties

# What damages files: other kinds of values, ends of texts and blocks, and numbers that nobody can mean.
PIECES = (
    b"", b"\0", b"nan", b"-inf", b"1e999", b"9" * 5000, b";", b"\t", b'"', b"<", b"</chunk>", b"[", b"]", b"{}",
    b"null", b"true", b"\xff\xfe", b"\xc3\xa9", b"\n\n", b"-1", b"0", b"../../../etc/passwd", b"&a;",
)  # fmt: skip


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> dict[str, tuple[dict[str, bytes], str]]:
    """The files of a survey in each format by their names, and which of these is given."""
    block = draw_block()
    folder = tmp_path_factory.mktemp("whole")
    write_pix4d(folder, block)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 2, 2, 5
    options.num_points2D_without_point3D = 1
    model = pycolmap.synthesize_dataset(options)
    (folder / "text").mkdir()
    (folder / "binary").mkdir()
    model.write_text(folder / "text")
    model.write_binary(folder / "binary")

    def files(place) -> dict[str, bytes]:
        return {path.name: path.read_bytes() for path in sorted(place.iterdir()) if path.is_file()}

    opensfm = {
        "reconstruction.json": json.dumps([block_json(block, reference_lla=REFERENCE)]).encode(),
        "tracks.csv": tracks_csv(block).encode(),
        "reference_lla.json": json.dumps(REFERENCE).encode(),
    }
    header = "image;easting;northing;height;omega;phi;kappa"
    return {
        "Pix4D": (files(folder), EXTERNAL),
        "Pix4D without positions": ({n: t for n, t in files(folder).items() if n != EXTERNAL}, CAMERAS),
        "COLMAP text": (files(folder / "text"), "."),
        "COLMAP binary": (files(folder / "binary"), "."),
        "OpenSfM": (opensfm, "reconstruction.json"),
        "Metashape": ({"cameras.xml": cameras_xml(block).encode()}, "cameras.xml"),
        "nerfstudio": ({"transforms.json": json.dumps(transforms(block)).encode()}, "transforms.json"),
        "lines": ({"cameras.txt": metashape_opk(block).encode()}, "cameras.txt"),
        "table": ({"cameras.csv": table(header, rows(block, opk_deg), ";", ",").encode()}, "cameras.csv"),
    }


FORMATS = (
    "Pix4D", "Pix4D without positions", "COLMAP text", "COLMAP binary", "OpenSfM", "Metashape", "nerfstudio", "lines",
    "table",
)  # fmt: skip


@pytest.mark.parametrize("name", FORMATS)
def test_the_files_are_whole_before_they_are_damaged(whole, tmp_path, name):
    files, given_path = whole[name]
    for file, data in files.items():
        (tmp_path / file).write_bytes(data)
    assert len(read_poses(tmp_path / given_path).poses) >= 4
    assert len(find_poses(tmp_path)) == 1


# Where in a file, how many bytes go, what comes for them (None: the same twice), and whether the rest is cut off.
EDIT = st.tuples(
    st.integers(0, 10**6), st.sampled_from([0, 1, 4, 8, 40]), st.sampled_from([None, *PIECES]), st.integers(0, 9)
)


@pytest.mark.parametrize("name", FORMATS)
@settings(
    max_examples=40, deadline=None, derandomize=True, database=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)  # fmt: skip
@given(which=st.integers(0, 9), edits=st.lists(EDIT, min_size=1, max_size=3))
def test_no_damage_ends_in_another_error(whole, tmp_path, name, which, edits):
    files, given_path = whole[name]
    spoilt = sorted(files)[which % len(files)]
    content = files[spoilt]
    for place, count, piece, cut in edits:
        at = place % (len(content) + 1)
        old, rest = content[at : at + count], content[at + count :]
        content = content[:at] + (old * 2 if piece is None else piece) + (b"" if cut == 0 else rest)
    for file, whole_content in files.items():
        (tmp_path / file).write_bytes(content if file == spoilt else whole_content)
    find_poses(tmp_path)
    for read in (read_poses, read_ties):
        try:
            found = read(tmp_path / given_path)
        except PosesError as error:
            said = str(error)
            found = None
        else:
            said = ""
        assert "\n" not in said
        assert len(said) < 1000
        for pose in found.poses if found is not None and read is read_poses else ():
            assert np.isfinite(pose.centre).all()
            assert pose.cam_from_world @ pose.cam_from_world.T == pytest.approx(np.eye(3), abs=1e-9)
