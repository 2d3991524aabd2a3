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
from small_survey import SIZE, small_survey, write_image

from fields.solver.solver import SolvedMap
from fields.sweep.maps import DepthMap
from geo.errors import GeoError, UnwritableFile
from survey.errors import SurveyError
from survey.folder.found import find_survey
from survey.run.folder import RunDir, seconds_of, versions
from survey.run.keys import Key
from survey.run.owner import Owner
from survey.run.process import process
from survey.run.stored import load_arrays, save_arrays
from survey.run.stored_maps import Stored, kept_aside, save_maps
from survey.stage_key import stage_key

A, B = Key({"water": "1", "code": "x"}), Key({"water": "2", "code": "x"})


def finish(run: RunDir, name: str, key: Key, **arrays) -> Path:
    folder = run.open_stage(name)
    save_arrays(folder / "data.npz", **arrays)
    return run.finish_stage(name, key, folder)


def publish(run: RunDir, words: str, quality: str = "standard", **stages: Path) -> None:
    """A result whose settings, cloud and a picture hold some words."""
    folder = run.open_result(quality)
    (folder / "pictures").mkdir()
    for name in ("settings.toml", "cloud.las", f"pictures/{words}.png"):
        (folder / name).write_text(words)
    run.publish(folder, quality=quality, stages=stages)


def contents(run: RunDir) -> set[str]:
    """What settings, cloud and pictures of a run hold."""
    texts = {path.read_text() for path in (run.settings_path, run.cloud_path) if path.exists()}
    return texts | {path.stem for path in run.pictures_path.glob("*")}


def test_a_result_without_an_adjustment_takes_away_the_cameras_of_the_one_before(tmp_path):
    with RunDir(tmp_path / "run") as run:
        adjusted = run.open_result("standard")
        (adjusted / "sparse").mkdir()
        for name in ("adjustment.json", "adjustment.npz", "cameras.csv", "sparse/images.txt"):
            (adjusted / name).write_text("poses")
        run.publish(adjusted, quality="standard", stages={})
        assert (run.path / "sparse" / "images.txt").read_text() == "poses"
        publish(run, "fixed")
        left = {path.name for path in run.path.iterdir()}
    assert not left & {"adjustment.json", "adjustment.npz", "cameras.csv", "sparse"}


def test_a_finished_stage_is_found_again_by_its_key_and_only_by_its_key(tmp_path):
    heights = np.linspace(-3.0, 1.0, 7)
    with RunDir(tmp_path / "run") as run:
        assert run.finished_stage("sweep", A) is None
        finish(run, "sweep", A, heights=heights)
    again = RunDir(tmp_path / "run")
    assert again.finished_stage("sweep", B) is None
    assert again.finished_stage("bed", A) is None
    np.testing.assert_array_equal(load_arrays(again.finished_stage("sweep", A) / "data.npz")["heights"], heights)


def test_the_record_of_a_stage_has_key_parts_seconds_and_versions(tmp_path):
    with RunDir(tmp_path / "run") as run:
        folder = finish(run, "sweep", A, x=np.zeros(1))
    record = json.loads((folder / "stage.json").read_text())
    assert record["key"] == A.digest
    assert record["parts"] == A.parts
    assert 0.0 <= record["seconds"] == seconds_of(folder)
    assert record["versions"] == versions()
    assert {"bathynerf", "python", "numpy"} <= set(record["versions"])


def test_a_run_says_why_a_stage_is_computed_again(tmp_path):
    with RunDir(tmp_path / "run") as run:
        assert run.why_again("sweep", A) is None
        finish(run, "sweep", A, x=np.zeros(1))
        assert run.why_again("sweep", B) == "the water changed"
        assert run.why_again("sweep", Key({"water": "2", "code": "y"})) == "the water and the program changed"
        finish(run, "sweep", Key({"water": "2", "code": "y"}), x=np.zeros(1))
        assert run.why_again("sweep", Key({"water": "2", "code": "z"})) == "the program changed"
        assert run.why_again("bed", A) is None
        bed = Key({"sweep": "sweep-1", "code": "x"})
        finish(run, "bed", bed, x=np.zeros(1))
        assert run.why_again("bed", Key({"sweep": "sweep-2", "code": "x"})) == "the result of the stage sweep changed"


