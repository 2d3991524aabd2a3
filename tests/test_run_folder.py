"""A run folder: stages used again only where nothing changed, one writer at a time, no half files."""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from fields.sweep.sweep import DepthMap
from geo.errors import GeoError, UnwritableFile
from survey.errors import SurveyError
from survey.run.folder import RunDir, load_arrays, save_arrays, stage_key, versions
from survey.run.stored import load_depth_maps, save_depth_maps


def finish(run: RunDir, name: str, key: str, **arrays) -> Path:
    folder = run.open_stage(name)
    save_arrays(folder / "data.npz", **arrays)
    return run.finish_stage(name, key, folder)


def test_a_finished_stage_is_found_again_by_its_key_and_only_by_its_key(tmp_path):
    heights = np.linspace(-3.0, 1.0, 7)
    with RunDir(tmp_path / "run") as run:
        assert not run.stage_is_current("sweep", "a")
        finish(run, "sweep", "a", heights=heights)
    again = RunDir(tmp_path / "run")
    assert again.stage_is_current("sweep", "a")
    assert not again.stage_is_current("sweep", "b")
    assert not again.stage_is_current("bed", "a")
    np.testing.assert_array_equal(load_arrays(again.load_stage("sweep") / "data.npz")["heights"], heights)


def test_the_record_of_a_stage_has_key_seconds_and_versions(tmp_path):
    with RunDir(tmp_path / "run") as run:
        folder = finish(run, "sweep", "a", x=np.zeros(1))
        record = json.loads((folder / "stage.json").read_text())
        assert record["key"] == "a"
        assert 0.0 <= record["seconds"] == run.stage_seconds("sweep") < 60.0
        assert record["versions"] == versions()
        assert {"bathynerf", "python", "numpy"} <= set(record["versions"])
        assert run.stage_seconds("bed") is None


def test_finishing_a_stage_again_replaces_its_older_result_whole(tmp_path):
    with RunDir(tmp_path / "run") as run:
        folder = run.open_stage("sweep")
        (folder / "only_in_the_first").touch()
        run.finish_stage("sweep", "a", folder)
        finish(run, "sweep", "b", x=np.ones(2))
        assert run.stage_is_current("sweep", "b")
        assert sorted(p.name for p in run.load_stage("sweep").iterdir()) == ["data.npz", "stage.json"]
        assert [p.name for p in run.stages_path.iterdir()] == ["sweep"]


def test_a_stage_that_failed_keeps_the_older_result_and_leaves_nothing_behind(tmp_path):
    with RunDir(tmp_path / "run") as run:
        finish(run, "sweep", "a", x=np.ones(2))
    with suppress(ZeroDivisionError), RunDir(tmp_path / "run") as run:
        (run.open_stage("sweep") / "half").touch()
        raise ZeroDivisionError
    assert [p.name for p in run.stages_path.iterdir()] == ["sweep"]
    assert RunDir(tmp_path / "run").stage_is_current("sweep", "a")


def test_a_stage_folder_is_fresh_after_a_killed_run(tmp_path):
    with RunDir(tmp_path / "run") as run:
        (run.open_stage("sweep") / "half").touch()
        assert list(run.open_stage("sweep").iterdir()) == []


def test_files_that_a_killed_run_left_half_written_are_removed(tmp_path):
    run = RunDir(tmp_path / "run")
    with run:
        pass
    halves = [run.path / ".cloud.las.4711.part", run.pictures_path / ".depth.png.4711.part"]
    for path in (*halves, run.cloud_path):
        path.touch()
    with run:
        assert not any(path.exists() for path in halves)
    assert run.cloud_path.exists()


def test_a_damaged_record_means_that_the_stage_is_computed_anew(tmp_path):
    with RunDir(tmp_path / "run") as run:
        folder = finish(run, "sweep", "a", x=np.ones(2))
        (folder / "stage.json").write_text('{"key": "a')
        assert not run.stage_is_current("sweep", "a")
        with pytest.raises(SurveyError, match=r"no finished stage sweep.*process"):
            run.load_stage("sweep")


def test_stages_are_written_only_while_the_run_is_locked(tmp_path):
    with pytest.raises(RuntimeError, match="with block"):
        RunDir(tmp_path).open_stage("sweep")


# --- one writer at a time ---------------------------------------------------------------------------------


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
    assert not (run.path / ".lock").exists()


def test_the_lock_of_a_killed_process_is_taken_over(tmp_path):
    with _other_process(tmp_path / "run") as other:
        other.send_signal(signal.SIGKILL)
        other.wait()
        assert (tmp_path / "run" / ".lock").read_text() == str(other.pid)
    with RunDir(tmp_path / "run") as run:
        assert (run.path / ".lock").read_text() == str(os.getpid())


# --- folders that are no run, and disks that refuse -------------------------------------------------------


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


