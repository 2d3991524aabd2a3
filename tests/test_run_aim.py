"""A target standard deviation or a time in place of a quality: the choice before the run, and the gates after it."""

import json
from dataclasses import replace

import numpy as np
import pytest
from drawn_runs import GSD, SMALL, drawn, inner90
from small_survey import small_survey

from fields.sweep.bed import BedPoints
from survey.errors import SurveyError
from survey.folder.survey import load_survey
from survey.plan.choices import Choices
from survey.progress import Progress
from survey.run import aim
from survey.run.aim import Candidate, plan_for_aim
from survey.run.gate import CellStd, gates_of_aim, std_cells
from survey.run.process import process

# Twice the pixels along each side of `drawn_runs.SMALL`, so that two scales can be matched.
FINER = {"image_px": (800, 600), "focal_px": 1200.0, "noise": 1.0, "num_views": 4, "size_m": (1.2, 1.0)}
FEW = SMALL | {"num_views": 4, "size_m": (1.2, 1.0), "cell_m": 0.1, "texel_m": 0.05, "objects": False}


def candidates(seconds: tuple[float | None, ...] = (10.0, 20.0, 30.0, 60.0)) -> tuple[Candidate, ...]:
    nan = float("nan")
    kinds = [("draft", 0.5, nan), ("standard", 0.5, 0.02), ("draft", 1.0, nan), ("standard", 1.0, 0.01)]
    return tuple(Candidate(*kind, time) for kind, time in zip(kinds, seconds, strict=True))


@pytest.mark.parametrize(
    ("std_m", "chosen", "words"),
    [
        (0.03, "standard at image scale 0.5", "the least work that is foreseen to reach"),
        (0.015, "standard at image scale 1", "the least work that is foreseen to reach"),
        (0.001, "standard at image scale 1", "nothing is foreseen to reach"),
        (None, "standard at image scale 1", "whole photographs"),
    ],
)
def test_a_target_takes_the_least_work_that_is_foreseen_to_reach_it(std_m, chosen, words):
    best, reason = aim._wanted(std_m, candidates())
    assert str(best) == chosen
    assert reason.startswith(words)


@pytest.mark.parametrize(
    ("left_s", "chosen"),
    [
        (1000.0, "standard at image scale 1"),
        # With a reserve of a fifth: 60 s do not fit into 71, and a solver at half the size comes before none at whole.
        (71.0, "standard at image scale 0.5"),
        (23.0, "draft at image scale 0.5"),
    ],
)
def test_a_time_takes_the_best_that_is_foreseen_to_fit(left_s, chosen):
    assert str(aim._in_time(left_s, candidates(), "", refuses=True)[0]) == chosen


def test_a_time_in_which_nothing_fits_is_refused_or_takes_the_shortest_run():
    with pytest.raises(SurveyError, match=r"--time-budget is too short: this survey takes at least about 12 s"):
        aim._in_time(11.0, candidates(), "", refuses=True)
    best, reason = aim._in_time(11.0, candidates(), "", refuses=False)
    assert str(best) == "draft at image scale 0.5"
    assert reason.endswith("the shortest run follows")


def test_a_time_is_refused_on_devices_that_were_not_measured():
    with pytest.raises(SurveyError, match="there are rates for --device cpu with LLVM alone"):
        aim._in_time(1000.0, candidates((None,) * 4), "", refuses=True)


def test_what_is_foreseen_halves_with_twice_the_scale_and_warns_of_what_no_work_reduces(tmp_path):
    survey = load_survey(small_survey(tmp_path / "s"))
    large = replace(survey, views=tuple(replace(v, lens=replace(v.lens, width=1600)) for v in survey.views))
    found = plan_for_aim(large, Choices(device="cpu", target_std_m=5e-3))
    std = {each.image_scale: each.std_m for each in found.candidates if each.quality == "standard"}
    assert sorted(std) == [0.25, 0.5, 1.0]
    assert std[0.25] == pytest.approx(2.0 * std[0.5]) == pytest.approx(4.0 * std[1.0])
    assert (found.chosen.quality, found.chosen.image_scale) == ("standard", 1.0)
    assert any("fly lower or with more overlap" in text for text in found.warnings)
    assert len(found.rows) == len(found.candidates) + 2 + len(found.warnings)


