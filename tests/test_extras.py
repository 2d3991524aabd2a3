"""What needs a library that is not installed says which extra brings it."""

import sys

import pytest

from geo import read_reference
from geo.errors import UnreadableFile, UnwritableFile
from survey.errors import SurveyError
from survey.files.remote import Remote
from survey.photos.exif import read_exif
from survey.run.workers import WorkerNeeds, workers_for
from survey.viewer.page import open_server


def read_heic(path):
    path.write_bytes(b"\0\0\0\x10ftypheic\0\0\0\0")
    read_exif(path)


def start_workers(path):
    with workers_for(2, None, WorkerNeeds(path, path), print):
        pass


@pytest.mark.parametrize(
    ("module", "extra", "name", "use", "words"),
    [
        ("trimesh", "gltf", "r.glb", read_reference, r"r\.glb is read by trimesh, "),
        ("pye57", "e57", "r.e57", read_reference, r"r\.e57 is read by pye57, "),
        ("pillow_heif", "heic", "a.heic", read_heic, None),
        ("fsspec", "remote", "a", lambda _: Remote("s3://bucket/run"), None),
        ("viser", "viewer", "a", lambda _: open_server("localhost", 0, "test"), None),
        ("distributed", "cluster", "a", start_workers, None),
    ],
)
def test_a_library_that_is_missing_is_named_with_its_extra(tmp_path, monkeypatch, module, extra, name, use, words):
    path = tmp_path / name
    path.write_bytes(b"")
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises((SurveyError, UnreadableFile, UnwritableFile, ValueError), match=words) as refused:
        use(path)
    assert f"pip install 'bathynerf[{extra}]'" in str(refused.value)
