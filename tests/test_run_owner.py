"""Who may write a run folder: one process at a time, and the survey whose run it is; other folders are refused."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from small_survey import SIZE, small_survey, write_image

from geo.errors import UnwritableFile
from survey.errors import SurveyError
from survey.folder.found import find_survey
from survey.run.folder import Owner, RunDir
from survey.run.process import process


def _other_process(run: Path) -> subprocess.Popen:
    """Another process that is writing the run, until its standard input closes."""
    code = (
        "import sys; from survey.run.folder import RunDir\n"
        f"with RunDir({str(run)!r}): print('writing', flush=True); sys.stdin.read()"
    )
    other = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert other.stdout.readline() == "writing\n"
    return other


def test_a_second_process_is_refused_and_told_who_writes(tmp_path):
    with _other_process(tmp_path / "run") as other:
        with pytest.raises(SurveyError, match=rf"written by another process \(number {other.pid}\).*wait"):
            RunDir(tmp_path / "run").__enter__()
        other.communicate("")
    with RunDir(tmp_path / "run") as run:
        assert run.path.is_dir()
    assert list(run.path.glob(".lock*")) == []


def test_the_lock_of_a_killed_process_is_taken_over(tmp_path):
    with _other_process(tmp_path / "run") as other:
        other.send_signal(signal.SIGKILL)
        other.wait()
        assert (tmp_path / "run" / ".lock.pid").read_text() == str(other.pid)
    with RunDir(tmp_path / "run") as run:
        assert (run.path / ".lock.pid").read_text() == str(os.getpid())


def test_a_folder_with_other_things_in_it_is_refused_and_left_alone(tmp_path):
    (tmp_path / "images").mkdir()
    (tmp_path / ".DS_Store").touch()
    with pytest.raises(SurveyError, match=r"not empty and is no run \(it has images\).*-o"):
        RunDir(tmp_path).__enter__()
    assert sorted(p.name for p in tmp_path.iterdir()) == [".DS_Store", "images"]


def test_a_file_in_place_of_the_run_folder_is_refused(tmp_path):
    path = tmp_path / "run"
    path.touch()
    with pytest.raises(SurveyError, match=r"run is a file.*-o"):
        RunDir(path).__enter__()
    with pytest.raises(UnwritableFile, match=r"cannot write .*run.*: "):
        RunDir(path / "below").__enter__()


@pytest.mark.parametrize("make", [False, True])
def test_what_is_no_run_cannot_be_read_as_one(tmp_path, make):
    if make:
        (tmp_path / "run").mkdir()
    with pytest.raises(SurveyError, match="is no run folder" if make else "does not exist"):
        RunDir(tmp_path / "run").require_run()


def test_a_survey_folder_given_for_its_run_is_answered_with_the_run(tmp_path):
    with RunDir(tmp_path / "bathynerf") as run:
        run.require_run()
    with pytest.raises(SurveyError, match=rf"no run folder; name {run.path}"):
        RunDir(tmp_path).require_run()


@pytest.mark.skipif(os.geteuid() == 0, reason="nothing is forbidden to root")
def test_a_folder_without_permission_is_named(tmp_path):
    tmp_path.chmod(0o500)
    try:
        with pytest.raises(UnwritableFile, match=r"cannot write .*run: permission is denied"):
            RunDir(tmp_path / "run").__enter__()
    finally:
        tmp_path.chmod(0o700)


def files_of(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_run_of_other_photographs_is_refused_with_the_way_out(tmp_path):
    """Of a survey as it grows, is renamed or thinned out it stays; names of cameras alone make no survey."""
    sizes = {f"DJI_{i:04d}.JPG": 1000 + i for i in range(10)}
    first, other = Owner("a", sizes), Owner("b", {name: size + 500 for name, size in sizes.items()})
    run = RunDir(tmp_path / "run")
    with run:
        run.claim(first, is_inside=False)
    for same in (
        Owner("renamed", sizes),
        Owner("a", sizes | {f"new_{i}.JPG": 7 for i in range(30)}),
        Owner("a", dict(list(sizes.items())[:4])),
    ):
        with run:
            run.claim(same, is_inside=False)
            run.claim(first, is_inside=False)
    with run, pytest.raises(SurveyError, match=r"another survey, a, .*\(0 of 10 .*another folder with -o, or remove"):
        run.claim(other, is_inside=False)
    with run:
        run.claim(other, is_inside=True)
    with run, pytest.raises(SurveyError, match="another survey, b"):
        run.claim(first, is_inside=False)


def test_a_run_of_a_version_that_noted_no_survey_is_taken_over(tmp_path):
    run = RunDir(tmp_path / "run")
    with run:  # marked, and claimed by nobody
        run.claim(Owner("a", {"1.jpg": 5}), is_inside=False)
    with run, pytest.raises(SurveyError, match="another survey, a"):
        run.claim(Owner("b", {"1.jpg": 6}), is_inside=False)


def test_process_into_the_run_of_another_survey_changes_nothing(tmp_path):
    surveys = [small_survey(tmp_path / name) for name in ("a", "b")]
    for i, image in enumerate(sorted((surveys[1] / "images").iterdir())):
        write_image(image, size=SIZE, ImageDescription="x" * (i + 1))
    run = RunDir(tmp_path / "run")
    with run:
        found = find_survey(surveys[0])
        run.claim(Owner.of("a", found.images), is_inside=False)
    before = files_of(run.path)
    with pytest.raises(SurveyError, match="belongs to another survey, a"):
        process(surveys[1], run.path)
    assert files_of(run.path) == before


def test_another_photograph_under_the_same_name_is_refused_by_name(tmp_path):
    path = tmp_path / "0001.jpg"
    path.write_bytes(bytes(10))
    owner = Owner.of("a", {"0001.jpg": path})
    owner.require_unchanged("0001.jpg", path)
    path.write_bytes(bytes(11))
    with pytest.raises(SurveyError, match=r"0001.jpg is not the photograph that the run used: it has 11 bytes, .* 10"):
        owner.require_unchanged("0001.jpg", path)
    path.write_bytes(b"x" + bytes(9))
    with pytest.raises(SurveyError, match=r"0001.jpg is not the photograph .*: it has the same size and another con"):
        owner.require_unchanged("0001.jpg", path)
    with pytest.raises(SurveyError, match=r"another survey, a, with other photographs \(0 of 1 have the same name, si"):
        owner.require_same(Owner.of("b", {"0001.jpg": path}), tmp_path)
    # Runs of earlier versions know sizes only.
    Owner.from_record({"survey": "a", "photographs": {"0001.jpg": 10}}).require_unchanged("0001.jpg", path)
