"""The benchmark of drawn surveys: its table, its picture."""

from __future__ import annotations

import bench_drawn as bench

from survey.benchmark.cases import drawn_names
from survey.benchmark.records import METHODS, Cost, Errors, Record, read_results


def _record(method: str, quality: str, processor_s: float, error_m: float, case: str = "drawn_2_oblique_20") -> Record:
    shares = {"0.05": 0.9, "0.1": 0.95, "0.2": 0.99}
    errors = Errors(1000, 0.0, error_m, 2.0 * error_m, shares, 0.95, 0.001, 0.002)
    return Record(case, method, quality, "given", "cpu", 0, (Cost(1.5 * processor_s, processor_s, 10**9),), errors)


def test_the_surveys_of_all_parts_can_be_drawn():
    words = [word for part in bench.PARTS.values() for word in part.drawn]
    assert drawn_names(words) == words
    assert {word.split(",")[0] for word in words} == set(bench.MARKERS)
    assert set(bench.COLOURS) == set(METHODS)


def test_a_table_has_a_row_for_each_record_and_the_picture_is_drawn(tmp_path):
    records = (
        _record("full", "draft", 20.0, 0.005),
        _record("full", "standard", 40.0, 0.004),
        _record("straight", "draft", 30.0, 0.4),
        _record("full", "draft", 60.0, 0.01, "drawn_8_nadir_130"),
    )
    lines = bench.table(records)
    assert len(lines) == 2 + len(records)
    assert len({line.count("|") for line in lines}) == 1
    assert [line.endswith("| * |") for line in lines[2:]] == [True, True, False, True]
    # The stds of a cloud over straight rays are those of its apparent depths: they say nothing of its errors.
    assert "95 %" in lines[2]
    assert "95 %" not in lines[4]
    bench.draw(tmp_path / "front.png", records)
    assert (tmp_path / "front.png").read_bytes().startswith(b"\x89PNG")


def test_the_legend_has_what_was_measured_alone():
    labels = [label for label, *_ in bench.legend_of([_record("full", "draft", 20.0, 0.005)])]
    assert labels == ["whole chain", "2 m deep", "20 photographs", "hollow: draft", "filled: standard"]


def test_the_published_results_can_be_read():
    assert read_results(bench.PUBLISHED).records
