"""Files are written whole or not at all."""

from __future__ import annotations

import errno
import os

import pytest

from geo.errors import UnreadableFile, UnwritableFile
from geo.files import existing_file, write_whole


def test_a_file_appears_only_when_it_is_whole(tmp_path):
    path = tmp_path / "result.bin"
    with write_whole(path) as stream:
        stream.write(b"first half, ")
        assert not path.exists()
        stream.write(b"second half")
    assert path.read_bytes() == b"first half, second half"
    assert list(tmp_path.iterdir()) == [path]


def test_an_error_of_the_writer_passes_and_leaves_the_old_file(tmp_path):
    path = tmp_path / "result.bin"
    path.write_bytes(b"old")

    def fail_halfway():
        with write_whole(path) as stream:
            stream.write(b"new")
            raise KeyError("ours")

    with pytest.raises(KeyError, match="ours"):
        fail_halfway()
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("number", "words"),
    [
        (errno.ENOSPC, "no room is left on the disk"),
        (errno.EDQUOT, "quota"),
        (errno.EROFS, "read-only"),
        (errno.EIO, os.strerror(errno.EIO)),
    ],
)
def test_an_error_of_the_disk_names_the_file_and_the_mend(tmp_path, monkeypatch, number, words):
    def refuse(_):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "fsync", refuse)
    with (
        pytest.raises(UnwritableFile, match=rf"cannot write .*result\.bin: .*{words}"),
        write_whole(tmp_path / "result.bin") as stream,
    ):
        stream.write(b"new")
    assert list(tmp_path.iterdir()) == []


def test_folders_in_the_way_are_named(tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("")
    for path, words in (
        (tmp_path / "none/result.bin", "its folder does not exist"),
        (tmp_path / "file/result.bin", "its folder is a file"),
        (tmp_path / "folder", "a folder has this name"),
    ):
        with pytest.raises(UnwritableFile, match=words), write_whole(path) as stream:
            stream.write(b"new")


def test_only_a_file_that_is_there_can_be_read(tmp_path):
    (tmp_path / "file").write_text("")
    assert existing_file(str(tmp_path / "file")) == tmp_path / "file"
    with pytest.raises(UnreadableFile, match="is a folder; expected a file"):
        existing_file(tmp_path)
    with pytest.raises(UnreadableFile, match="none does not exist; correct the path"):
        existing_file(tmp_path / "none")