@pytest.mark.parametrize("std_m", [1e-9, 20.0])
def test_a_target_that_cannot_be_meant_is_refused_before_anything_is_computed(tmp_path, std_m):
    run = drawn(tmp_path / "survey", **FEW)
    with pytest.raises(SurveyError, match=rf"--target-std {std_m:g} is in metres, expected "):
        process(run.folder, target_std_m=std_m)
    assert not (run.folder / "bathynerf" / "cloud.las").exists()


@pytest.mark.slow
def test_a_run_does_what_was_chosen_and_its_gate_says_whether_the_target_was_reached(tmp_path):
    run = drawn(tmp_path / "survey", **FINER)
    for std_m, scale, is_reached in ((3.0 * GSD, 0.5, True), (0.005 * GSD, 1.0, False)):
        with Progress(verbosity=-1):
            code = process(run.folder, target_std_m=std_m)
        plan = json.loads(run.run.plan_path.read_text(encoding="utf-8"))
        assert (plan["quality"], plan["image_scale"]) == ("standard", scale)
        assert [each["choice"] for each in plan["decisions"] if each["name"] == "aim"] == [
            f"standard at image scale {scale:g}"
        ]
        report = run.report()
        assert report["settings"]["target_std_m"] == std_m
        (gate,) = (each for each in report["verdict"]["gates"] if each["name"] == "ground within the std asked for")
        assert gate["passed"] == is_reached
        assert is_reached or code == 3
        assert "comes on top" in gate["sentence"]
    assert "the rest is limited by" in gate["sentence"]
    assert inner90(run.distances.signed)[1] < 0.6 * GSD


def bed(xyz: np.ndarray, std: np.ndarray, num_views: list[int], depth: list[float]) -> BedPoints:
    count = len(xyz)
    rgb, wet = np.zeros((count, 3), dtype=np.uint8), np.ones(count, dtype=bool)
    return BedPoints(xyz, rgb, std, np.array(num_views), np.array(depth), np.zeros(count), wet)


def test_cells_have_the_median_of_their_points():
    xyz = np.array([[0.5, 0.5, 0.0], [0.6, 0.5, 0.0], [0.7, 0.5, 0.0], [1.5, 0.5, 0.0], [1.6, 0.5, 0.0]])
    std = np.array([0.01, 0.05, 0.02, 0.04, np.nan])
    found = std_cells(bed(xyz, std, [3, 9, 5, 7, 7], [1.0, 2.0, 3.0, 4.0, 4.0]), 0.1)
    np.testing.assert_allclose(found.std, [0.02, 0.04])
    np.testing.assert_allclose(found.num_views, [5.0, 7.0])
    assert found.reached(0.03) == 0.5
    assert std_cells(bed(np.empty((0, 3)), np.empty(0), [], []), 0.1).reached(0.01) == 1.0


@pytest.mark.parametrize(
    ("std", "num_views", "depth", "limit"),
    [
        ([0.01, 0.03, 0.03], 3.0, [2.0, 2.0, 2.0], "few photographs"),
        ([0.01, 0.01, 0.03, 0.03], 8.0, [1.0, 1.1, 4.0, 5.0], "depth"),
        ([0.01, 0.01, 0.03], 8.0, [2.0, 2.2, 2.1], "noise, texture and relief below the pixel"),
        ([0.03], 8.0, [float("nan")], "noise, texture and relief below the pixel"),
    ],
)
def test_what_limits_the_rest_is_said(std, num_views, depth, limit):
    assert CellStd(np.array(std), np.full(len(std), num_views), np.array(depth)).limit(0.02) == limit


@pytest.mark.parametrize(("seconds", "passed"), [(99.0, True), (101.0, False)])
def test_a_time_that_was_exceeded_is_a_gate(seconds, passed):
    (gate,) = gates_of_aim(Choices(time_budget_s=100.0), None, seconds)
    assert (gate.passed, gate.limit) == (passed, 100.0)