def test_results_of_other_settings_stand_side_by_side_until_a_result_replaces_them(tmp_path):
    with RunDir(tmp_path / "run") as run:
        first = finish(run, "sweep", A, x=np.ones(2))
        second = finish(run, "sweep", B, x=np.ones(2))
        assert first.exists()
        publish(run, "draft", "draft", sweep=first)
        assert first.exists()
        assert not second.exists()
        second = finish(run, "sweep", B, x=np.ones(2))
        publish(run, "standard", "standard", sweep=second)
        assert run.load_stage("sweep") == second
        assert first.exists()
        third = finish(run, "sweep", Key({"water": "3"}), x=np.ones(2))
        publish(run, "again", "draft", sweep=third)
        assert run.load_stage("sweep") == third
        assert second.exists()
        assert not first.exists()


def test_stages_of_an_unfinished_run_stay_when_another_quality_is_published(tmp_path):
    with suppress(ZeroDivisionError), RunDir(tmp_path / "run") as run:
        run.open_result("standard")
        kept = finish(run, "sweep", A, x=np.ones(2))
        raise ZeroDivisionError
    with run:
        publish(run, "draft", "draft", sweep=finish(run, "sweep", B, x=np.ones(2)))
        assert kept.exists()
    with run:
        publish(run, "standard", "standard", sweep=finish(run, "sweep", Key({"water": "3"}), x=np.ones(2)))
        assert not kept.exists()


def test_a_finished_stage_that_lost_a_file_is_computed_again(tmp_path):
    with RunDir(tmp_path / "run") as run:
        folder = finish(run, "sweep", A, x=np.ones(2))
    assert run.finished_stage("sweep", A, ["data.npz"]) == folder
    (folder / "data.npz").unlink()
    assert run.finished_stage("sweep", A, ["data.npz"]) is None


def test_a_stage_that_failed_leaves_nothing_behind(tmp_path):
    with RunDir(tmp_path / "run") as run:
        finish(run, "sweep", A, x=np.ones(2))
    with suppress(ZeroDivisionError), RunDir(tmp_path / "run") as run:
        (run.open_stage("sweep") / "half").touch()
        raise ZeroDivisionError
    (only,) = run.stages_path.iterdir()
    assert only == RunDir(tmp_path / "run").finished_stage("sweep", A)


def test_a_new_result_replaces_the_one_before_whole(tmp_path):
    with RunDir(tmp_path / "run") as run:
        publish(run, "old")
        (run.path / "report.html").write_text("old")
        publish(run, "new")
    assert contents(run) == {"new"}
    assert not (run.path / "report.html").exists()


def test_until_a_result_is_whole_the_one_before_stands_and_readers_are_warned(tmp_path, capsys):
    with RunDir(tmp_path / "run") as run:
        publish(run, "old")
    run.warn_if_unfinished()
    assert capsys.readouterr().err == ""
    with suppress(ZeroDivisionError), run:
        (run.open_result("standard") / "settings.toml").write_text("new")
        raise ZeroDivisionError
    assert contents(run) == {"old"}
    run.warn_if_unfinished()
    assert "has not finished; this is the result of" in capsys.readouterr().err


@pytest.mark.parametrize("moved", [0, 1, 2, 3])
def test_a_result_that_was_only_begun_to_be_moved_is_moved_by_the_next_process(tmp_path, monkeypatch, capsys, moved):
    with RunDir(tmp_path / "run") as run:
        publish(run, "old")
    rename, moves = Path.rename, []

    def killed(path, target):
        if path.parent.name == ".result.whole":
            moves.append(path)
            if len(moves) > moved:
                raise KeyboardInterrupt
        return rename(path, target)

    monkeypatch.setattr(Path, "rename", killed)
    with pytest.raises(KeyboardInterrupt), run:
        publish(run, "new")
    monkeypatch.undo()
    with pytest.raises(SurveyError, match="stopped while it put its result"):
        run.require_run()
    with run:
        pass
    run.require_run()
    run.warn_if_unfinished()
    assert capsys.readouterr().err == ""
    assert contents(run) == {"new"}


def test_a_stage_folder_is_fresh_after_a_killed_run(tmp_path):
    with RunDir(tmp_path / "run") as run:
        (run.open_stage("sweep") / "half").touch()
        assert list(run.open_stage("sweep").iterdir()) == []


