"""A run folder: stages used again only where nothing changed, results that are replaced whole, no half files."""

import json
import resource
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from geo.errors import GeoError
from survey.errors import SurveyError
from survey.run.folder import RunDir, stage_record, versions
from survey.run.stages import recompute_reason
from survey.run.stored import load_arrays, save_arrays
from survey.stage_key import stage_key

A, B = {"water": "1", "code": "x"}, {"water": "2", "code": "x"}


def finish(run: RunDir, name: str, key: dict[str, str], **arrays) -> Path:
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
    assert record["key"] == stage_key(A)
    assert record["parts"] == A
    assert 0.0 <= record["seconds"] == stage_record(folder)["seconds"]
    assert record["versions"] == versions()
    assert {"bathynerf", "python", "numpy"} <= set(record["versions"])


def test_a_run_says_why_a_stage_is_computed_again(tmp_path):
    with RunDir(tmp_path / "run") as run:
        assert recompute_reason(run, "sweep", A) is None
        finish(run, "sweep", A, x=np.zeros(1))
        assert recompute_reason(run, "sweep", B) == "the water changed"
        assert recompute_reason(run, "sweep", {"water": "2", "code": "y"}) == "the water and the program changed"
        finish(run, "sweep", {"water": "2", "code": "y"}, x=np.zeros(1))
        assert recompute_reason(run, "sweep", {"water": "2", "code": "z"}) == "the program changed"
        assert recompute_reason(run, "bed", A) is None
        bed = {"sweep": "sweep-1", "code": "x"}
        finish(run, "bed", bed, x=np.zeros(1))
        assert (
            recompute_reason(run, "bed", {"sweep": "sweep-2", "code": "x"}) == "the result of the stage sweep changed"
        )


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
        third = finish(run, "sweep", {"water": "3"}, x=np.ones(2))
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
        publish(run, "standard", "standard", sweep=finish(run, "sweep", {"water": "3"}, x=np.ones(2)))
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


def test_until_a_result_is_whole_the_one_before_stands_and_readers_are_warned(tmp_path, caplog):
    with RunDir(tmp_path / "run") as run:
        publish(run, "old")
    run.warn_if_unfinished()
    assert caplog.text == ""
    with suppress(ZeroDivisionError), run:
        (run.open_result("standard") / "settings.toml").write_text("new")
        raise ZeroDivisionError
    assert contents(run) == {"old"}
    run.warn_if_unfinished()
    assert "has not finished; this is the result of" in caplog.text


@pytest.mark.parametrize("moved", [0, 1, 2, 3])
def test_a_result_that_was_only_begun_to_be_moved_is_moved_by_the_next_process(tmp_path, monkeypatch, caplog, moved):
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
    assert caplog.text == ""
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
