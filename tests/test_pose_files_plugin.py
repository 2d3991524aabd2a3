"""A format of poses from another installed package, as CONTRIBUTING describes it."""

import pytest

from survey import pose_files
from survey.errors import PosesError

MODULE = """
import xml.etree.ElementTree as ET

import numpy as np

from survey.photos.poses import Pose, PoseFile, PoseFrame
from survey.pose_files.format import Format


def read(path):
    cameras = ET.parse(path).getroot()
    poses = [Pose(each.get("image"), np.array([float(v) for v in each.text.split()]), np.diag([1.0, -1.0, -1.0]))
             for each in cameras]
    return PoseFile(tuple(poses), PoseFrame.GRID)


FORMAT = Format(
    name="the cameras of Example (.xml)",
    find=lambda folder: sorted(folder.glob("example_*.xml")),
    recognises=lambda path: path.name.startswith("example_") and path.suffix == ".xml",
    read=read,
)
"""


@pytest.fixture
def plugin(tmp_path, monkeypatch):
    package = tmp_path / "package"
    (package / "example-1.0.dist-info").mkdir(parents=True)
    (package / "example_format.py").write_text(MODULE)
    (package / "example-1.0.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: example\nVersion: 1.0\n")
    (package / "example-1.0.dist-info" / "entry_points.txt").write_text(
        f"[{pose_files.PLUGINS}]\nexample = example_format:FORMAT\n"
    )
    monkeypatch.syspath_prepend(package)
    pose_files.formats.cache_clear()
    yield
    pose_files.formats.cache_clear()


def test_a_format_of_another_package_is_found_recognised_and_read(plugin, tmp_path):
    path = tmp_path / "example_cameras.xml"
    path.write_text('<cameras><camera image="0000.jpg">676120 5311480 600</camera></cameras>')
    assert pose_files.find_poses(tmp_path) == [path]
    (pose,) = pose_files.read_poses(path).poses
    assert pose.name == "0000.jpg"
    assert pose.centre.tolist() == [676120.0, 5311480.0, 600.0]
    with pytest.raises(PosesError, match="the cameras of Example"):
        pose_files.read_poses(tmp_path)
