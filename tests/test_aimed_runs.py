"""Runs with an aim in place of a quality, from photographs to the cloud; their clock is set by hand."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from drawn_runs import GSD, SMALL, DrawnRun, drawn, inner90

from fields.solver.solver import SolvedMap, solve_maps
from geo import read_cloud
from survey import machine
from survey.errors import SurveyError
from survey.progress import Progress
from survey.run import process as process_module
from survey.run import stage_solver
from survey.run.clock import Clock
from survey.run.process import process

# Twice the pixels along each side of `drawn_runs.SMALL`: images of half the size are still matched.
FINER = {"image_px": (400, 300), "focal_px": 600.0, "noise": 1.0, "num_views": 7, "size_m": (2.4, 2.0)}
# For what is refused before any photograph is matched.
FEW = SMALL | {"num_views": 4, "size_m": (1.2, 1.0), "cell_m": 0.1, "texel_m": 0.05, "objects": False}


def run_with(run: DrawnRun, **aim) -> tuple[int, str]:
    """Process a survey; the exit code and the log."""
    with Progress(verbosity=-1):
        code = process(run.folder, **aim)
    return code, run.run.log_path.read_text(encoding="utf-8")


def decisions_of(run: DrawnRun) -> list[dict]:
    return json.loads(run.run.plan_path.read_text(encoding="utf-8"))["decisions"]


def rounds(run: DrawnRun) -> list[str]:
    """What the plan says of the rounds."""
    return [each["choice"] for each in decisions_of(run) if each["name"].startswith("round")]


def scale_of(run: DrawnRun) -> float:
    return json.loads(run.run.plan_path.read_text(encoding="utf-8"))["image_scale"]


@pytest.fixture(scope="module")
def reached(tmp_path_factory) -> tuple[DrawnRun, int, str]:
    """A target that half of the size reaches: GSD is twice that of the images there."""
    run = drawn(tmp_path_factory.mktemp("reached") / "survey", **FINER)
    return run, *run_with(run, target_std_m=0.6 * GSD)


@pytest.mark.slow
def test_a_target_that_small_images_reach_is_reached_by_them(reached):
    run, code, _ = reached
    assert code == 0
    assert rounds(run) == ["image scale 0.5, with the solver; the last"]
    assert scale_of(run) == 0.5
    mean, std = inner90(run.distances.signed)
    assert abs(mean) < 0.1 * GSD
    assert std < 0.6 * GSD


@pytest.mark.slow
def test_the_report_says_what_was_asked_and_reached(reached):
    run, _, log = reached
    report = run.report()
    assert report["plan"]["quality"] == "aimed"
    assert report["settings"]["target_std_m"] == 0.6 * GSD
    (gate,) = (each for each in report["verdict"]["gates"] if each["name"] == "ground within the std asked for")
    assert gate["passed"]
    assert gate["value"] >= gate["limit"] == 95.0
    assert "asked: a standard deviation of" in log
    assert "comes on top" in gate["sentence"]


def judged(run: DrawnRun) -> tuple[str, str]:
    """What the look at the last round and the gate at the end say of the ground."""
    look = [each["reason"] for each in decisions_of(run) if each["name"].startswith("round")][-1]
    (gate,) = (each for each in run.report()["verdict"]["gates"] if each["name"] == "ground within the std asked for")
    words = "of it has at most"
    return tuple(each[: each.index("mm", each.index(words))] for each in (look, gate["sentence"]))


@pytest.mark.slow
def test_the_look_between_rounds_and_the_gate_judge_the_same_points_of_a_scene_with_walls(reached):
    look, gate = judged(reached[0])
    assert look == gate


@pytest.mark.slow
def test_points_that_the_solver_leaves_to_the_sweep_count_in_the_look_as_in_the_gate(tmp_path, monkeypatch):
    def leaving_most(*args, **options):
        solved, figures = solve_maps(*args, **options)
        return [SolvedMap(each.pixels[::4], each.height[::4], each.std[::4]) for each in solved], figures

    run = drawn(tmp_path / "survey", **FINER)
    monkeypatch.setattr(stage_solver, "solve_maps", leaving_most)
    run_with(run, target_std_m=0.6 * GSD)
    assert len(rounds(run)) == 2
    look, gate = judged(run)
    assert look == gate


@pytest.mark.slow
def test_the_same_command_uses_all_again_and_a_finer_target_goes_on(reached, tmp_path):
    earlier, _, _ = reached
    run = DrawnRun(earlier.scene, tmp_path / "survey")
    shutil.copytree(earlier.folder, run.folder)
    log_before = len(run.run.log_path.read_text(encoding="utf-8"))
    code, log = run_with(run, target_std_m=0.6 * GSD)
    assert code == 0
    used = [stage for stage in ("sweep", "solver", "reached", "bed") if f"{stage}: used again" in log[log_before:]]
    assert used == ["sweep", "solver", "reached", "bed"]


@pytest.mark.slow
def test_a_target_beyond_the_photographs_ends_with_the_best_there_is_and_code_3(tmp_path):
    run = drawn(tmp_path / "survey", **FINER)
    code, log = run_with(run, target_std_m=0.02 * GSD)
    assert code == 3
    assert scale_of(run) == 1.0
    assert "promise" in log
    assert "quality gate:" in log
    assert "limited by" in log


class Hand:
    """A clock that advances by so many seconds each time that it is asked."""

    def __init__(self, step: float):
        self.seconds, self.step = 0.0, step

    def __call__(self) -> float:
        self.seconds += self.step
        return self.seconds


@pytest.fixture
def clock(monkeypatch):
    """Lets runs have a clock of a test's own, on a machine that is as fast as the rates say."""
    monkeypatch.setattr(machine, "measure_load", lambda: machine.Load(1.0, 1.0))

    def use(step: float) -> None:
        hand = Hand(step)
        monkeypatch.setattr(process_module, "Clock", lambda seconds, gone_s: Clock(seconds, gone_s, now=hand))

    return use