def test_a_disk_without_room_is_named_and_earlier_stages_stay(tmp_path):
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    with RunDir(tmp_path / "run") as run:
        finish(run, "sweep", "a", x=np.ones(2))
        folder = run.open_stage("bed")
        # A limit on the size of files is the one full disk that a test can make.
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
        try:
            with pytest.raises(GeoError, match=r"cannot write .*bed\.npz: .*write elsewhere"):
                save_arrays(folder / "bed.npz", x=np.zeros(100_000))
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        assert list(folder.iterdir()) == []
    assert run.stage_is_current("sweep", "a")


@pytest.mark.skipif(os.geteuid() == 0, reason="nothing is forbidden to root")
def test_a_folder_without_permission_is_named(tmp_path):
    tmp_path.chmod(0o500)
    try:
        with pytest.raises(UnwritableFile, match=r"cannot write .*run: permission is denied"):
            RunDir(tmp_path / "run").__enter__()
    finally:
        tmp_path.chmod(0o700)


# --- keys ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Settings:
    rungs: int = 64
    step_px: float = 0.5


def test_keys_tell_apart_what_differs_and_only_that(tmp_path):
    image = tmp_path / "a.jpg"
    image.write_bytes(b"pixels")
    different = [
        (),
        (1,),
        (1.0,),
        ("1",),
        (True,),
        (None,),
        ("a", "b"),
        (("a", "b"),),
        ("ab",),
        ({"a": "b"},),
        (Settings(),),
        (Settings(rungs=65),),
        ({"rungs": 64, "step_px": 0.5},),
        (np.array([1.0, 2.0]),),
        (np.array([1.0, 2.0], dtype=np.float32),),
        (np.array([[1.0, 2.0]]),),
        (image,),
        ([image, image],),
        (tmp_path,),
    ]
    keys = [stage_key(*parts) for parts in different]
    assert len(set(keys)) == len(keys)
    assert keys == [stage_key(*parts) for parts in different]
    assert stage_key({"a": 1, "b": 2}) == stage_key({"b": 2, "a": 1})
    assert stage_key(np.float64(0.1), np.arange(6).reshape(2, 3).T) == stage_key(
        0.1, np.ascontiguousarray(np.arange(6).reshape(2, 3).T)
    )


def test_a_key_changes_with_the_pixels_or_the_time_of_a_file_but_not_with_its_place(tmp_path):
    image, moved = tmp_path / "a.jpg", tmp_path / "moved" / "a.jpg"
    image.write_bytes(b"pixels")
    first = stage_key(image)
    stat = image.stat()
    moved.parent.mkdir()
    moved.write_bytes(b"pixels")
    os.utime(moved, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    assert stage_key(moved) == first
    os.utime(moved, ns=(stat.st_atime_ns, stat.st_mtime_ns + 1))
    assert stage_key(moved) != first
    moved.write_bytes(b"pixelt")
    os.utime(moved, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    assert stage_key(moved) != first


def test_a_key_of_a_file_that_is_gone_names_it(tmp_path):
    with pytest.raises(SurveyError, match=r"cannot read .*gone\.jpg"):
        stage_key(tmp_path / "gone.jpg")


@pytest.mark.parametrize("part", [{1, 2}, object(), np.array([None])])
def test_parts_without_a_fixed_form_are_refused(part):
    with pytest.raises(TypeError, match="stage_key got"):
        stage_key(part)


# --- arrays ------------------------------------------------------------------------------------------------


def test_depth_maps_come_back_as_they_were_whatever_their_sizes(tmp_path, rng):
    def depth_map(view: int, *size: int) -> DepthMap:
        height, score, curvature, spread = rng.normal(size=(4, *size)).astype(np.float32)
        return DepthMap(view, height, score, curvature, rng.integers(0, 9, size).astype(np.uint8), spread)

    maps = [depth_map(7, 4, 6), depth_map(3, 3, 5)]
    save_depth_maps(tmp_path / "maps.npz", maps)
    again = load_depth_maps(tmp_path / "maps.npz")
    assert [m.view for m in again] == [7, 3]
    for old, new in zip(maps, again, strict=True):
        for name in ("height", "score", "curvature", "agreeing", "spread"):
            assert getattr(old, name).dtype == getattr(new, name).dtype
            np.testing.assert_array_equal(getattr(old, name), getattr(new, name))


def test_depth_maps_that_lack_an_array_are_named_with_the_mend(tmp_path):
    save_arrays(tmp_path / "maps.npz", views=np.array([0]), height_0=np.zeros((2, 2)))
    with pytest.raises(SurveyError, match=r"maps\.npz lacks the array 'score_0'; delete.*process"):
        load_depth_maps(tmp_path / "maps.npz")


@pytest.mark.parametrize("spoil", ["missing", "cut", "text"])
def test_arrays_that_cannot_be_read_are_named_with_the_mend(tmp_path, spoil):
    path = tmp_path / "data.npz"
    save_arrays(path, x=np.zeros(1000))
    if spoil == "missing":
        path.unlink()
    elif spoil == "cut":
        path.write_bytes(path.read_bytes()[:2000])
    else:
        path.write_text("not arrays")
    with pytest.raises(SurveyError, match=r"data\.npz cannot be read.*process"):
        load_arrays(path)