def test_files_that_a_killed_run_left_half_written_are_removed(tmp_path):
    run = RunDir(tmp_path / "run")
    with run:
        half = run.open_result("standard") / "cloud.las"
        half.touch()
    (run.path / ".log.4711.part").touch()
    run.cloud_path.touch()
    with run:
        assert not half.parent.exists()
        assert not (run.path / ".log.4711.part").exists()
    assert run.cloud_path.exists()


def test_a_damaged_record_means_that_the_stage_is_computed_anew(tmp_path):
    with RunDir(tmp_path / "run") as run:
        folder = finish(run, "sweep", A, x=np.ones(2))
        publish(run, "old", sweep=folder)
        (folder / "stage.json").write_text('{"key": "a')
        assert run.finished_stage("sweep", A) is None
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
        finish(run, "sweep", A, x=np.ones(2))
        folder = run.open_stage("bed")
        # A limit on the size of files is the one full disk that a test can make.
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
        try:
            with pytest.raises(GeoError, match=r"cannot write .*bed\.npz: .*write elsewhere"):
                save_arrays(folder / "bed.npz", x=np.zeros(100_000))
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        assert list(folder.iterdir()) == []
    assert run.finished_stage("sweep", A) is not None


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


def test_a_key_changes_with_every_byte_of_a_file_but_not_with_its_place_or_time(tmp_path):
    image, copy = tmp_path / "a.jpg", tmp_path / "copy" / "a.jpg"
    pixels = bytes(2 << 20)
    image.write_bytes(pixels)
    first = stage_key(image)
    copy.parent.mkdir()
    copy.write_bytes(pixels)
    os.utime(copy, ns=(0, 0))
    assert stage_key(copy) == first
    copy.write_bytes(pixels[:-1] + b"1")
    os.utime(copy, ns=(0, 0))
    assert stage_key(copy) != first


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
        height, score, spread = rng.normal(size=(3, *size)).astype(np.float32)
        return DepthMap(view, height, score, rng.integers(0, 9, size).astype(np.uint8), spread)

    maps = [depth_map(7, 4, 6), depth_map(3, 3, 5)]
    save_maps(tmp_path / "maps.npz", DepthMap, maps)
    again = Stored(tmp_path / "maps.npz", DepthMap)
    assert [m.view for m in again] == [7, 3]
    for old, new in zip(maps, again, strict=True):
        for name in ("height", "score", "agreeing", "spread"):
            assert getattr(old, name).dtype == getattr(new, name).dtype
            np.testing.assert_array_equal(getattr(old, name), getattr(new, name))


@pytest.mark.parametrize(("in_memory", "num_files"), [(0, 2), (48, 1), (96, 0)])
def test_maps_that_are_worked_on_lie_in_a_folder_where_memory_has_no_room(tmp_path, rng, in_memory, num_files):
    maps = [SolvedMap(np.arange(3), *rng.normal(size=(2, 3)).astype(np.float32)) for _ in range(2)]
    assert maps[0].pixels.nbytes + maps[0].height.nbytes + maps[0].std.nbytes == 48
    with kept_aside(tmp_path / "scratch", SolvedMap, in_memory) as keep:
        first, second = keep(), keep()
        for place, solved in zip((first, second), maps, strict=True):
            place[4] = solved
            place[4] = solved
            np.testing.assert_array_equal(place[4].height, solved.height)
        assert len(list(tmp_path.rglob("*.npy"))) == num_files
        assert (list(first), 4 in first, 5 in first, len(second)) == ([4], True, False, 1)
        first.clear()
        with pytest.raises(KeyError):
            first[4]
        second[5] = maps[0]
        assert (list(first), list(second)) == ([], [4, 5])
    assert list(tmp_path.iterdir()) == []


def test_depth_maps_that_lack_an_array_are_named_with_the_mend(tmp_path):
    save_arrays(tmp_path / "maps.npz", views=np.array([0]), height_0=np.zeros((2, 2)))
    with pytest.raises(SurveyError, match=r"maps\.npz cannot be read .*lacks the array score_0.*delete.*process"):
        Stored(tmp_path / "maps.npz", DepthMap)


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


# --- whose run it is ----------------------------------------------------------------------------------------


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
