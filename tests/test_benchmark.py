"""The benchmark: its records, what it calls better or worse, its baselines, and the command on a tiny survey."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from geo import read_cloud
from survey.benchmark.benchmark import Settings, benchmark
from survey.benchmark.cases import case_of, drawn_names, variant
from survey.benchmark.records import Cost, Errors, Record, Results, read_results, write_results
from survey.benchmark.text import (
    changes,
    comparison,
    draw_pareto_front,
    legend_of,
    lines_of,
    over_surveys,
    pareto_front,
    table,
    unpaired,
)
from survey.errors import SurveyError
from survey.simulate.drawn import DrawnScene, draw_survey


def errors(scale: float = 1.0, seed: int = 0, noise: float = 0.0) -> Errors:
    """Errors of a std of 10 mm times `scale`, in blocks whose roughness varies."""
    rng = np.random.default_rng(7)
    rough = 0.01 * scale * rng.uniform(0.7, 1.3, 100)
    rough *= 1.0 + noise * np.random.default_rng(seed).standard_normal(100)
    blocks = {f"{i},0": [1000.0, 0.0, 1000.0 * float(s) ** 2] for i, s in enumerate(rough)}
    std = float(np.sqrt(np.mean(rough**2)))
    return Errors(100_000, 0.0, std, 2.0 * std, {"0.05": 0.9, "0.1": 0.95, "0.2": 0.99}, 0.95, 0.0, 0.01, blocks)


def record(method: str = "full", times: tuple[float, ...] = (10.0,), found: Errors | None = None) -> Record:
    costs = tuple(Cost(t, 1.8 * t, 10**9) for t in times)
    return Record("survey", method, "standard", "given", "cpu", 0, costs, found or errors())


def results(*records: Record, processor: str = "one") -> Results:
    return Results({"processor": processor}, {"numpy": "2"}, "abc", records)


def verdicts(now: Results, then: Results) -> dict[str, str]:
    return {change.figure: change.verdict for change in changes(now, then)}


def test_results_are_read_as_they_were_written(tmp_path):
    found = results(record(), replace(record("mdw"), errors=None, words="refused"))
    write_results(tmp_path / "results.json", found)
    assert read_results(tmp_path / "results.json") == found


RECORDS = '{"version": 1, "machine": {}, "versions": {}, "commit": "", "records": [{}]}'


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("", "not a valid JSON"),
        (RECORDS[:40], "not a valid JSON"),
        ("[]", "no 'version', expected version"),
        ('{"version": 1, "records": [{}]}', "no 'machine'"),
        (RECORDS, "record 1 of"),
        ('{"version": 99}', "layout 99, expected 1"),
    ],
)
def test_a_file_that_is_no_result_is_refused_in_one_sentence(tmp_path, text, found):
    path = tmp_path / "other.json"
    path.write_text(text)
    with pytest.raises(SurveyError, match=r"other\.json") as error:
        read_results(path)
    assert found in str(error.value)
    assert "; " in str(error.value)


def test_a_cloud_of_three_quarters_of_the_error_is_better_and_the_same_one_is_as_before():
    assert verdicts(results(record(found=errors(0.75))), results(record()))["error"] == "better"
    assert verdicts(results(record(found=errors(1.3))), results(record()))["error"] == "worse"
    assert verdicts(results(record()), results(record()))["error"] == "as before"


def test_a_change_that_is_lost_among_the_blocks_is_no_change():
    noisy = record(found=errors(1.002, seed=3, noise=0.3))
    assert verdicts(results(noisy), results(record()))["error"] == "as before"


def test_times_are_judged_with_three_repeats_on_one_machine_only():
    slow, fast = record(times=(10.0, 10.2, 10.1)), record(times=(5.0, 5.1, 5.05))
    assert verdicts(results(fast), results(slow))["wall_s"] == "better"
    assert verdicts(results(slow), results(fast))["processor_s"] == "worse"
    assert verdicts(results(fast), results(slow, processor="other"))["wall_s"] == "not judged"
    assert verdicts(results(record()), results(slow))["wall_s"] == "not judged"


def test_memory_is_judged_as_times_are():
    light, heavy = record(times=(10.0, 10.2, 10.1)), record(times=(10.0, 10.2, 10.1))
    heavy = replace(heavy, costs=tuple(replace(cost, peak_bytes=2 * cost.peak_bytes) for cost in heavy.costs))
    assert verdicts(results(heavy), results(light))["memory"] == "worse"
    assert verdicts(results(light), results(heavy))["memory"] == "better"
    assert verdicts(results(light), results(light))["memory"] == "as before"
    assert verdicts(results(heavy), results(light, processor="other"))["memory"] == "not judged"


def test_completeness_and_coverage_are_judged_beyond_their_noise():
    then = errors()
    lost = replace(then, completeness=then.completeness | {"0.05": 0.89, "0.2": 0.9895}, coverage=0.97)
    found = verdicts(results(record(found=lost)), results(record(found=then)))
    assert found["complete at 0.05 m"] == "worse"
    assert found["complete at 0.2 m"] == "as before"
    assert found["std covers"] == "worse"
    back = verdicts(results(record(found=then)), results(record(found=lost)))
    assert (back["complete at 0.05 m"], back["std covers"]) == ("better", "better")
    # Whether too few or too many are covered.
    few = replace(then, coverage=0.93)
    assert verdicts(results(record(found=few)), results(record(found=lost)))["std covers"] == "as before"
    # Standard deviations over straight rays are of no height.
    straight = [results(record("straight", found=each)) for each in (lost, then)]
    assert "std covers" not in verdicts(*straight)
    (line,) = [
        line for line in lines_of(changes(*(results(record(found=e)) for e in (lost, then)))) if "0.05 m" in line
    ]
    assert line.endswith("complete at 0.05 m -1.00 points worse")


def lifted(found: Errors, by: float) -> Errors:
    """The same errors with every distance so much larger."""
    blocks = {name: [n, total + n * by, squares + 2.0 * by * total + n * by**2]
              for name, (n, total, squares) in found.blocks.items()}  # fmt: skip
    return replace(found, mean_m=found.mean_m + by, blocks=blocks)


def test_a_mean_that_leaves_zero_on_either_side_is_worse():
    for by in (0.002, -0.002):
        assert verdicts(results(record(found=lifted(errors(), by))), results(record()))["mean"] == "worse"
        assert verdicts(results(record()), results(record(found=lifted(errors(), by))))["mean"] == "better"
    assert verdicts(results(record(found=lifted(errors(), 1e-4))), results(record()))["mean"] == "as before"


def test_differences_over_several_surveys_are_taken_together():
    cases = ("a", "b", "c")
    then = results(*(replace(record(), case=case) for case in cases))
    losses = (0.010, 0.012, 0.009)
    now = results(
        *(
            replace(record(found=replace(errors(), completeness={"0.05": 0.9 - loss})), case=case)
            for case, loss in zip(cases, losses, strict=True)
        )
    )
    (change,) = [c for c in over_surveys(changes(now, then)) if c.figure == "complete at 0.05 m"]
    assert change.verdict == "worse"
    assert change.difference == pytest.approx(-np.mean(losses))


def test_a_lost_cloud_is_worse():
    lost = replace(record(), errors=None)
    assert verdicts(results(lost), results(record())) == {"has a cloud": "worse"}
    assert lines_of(changes(results(lost), results(record()))) == ["survey full standard given cpu: has a cloud worse"]


def test_over_several_surveys_ratios_are_taken_together_and_times_of_one_repeat_are_judged():
    then = results(*(replace(record(times=(t,)), case=f"s{t:g}") for t in (5.0, 10.0, 40.0, 80.0)))
    now = replace(then, records=tuple(_faster(r, by) for r, by in zip(then.records, (2.0, 2.2, 1.9, 2.1), strict=True)))
    found = {change.figure: change for change in over_surveys(changes(now, then))}
    assert found["wall_s"].verdict == "better"
    assert found["wall_s"].ratio == pytest.approx((2.0 * 2.2 * 1.9 * 2.1) ** -0.25)
    assert found["wall_s"].key == ("4 surveys", "full", "standard", "given", "cpu")
    assert found["error"].verdict == "as before"
    mixed = replace(
        then, records=tuple(_faster(r, by) for r, by in zip(then.records, (2.0, 0.5, 1.9, 0.6), strict=True))
    )
    assert {c.verdict for c in over_surveys(changes(mixed, then)) if c.figure == "wall_s"} == {"as before"}
    elsewhere = replace(now, machine={"processor": "other"})
    assert [change.figure for change in over_surveys(changes(elsewhere, then))] == _OF_CLOUDS
    assert over_surveys(changes(replace(now, records=now.records[:2]), then)) == []


_OF_CLOUDS = ["error", "mean", "complete at 0.05 m", "complete at 0.1 m", "complete at 0.2 m", "std covers"]


def _faster(slow: Record, by: float) -> Record:
    return replace(
        slow, costs=tuple(replace(c, wall_s=c.wall_s / by, processor_s=c.processor_s / by) for c in slow.costs)
    )


def test_records_that_only_one_result_has_are_named():
    now, then = results(record(), record("sweep")), results(record(), record("mdw"))
    ours, theirs = unpaired(now, then)
    assert [key[1] for key in ours + theirs] == ["sweep", "mdw"]
    lines = comparison(now, then)
    assert lines[-2:] == [
        "only in this result: 1 records, survey sweep standard given cpu",
        "only in the earlier result: 1 records, survey mdw standard given cpu",
    ]


def test_the_front_holds_what_nothing_beats_in_both_time_and_error(tmp_path):
    fast, good = record("sweep", (5.0,), errors(2.0)), record("full", (10.0,), errors(1.0))
    beaten = record("mdw", (20.0,), errors(1.5))
    found = (fast, good, beaten)
    assert pareto_front(found) == {fast.key, good.key}
    draw_pareto_front(tmp_path / "front.png", found)
    assert (tmp_path / "front.png").read_bytes().startswith(b"\x89PNG")
    lines = table(results(*found))
    assert [line.endswith("*") for line in lines[1:]] == [True, True, False]


def test_coverage_is_printed_only_where_a_std_is_that_of_the_height():
    ours, straight = (line for line in table(results(record("full"), record("straight")))[1:])
    assert "95.0 %" in ours
    assert "95.0 %" not in straight


def test_rows_name_their_device_and_completeness_at_every_tolerance():
    measured = errors(1.0)
    measured.completeness.update({"0.05": 0.5, "0.1": 0.75, "0.2": 1.0})
    found = replace(record("full"), errors=measured)
    head, *rows = table(results(found, replace(found, device="cuda")))
    assert "complete 0.2, 0.1, 0.05 m" in head
    assert all("100.0, 75.0, 50.0 %" in row for row in rows)
    assert [device for row in rows for device in ("cpu", "cuda") if f" {device} " in row] == ["cpu", "cuda"]


def test_the_legend_says_what_filled_and_hollow_marks_mean():
    entries = legend_of(["full"], ["quick"])
    assert [label for label, *_ in entries[:2]] == ["whole chain", "quick"]
    assert {label.partition(":")[0]: is_filled for label, *_, is_filled in entries[2:]} == {
        "filled": True,
        "hollow": False,
    }


def test_names_of_drawn_surveys_are_checked_before_anything_is_drawn():
    assert drawn_names(["2,oblique,20"]) == ["2,oblique,20"]
    assert len(drawn_names(["all"])) == 24
    for word in ("2,oblique", "deep,nadir,20", "2,sideways,20", "0.5,nadir,-4", "0,nadir,20"):
        with pytest.raises(SurveyError):
            drawn_names([word])


def test_settings_name_what_is_not_known():
    with pytest.raises(SurveyError, match="--method is magic"):
        Settings(methods=("magic",))
    with pytest.raises(SurveyError, match="--poses is guessed"):
        Settings(poses=("guessed",))
    with pytest.raises(SurveyError, match="--repeats is 0"):
        Settings(repeats=0)


@pytest.fixture(scope="module")
def survey(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("benchmark") / "small"
    draw_survey(folder, DrawnScene.tiny())
    return folder


def test_a_variant_links_what_the_survey_has_and_leaves_out_what_is_not_wanted(survey, tmp_path):
    case = case_of(survey)
    dry = variant(case, tmp_path / "dry", poses="given", is_refracted=False)
    assert "[water]" not in (dry / "survey.toml").read_text()
    assert (dry / "cameras.csv").read_text() == (survey / "cameras.csv").read_text()
    unposed = variant(case, tmp_path / "unposed", poses="images", is_refracted=True)
    assert not (unposed / "cameras.csv").exists()
    assert "poses" not in (unposed / "survey.toml").read_text()
    assert "[water]" in (unposed / "survey.toml").read_text()


def test_poses_beside_the_photographs_are_left_out_alone(survey, tmp_path):
    folder = tmp_path / "beside"
    shutil.copytree(survey, folder)
    (folder / "cameras.csv").rename(folder / "images" / "poses.csv")
    toml = (folder / "survey.toml").read_text()
    (folder / "survey.toml").write_text(toml.replace('"cameras.csv"', '"images/poses.csv"'))
    unposed = variant(case_of(folder), tmp_path / "unposed", poses="images", is_refracted=True)
    names = {path.name for path in (folder / "images").iterdir()}
    assert {path.name for path in (unposed / "images").iterdir()} == names - {"poses.csv"}


def test_a_survey_without_truth_is_refused(survey, tmp_path):
    folder = tmp_path / "bare"
    folder.mkdir()
    (folder / "survey.toml").write_text((survey / "survey.toml").read_text())
    with pytest.raises(SurveyError, match=r"has no reference\.ply"):
        case_of(folder)
    with pytest.raises(SurveyError, match="no survey is named"):
        benchmark([], tmp_path / "out")


@pytest.mark.slow
def test_corrected_depths_are_better_than_straight_rays_and_cost_no_second_run(survey, tmp_path):
    before = (survey / "survey.toml").read_text()
    settings = Settings(methods=("straight", "times_index", "per_camera"), qualities=("draft",))
    found = benchmark([survey], tmp_path, settings=settings)
    error = {r.method: r.errors.error_m for r in found.records if r.errors is not None}
    # Depth 1.2 m: straight rays lose a quarter of it; corrections leave what angles and the mean over views do.
    assert error["straight"] > 0.15
    assert max(error["times_index"], error["per_camera"]) < 0.25 * error["straight"]
    assert len({record.costs for record in found.records}) == 1
    assert json.loads((tmp_path / "results.json").read_text())["version"] == 1
    again = benchmark([survey], tmp_path, settings=settings, known=found.records)
    assert again.records == found.records
    corrected = read_cloud(tmp_path / "runs" / "small_straight_draft_given_cpu" / "times_index.las")
    assert len(corrected.points) > 1000
    assert (survey / "survey.toml").read_text() == before
