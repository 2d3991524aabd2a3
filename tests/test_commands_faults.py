"""Errors while a command runs: each becomes a sentence and its exit code; limits on memory are refused before."""

import errno
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import bathynerf, fake_module, raising

from geo.errors import GeoError, UnreadableFile
from survey import progress as progress_room
from survey.errors import SurveyError


@pytest.fixture(autouse=True)
def has_settings(monkeypatch):
    """The folder of process is not there, and no settings are written into it."""
    fake_module(monkeypatch, "survey.init.draft", require_settings=lambda *_: None, draft=None)


def caused_by(error: Exception, cause: BaseException) -> Exception:
    error.__cause__ = cause
    return error


@pytest.mark.parametrize(
    ("error", "code", "words"),
    [
        (SurveyError("a survey is wrong; correct it"), 2, "a survey is wrong; correct it"),
        (UnreadableFile("cloud.las has no points"), 2, "cloud.las has no points"),
        (OSError(errno.ENOSPC, "No space left on device"), 2, "cannot write run: no space is left on the disk"),
        (
            OSError(errno.ENOSPC, "No space left", "run/a.npy"),
            2,
            "cannot write run/a.npy: no space is left on the disk",
        ),
        (RuntimeError("database or disk is full"), 2, "cannot write run: no space is left on the disk"),
        (PermissionError(errno.EACCES, "Permission denied", "run/log"), 2, "cannot use run/log: permission is denied"),
        (FileNotFoundError(errno.ENOENT, "No such file", "r.ply"), 2, "cannot use r.ply: it does not exist"),
        (OSError(errno.EIO, "Input/output error"), 2, "the disk reports a fault"),
        (MemoryError(), 2, "memory ran out; use --quality draft"),
        (
            RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 8 bytes"),
            2,
            "memory ran out",
        ),
        (RuntimeError("jit_malloc(): out of memory! Could not allocate 8 bytes"), 2, "memory ran out"),
        (RuntimeError("OpenCV(4.9) (-4:Insufficient memory) Failed to allocate 8 bytes"), 2, "memory ran out"),
        (RuntimeError("bad allocation"), 2, "memory ran out"),
        (ImportError("libtorch_cpu.so: failed to map segment from shared object"), 2, "memory ran out"),
        (ImportError("x.so: failed to map segment from shared object: Operation not permitted"), 1, "a bug in"),
        (OSError(errno.ENOMEM, "Cannot allocate memory", "torch"), 2, "memory ran out"),
        (caused_by(GeoError("c.las is damaged"), MemoryError()), 2, "memory ran out"),
        (caused_by(ImportError("numpy failed"), KeyboardInterrupt()), 130, "stopped; finished work is kept"),
        (KeyboardInterrupt(), 130, "stopped; finished work is kept"),
        (RuntimeError("no such tile"), 1, "RuntimeError: no such tile; this is a bug in bathynerf, -v shows where"),
        (
            OSError(errno.EINVAL, "Invalid argument"),
            1,
            "OSError: [Errno 22] Invalid argument; this is a bug in bathynerf",
        ),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, BaseException) else None,
)
def test_every_error_becomes_a_sentence_and_its_exit_code(monkeypatch, tmp_path, error, code, words):
    fake_module(monkeypatch, "survey.run.process", process=raising(error))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run").mkdir()
    result = bathynerf("process", "s", "-o", "run")
    assert result.exit_code == code
    (line,) = result.stderr.splitlines()
    assert words in line


def test_our_own_fault_leaves_its_traceback_in_the_log_and_shows_it_when_asked(monkeypatch, tmp_path):
    log = tmp_path / "run" / "log.txt"

    def process(*_args, **_options):
        progress_room.current().log_to(log)
        raise RuntimeError("no such tile")

    fake_module(monkeypatch, "survey.run.process", process=process)
    assert "Traceback" not in bathynerf("process", "s").stderr
    assert "in process\n    raise RuntimeError" in log.read_text()
    assert "error: RuntimeError: no such tile" in log.read_text()
    assert "Traceback" in bathynerf("process", "s", "-v").stderr


def test_a_full_disk_under_the_log_does_not_hide_the_error(monkeypatch):
    if not Path("/dev/full").exists():
        pytest.skip("this system has no device that is always full")

    def process(*_args, **_options):
        progress_room.current().log_to(Path("/dev/full"))
        progress_room.current().note("a line that does not fit")

    fake_module(monkeypatch, "survey.run.process", process=process)
    result = bathynerf("process", "s", "-o", "run", "-q")
    assert result.exit_code == 2
    assert result.stderr == ("error: cannot write run: no space is left on the disk; free some or write elsewhere\n")


def test_a_command_that_is_told_to_terminate_stops_as_by_ctrl_c(tmp_path):
    code = (
        "import os, signal, time\n"
        "from survey.commands import app\n"
        "app._run = lambda: (os.kill(os.getpid(), signal.SIGTERM), time.sleep(600))\n"
        "app.main()"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=300)
    assert ended.returncode == 130
    assert "stopped" in ended.stderr
