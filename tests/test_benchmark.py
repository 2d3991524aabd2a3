"""The benchmark: its records, what it calls better or worse, its baselines, and the command on a tiny survey."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bench_methods import Settings, benchmark
from method_cases import case_of, drawn_names, variant
from method_records import Cost, Errors, Record, Results, read_results, write_results
from method_text import changes, comparison, draw_pareto_front, legend_of, over_surveys, pareto_front, table

from geo import read_cloud
from survey.errors import SurveyError
from survey.simulate.drawn import DrawnScene, draw_survey


def errors(scale: float = 1.0) -> Errors:
    """Errors of a std of 10 mm times `scale`."""
    std = 0.01 * scale
    return Errors(100_000, 0.0, std, 2.0 * std, {"0.05": 0.9, "0.1": 0.95, "0.2": 0.99}, 0.95, 0.0, 0.01)


def record(method: str = "full", times: tuple[float, ...] = (10.0,), found: Errors | None = None) -> Record:
    costs = tuple(Cost(t, 1.8 * t, 10**9) for t in times)
    return Record("survey", method, "standard", "given", "cpu", 0, costs, found or errors())


def results(*records: Record, processor: str = "one") -> Results:
    return Results({"processor": processor}, {"numpy": "2"}, "abc", records)


def test_results_are_read_as_they_were_written(tmp_path):
    found = results(record(), replace(record("straight"), errors=None, words="refused"))
    write_results(tmp_path / "results.json", found)
    assert read_results(tmp_path / "results.json") == found


RECORDS = '{"version": 2, "machine": {}, "versions": {}, "commit": "", "records": [{}]}'


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("", "not valid JSON"),
        (RECORDS[:40], "not valid JSON"),
        ("[]", "no 'version', expected version"),
        ('{"version": 2, "records": [{}]}', "no 'machine'"),
        (RECORDS, "record 1 of"),
        ('{"version": 99}', "layout 99, expected 2"),
    ],
)
def test_a_file_that_is_no_result_is_refused_in_one_sentence(tmp_path, text, found):
    path = tmp_path / "other.json"
    path.write_text(text)
    with pytest.raises(SurveyError, match=r"other\.json") as error:
        read_results(path)
    assert found in str(error.value)
    assert "; " in str(error.value)


def over(cases: int, found: list[Errors]) -> Results:
    """Results of a method on surveys whose clouds have such errors."""
    return results(*(replace(record(found=each), case=f"s{n}") for n, each in zip(range(cases), found, strict=True)))


def verdicts(now: list[Errors], then: list[Errors]) -> dict[str, str]:
    found = changes(over(len(now), now), over(len(then), then))
    return {change.figure: change.verdict for change in over_surveys(found)}


def test_errors_over_several_surveys_are_judged_by_their_scatter():
    then = [errors(scale) for scale in (1.0, 2.0, 0.5, 1.5)]
    less, more = ([errors(by * each.std_m / 0.01) for each in then] for by in (0.75, 1.3))
    mixed = [errors(by * each.std_m / 0.01) for each, by in zip(then, (0.75, 1.3, 0.8, 1.2), strict=True)]
    judged = [verdicts(now, then)["error"] for now in (less, more, mixed, then)]
    assert judged == ["better", "worse", "as before", "as before"]
    assert verdicts(less[:2], then[:2]) == {}


def test_completeness_and_coverage_and_the_mean_are_judged_by_differences():
    then = [errors()] * 3
    losses = (0.010, 0.012, 0.009)
    lost = [replace(errors(), completeness={"0.05": 0.9 - loss, "0.2": 0.99}, coverage=0.97) for loss in losses]
    now = verdicts(lost, then)
    assert (now["complete at 0.05 m"], now["std covers"]) == ("worse", "worse")
    assert now["complete at 0.2 m"] == "as before"
    back = verdicts(then, lost)
    assert (back["complete at 0.05 m"], back["std covers"]) == ("better", "better")
    # Whether too few or too many are covered.
    few, many = ([replace(errors(), coverage=c) for c in each] for each in ((0.93, 0.935, 0.925), (0.965, 0.97, 0.975)))
    assert verdicts(few, many)["std covers"] == "as before"
    for by in (0.002, -0.002):
        assert verdicts([replace(errors(), mean_m=by)] * 3, then)["mean"] == "worse"
    (change,) = [c for c in over_surveys(changes(over(3, lost), over(3, then))) if c.figure == "complete at 0.05 m"]
    assert change.step == pytest.approx(-np.mean(losses))
    # Standard deviations over straight rays are of no height.
    straight = [results(record("straight", found=each)) for each in (lost[0], then[0])]
    assert "std covers" not in [change.figure for change in changes(*straight)]


def test_times_and_memory_are_compared_on_one_machine_only():
    then = results(*(replace(record(times=(t,)), case=f"s{t:g}") for t in (5.0, 10.0, 40.0, 80.0)))
    by = (2.0, 2.2, 1.9, 2.1)
    now = replace(then, records=tuple(_faster(r, b) for r, b in zip(then.records, by, strict=True)))
    found = {change.figure: change for change in over_surveys(changes(now, then))}
    assert found["wall_s"].verdict == "better"
    assert np.exp(found["wall_s"].step) == pytest.approx(np.prod(by) ** -0.25)
    assert found["wall_s"].key == ("4 surveys", "full", "standard", "given", "cpu")
    assert (found["memory"].verdict, found["error"].verdict) == ("as before", "as before")
    elsewhere = replace(now, machine={"processor": "other"})
    assert not {"wall_s", "processor_s", "memory"} & {change.figure for change in changes(elsewhere, then)}


def _faster(slow: Record, by: float) -> Record:
    return replace(
        slow, costs=tuple(replace(c, wall_s=c.wall_s / by, processor_s=c.processor_s / by) for c in slow.costs)
    )


def test_changes_of_one_survey_are_shown_and_clouds_that_one_result_lacks_are_named():
    lost = replace(record("straight"), errors=None)
    now = results(record(found=replace(errors(0.75), completeness={"0.05": 0.89})), record("sweep"), lost)
    lines = comparison(now, results(record(), record("straight")))
    assert "survey full standard given cpu: error 0.750" in lines
    assert "survey full standard given cpu: complete at 0.05 m -1.00 points" in lines
    assert lines[-2:] == [
        "only in this result: 1 clouds, survey sweep standard given cpu",
        "only in the earlier result: 1 clouds, survey straight standard given cpu",
    ]


def test_the_front_holds_what_nothing_beats_in_both_time_and_error(tmp_path):
    fast, good = record("sweep", (5.0,), errors(2.0)), record("full", (10.0,), errors(1.0))
    beaten = record("straight", (20.0,), errors(1.5))
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
    assert json.loads((tmp_path / "results.json").read_text())["version"] == 2
    again = benchmark([survey], tmp_path, settings=settings, known=found.records)
    assert again.records == found.records
    corrected = read_cloud(tmp_path / "runs" / "small_straight_draft_given_cpu" / "times_index.las")
    assert len(corrected.points) > 1000
    assert (survey / "survey.toml").read_text() == before
