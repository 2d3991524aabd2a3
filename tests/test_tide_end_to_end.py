"""A drawn survey over water that rises, from photographs to cloud, by its gauge and with one level for all."""

from __future__ import annotations

import pytest
from drawn_runs import GSD, DrawnRun, drawn, inner90

from survey.progress import Progress
from survey.run.process import process

RISE_M = 0.3
# As of still water in test_end_to_end.py.
BIAS_M, STD_M = GSD / 20.0, 0.25 * GSD


def processed(run: DrawnRun) -> DrawnRun:
    with Progress(verbosity=-1):
        assert process(run.folder, field="off", poses="fixed") == 0
    return run


@pytest.fixture(scope="module")
def known(tmp_path_factory):
    return processed(drawn(tmp_path_factory.mktemp("known") / "survey", rise_m=RISE_M))


@pytest.fixture(scope="module")
def ignored(tmp_path_factory):
    run = drawn(tmp_path_factory.mktemp("ignored") / "survey", rise_m=RISE_M)
    toml = run.folder / "survey.toml"
    text = toml.read_text(encoding="utf-8")
    toml.write_text(text.replace('gauge = "gauge.csv"', "level_m = 584.2"), encoding="utf-8")
    return processed(run)


@pytest.mark.slow
def test_by_its_gauge_the_bed_is_found_as_under_still_water(known):
    mean, std = inner90(known.distances.signed)
    assert abs(mean) < BIAS_M
    assert std < STD_M
    assert known.completeness(2.0 * GSD) > 0.99


@pytest.mark.slow
def test_with_one_level_the_bed_is_off(known, ignored):
    mean, std = inner90(ignored.distances.signed)
    assert abs(mean) > 4.0 * BIAS_M or std > 1.5 * inner90(known.distances.signed)[1]
