"""No file of poses, however damaged, ends in anything but poses or one clear sentence."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from whole_pose_files import NAMES, whole_pose_files

from survey.errors import PosesError
from survey.pose_files import FORMATS, find_poses, read_poses, read_ties
from survey.words import MOST_CHARACTERS, printable

# What damages files: other kinds of values, ends of texts and blocks, and numbers that nobody can mean.
PIECES = (
    b"", b"\0", b"nan", b"-inf", b"1e999", b"9" * 5000, b";", b"\t", b'"', b"<", b"</chunk>", b"[", b"]", b"{}",
    b"null", b"true", b"\xff\xfe", b"\xc3\xa9", b"\n\n", b"-1", b"0", b"../../../etc/passwd", b"&a;",
)  # fmt: skip


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> dict[str, tuple[dict[str, bytes], str]]:
    return whole_pose_files(tmp_path_factory.mktemp("whole"))


def test_every_format_has_a_whole_file(whole, tmp_path):
    read = set()
    for name, (files, given_path) in whole.items():
        (folder := tmp_path / name).mkdir()
        for file, data in files.items():
            (folder / file).write_bytes(data)
        assert len(read_poses(folder / given_path).poses) >= 4
        assert len(find_poses(folder)) == 1
        read.add(next(known.name for known in FORMATS if known.recognises(folder / given_path)))
    assert tuple(whole) == NAMES
    assert read == {known.name for known in FORMATS}


# Where in a file, how many bytes go, what comes for them (None: the same twice), and whether the rest is cut off.
EDIT = st.tuples(
    st.integers(0, 10**6), st.sampled_from([0, 1, 4, 8, 40]), st.sampled_from([None, *PIECES]), st.integers(0, 9)
)


@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
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
            said = printable(str(error))
            found = None
        else:
            said = ""
        assert "\n" not in said
        assert len(said) < 2 * MOST_CHARACTERS
        for pose in found.poses if found is not None and read is read_poses else ():
            assert np.isfinite(pose.centre).all()
            assert pose.cam_from_world @ pose.cam_from_world.T == pytest.approx(np.eye(3), abs=1e-9)