@pytest.mark.slow
def test_with_time_for_all_a_run_ends_where_nothing_is_left_to_win(tmp_path, clock):
    run = drawn(tmp_path / "survey", **FINER)
    clock(0.0)
    code, log = run_with(run, time_budget_s=1e6)
    assert code == 0
    assert rounds(run)[-1] == "image scale 1, with the solver; the last"
    assert "further rounds would not improve it" in log
    whole = len(read_cloud(run.run.cloud_path).points)
    log_before = len(log)
    _, log = run_with(run, time_budget_s=1e6)
    assert "Sweep: done" not in log[log_before:]
    assert len(read_cloud(run.run.cloud_path).points) == whole


@pytest.mark.slow
def test_when_the_time_is_over_a_run_still_writes_its_cloud(tmp_path, clock):
    run = drawn(tmp_path / "survey", **FINER)
    # Much of the time goes each time that the clock is asked.
    clock(300.0)
    run_with(run, time_budget_s=1000.0)
    assert scale_of(run) == 0.5
    assert rounds(run)[-1].endswith("the last")
    cloud = read_cloud(run.run.cloud_path)
    assert len(cloud.points) > 1000
    assert np.isfinite(cloud.points).all()


@pytest.mark.slow
def test_a_round_that_runs_out_of_time_leaves_what_was_there_before(tmp_path, clock):
    run = drawn(tmp_path / "survey", **FINER)
    # Enough at each decision, but gone before the views of the second round are through.
    clock(150.0)
    _, log = run_with(run, time_budget_s=3000.0)
    assert "the heights of the previous round are kept" in log
    assert scale_of(run) == 0.5


@pytest.mark.parametrize(
    ("std_m", "words"),
    [
        (1e-9, r"--target-std 1e-09 is in metres, and less than a hundredth of what a pixel covers here \("),
        (20.0, r"--target-std 20 is in metres, and more than 10 pixels of the smallest images cover here \("),
    ],
)
def test_a_target_that_cannot_be_meant_is_refused_before_anything_is_computed(tmp_path, std_m, words):
    run = drawn(tmp_path / "survey", **FEW)
    with pytest.raises(SurveyError, match=words):
        process(run.folder, target_std_m=std_m)
    assert not (run.folder / "bathynerf" / "cloud.las").exists()


def test_a_time_that_is_too_short_is_refused_with_the_shortest(tmp_path):
    run = drawn(tmp_path / "survey", **FEW)
    with pytest.raises(SurveyError, match=r"--time-budget 7 is too short: this survey takes at least about \d+ s"):
        process(run.folder, time_budget_s=7.0)
    with pytest.raises(SurveyError, match=r"--time-budget 1 is too short: any run takes 5\.5 s and more"):
        process(run.folder, time_budget_s=1.0)
    with pytest.raises(SurveyError, match="leave one out"):
        process(run.folder, time_budget_s=1000.0, quality="draft")
