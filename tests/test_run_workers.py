"""Tiles by worker processes: the cloud of one process, also where workers end on the way."""

from __future__ import annotations

import sys
import time
from contextlib import suppress
from pathlib import Path
from threading import Event, Thread

import psutil
import pytest
from drawn_runs import drawn

from survey.errors import SurveyError
from survey.progress import Progress
from survey.run.folder import RunDir
from survey.run.process import process
from survey.run.workers import workers_for


@pytest.fixture(scope="module")
def survey(tmp_path_factory):
    return drawn(tmp_path_factory.mktemp("workers") / "survey", num_views=12)


@pytest.fixture(scope="module")
def in_one_process(survey):
    return points_of(survey, "one", workers=1)


def points_of(survey, name: str, workers: int) -> bytes:
    """What the bed of a run in three tiles holds."""
    folder = survey.folder.parent / name
    with Progress(verbosity=-1):
        assert process(survey.folder, folder, tiles=3, workers=workers) == 0
    run = RunDir(folder)
    assert not list(run.stages_path.glob(".*.part"))
    return (run.load_stage("bed") / "bed.npz").read_bytes()


@pytest.mark.slow
def test_workers_leave_the_bytes_of_one_process(survey, in_one_process):
    assert points_of(survey, "two", workers=2) == in_one_process


@pytest.mark.slow
def test_a_worker_that_is_killed_changes_nothing(survey, in_one_process):
    stages, ended, killed = survey.folder.parent / "killed" / "stages", Event(), []

    def kill() -> None:
        while not ended.is_set() and not killed:
            begun = list(stages.glob(".sweep_tile*.part")) or list(stages.glob(".solver_tile*.part"))
            for worker in workers_here() if begun else []:
                worker.kill()
                killed.append(worker.pid)
                break
            time.sleep(0.05)

    thread = Thread(target=kill)
    thread.start()
    try:
        assert points_of(survey, "killed", workers=2) == in_one_process
    finally:
        ended.set()
        thread.join()
    assert killed


def workers_here() -> list[psutil.Process]:
    """Processes that Dask has started from this one."""
    found = []
    for each in psutil.Process().children(recursive=True):
        with suppress(psutil.Error):
            if "spawn_main" in " ".join(each.cmdline()) and each.children() == []:
                found.append(each)
    return found


def test_without_dask_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(SurveyError, match=r"pip install 'bathynerf\[cluster\]'"), workers_for(2, None, tmp_path, print):
        pass


def test_a_scheduler_that_does_not_answer_is_named(tmp_path, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr("survey.run.workers._PATIENCE_S", 0.5)
    nowhere = "tcp://127.0.0.1:9"
    with (
        pytest.raises(SurveyError, match=rf"--scheduler {nowhere} gave no 1 workers within 0 s"),
        workers_for(1, nowhere, Path(tmp_path), print),
    ):
        pass
