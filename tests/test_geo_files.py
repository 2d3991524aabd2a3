"""Files are written whole or not at all."""

import errno
import os
import shutil
from types import SimpleNamespace

import pytest

from geo.errors import UnreadableFile, UnwritableFile
from geo.files import disk_error_text, existing_file, reporting_disk_errors, write_whole


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
        (errno.ENOSPC, "no space is left on the disk"),
        (errno.EDQUOT, "quota"),
        (errno.EROFS, "read-only"),
        (errno.EIO, "the disk reports a fault"),
        (errno.EBADF, os.strerror(errno.EBADF)),
    ],
)
def test_an_error_of_the_disk_names_the_file_and_the_mend(tmp_path, monkeypatch, number, words):
    def refuse(_):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "fsync", refuse)
    refused = pytest.raises(UnwritableFile, match=rf"cannot write .*result\.bin: .*{words}")
    with refused, write_whole(tmp_path / "result.bin") as stream:
        stream.write(b"new")
    assert list(tmp_path.iterdir()) == []


def test_folders_in_the_way_are_named_and_only_a_file_that_is_there_can_be_read(tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("")
    for path, words in (
        (tmp_path / "none/result.bin", "its folder does not exist"),
        (tmp_path / "file/result.bin", "its folder is a file"),
        (tmp_path / "folder", "a folder has this name"),
    ):
        with pytest.raises(UnwritableFile, match=words), write_whole(path) as stream:
            stream.write(b"new")
    assert existing_file(str(tmp_path / "file")) == tmp_path / "file"
    with pytest.raises(UnreadableFile, match="is a folder; expected a file"):
        existing_file(tmp_path)
    with pytest.raises(UnreadableFile, match="none does not exist; correct the path"):
        existing_file(tmp_path / "none")


def test_a_library_that_hides_the_number_of_the_error_is_seen_through_where_the_disk_is_full(tmp_path, monkeypatch):
    def write():
        with write_whole(tmp_path / "result.bin"):
            raise OSError("262144 requested and 8192 written")

    with pytest.raises(UnwritableFile, match="262144 requested"):
        write()
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=0))
    with pytest.raises(UnwritableFile, match="no space is left on the disk"):
        write()


def test_a_symbolic_link_is_followed_and_stays_a_link(tmp_path):
    (tmp_path / "target.bin").write_bytes(b"old")
    (tmp_path / "link.bin").symlink_to("target.bin")
    with write_whole(tmp_path / "link.bin") as stream:
        stream.write(b"new")
    assert (tmp_path / "link.bin").is_symlink()
    assert (tmp_path / "target.bin").read_bytes() == b"new"
    assert len(list(tmp_path.iterdir())) == 2


def test_a_pipe_is_written_into_and_not_replaced(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    reader = os.open(tmp_path / "pipe", os.O_RDONLY | os.O_NONBLOCK)
    with write_whole(tmp_path / "pipe") as stream:
        stream.write(b"new")
    assert os.read(reader, 10) == b"new"
    assert (tmp_path / "pipe").is_fifo()
    os.close(reader)


def test_any_error_of_the_system_in_a_block_names_its_file_or_else_the_block_s(tmp_path):
    gone = pytest.raises(UnwritableFile, match=r"cannot write .*gone/a: its folder does not exist")
    with gone, reporting_disk_errors("run"):
        (tmp_path / "gone" / "a").touch()
    with pytest.raises(UnwritableFile, match=r"cannot write run: the disk quota"), reporting_disk_errors("run"):
        raise OSError(errno.EDQUOT, "quota")
    # One that says nothing of a disk is no refusal.
    assert disk_error_text(OSError(errno.EINVAL, "invalid argument"), tmp_path) is None
    assert disk_error_text(OSError("of a library"), tmp_path) is None
    missing = FileNotFoundError(errno.ENOENT, "no such file")
    assert disk_error_text(missing, "r.ply", verb="use") == "cannot use r.ply: it does not exist; correct the path"


def test_an_error_of_a_file_that_is_read_meanwhile_names_that_file(tmp_path):
    words = r"cannot write .*result\.bin: cannot use .*cloud\.bin: it does not exist; correct the path\."
    with pytest.raises(UnwritableFile, match=words), write_whole(tmp_path / "result.bin") as stream:
        stream.write((tmp_path / "run" / "cloud.bin").read_bytes())
    assert list(tmp_path.iterdir()) == []
