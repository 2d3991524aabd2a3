"""Drawn surveys by a rolling shutter and over rising water, from photographs to cloud, told of it and not told."""

import pytest
from drawn_runs import GSD, DrawnRun, drawn, inner90

from survey.progress import Progress
from survey.run.process import process

pytestmark = pytest.mark.slow

# What is drawn, and the words of survey.toml that tell of it, with those in their place that do not. The first row of a
# photograph is taken 17 cm before the last, 7.5 px; water rises by 30 cm.
CONDITIONS = {
    "rolling shutter": ({"speed_m_s": 5.0, "readout_s": 0.035}, "rolling_shutter_s", "# rolling_shutter_s"),
    "rising water": ({"rise_m": 0.3}, 'gauge = "gauge.csv"', "level_m = 584.2"),
}
# As of a global shutter over still water in test_end_to_end.py; speeds in XMP to 0.1 m/s are 1 mm at the first row.
BIAS_M, STD_M = GSD / 20.0, 0.25 * GSD


def processed(run: DrawnRun, *codes: int) -> DrawnRun:
    with Progress(verbosity=-1):
        assert process(run.folder, field="off", poses="fixed") in codes
    return run


@pytest.fixture(scope="module", params=CONDITIONS)
def runs(request, tmp_path_factory) -> tuple[DrawnRun, DrawnRun]:
    """A run that was told of a condition, and one that was not."""
    changes, telling, silent = CONDITIONS[request.param]
    told, untold = (drawn(tmp_path_factory.mktemp(name) / "survey", **changes) for name in ("told", "untold"))
    toml = untold.folder / "survey.toml"
    text = toml.read_text(encoding="utf-8")
    assert telling in text
    toml.write_text(text.replace(telling, silent), encoding="utf-8")
    # Views that disagree by the shutter may have a standard deviation that fails the gate.
    return processed(told, 0), processed(untold, 0, 3)


def test_the_bed_is_found_as_without_the_condition_and_is_off_where_it_is_not_told(runs):
    told, untold = runs
    mean, std = inner90(told.distances.signed)
    assert abs(mean) < BIAS_M
    assert std < STD_M
    assert told.completeness(2.0 * GSD) > 0.99
    mean_untold, std_untold = inner90(untold.distances.signed)
    assert abs(mean_untold) > 4.0 * BIAS_M or std_untold > 1.5 * std


@pytest.mark.parametrize("runs", ["rolling shutter"], indirect=True)
def test_the_report_says_how_the_shutter_is_known_or_why_the_bed_is_off(runs):
    told, untold = runs
    report = told.report()
    assert report["survey"]["shutter"].startswith("rolls in 35 ms; velocities of 10 of 10 images (10 by XMP)")
    assert report["warnings"] == []
    assert "rolls in 35 ms" in told.run.report_html_path.read_text(encoding="utf-8")
    warnings = " ".join(untold.report()["warnings"])
    assert "by XMP the camera flew at up to 5.0 m/s" in warnings
    assert "give [cameras] rolling_shutter_s" in warnings
