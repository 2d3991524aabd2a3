"""A drawn survey flown with a rolling shutter, from photographs to cloud and report, with the key and without it."""

from __future__ import annotations

import pytest
from drawn_runs import GSD, DrawnRun, drawn, inner90

from survey.progress import Progress
from survey.run.process import process

# 17 cm from the first row to the last, 7.5 px.
FLOWN = {"speed_m_s": 5.0, "readout_s": 0.035}
# As of a global shutter in test_end_to_end.py; XMP has speeds to 0.1 m/s, which is a millimetre at the first row.
BIAS_M, STD_M = GSD / 20.0, 0.25 * GSD


def processed(run: DrawnRun, *codes: int) -> DrawnRun:
    with Progress(verbosity=-1):
        assert process(run.folder, field="off", poses="fixed") in codes
    return run


@pytest.fixture(scope="module")
def known(tmp_path_factory):
    return processed(drawn(tmp_path_factory.mktemp("known") / "survey", **FLOWN), 0)


@pytest.fixture(scope="module")
def ignored(tmp_path_factory):
    run = drawn(tmp_path_factory.mktemp("ignored") / "survey", **FLOWN)
    toml = run.folder / "survey.toml"
    lines = toml.read_text(encoding="utf-8").splitlines()
    toml.write_text("\n".join(line for line in lines if not line.startswith("rolling_shutter_s")), encoding="utf-8")
    # Views that disagree by the shutter may have a standard deviation that fails the gate.
    return processed(run, 0, 3)


@pytest.mark.slow
def test_with_the_key_the_bed_is_found_as_with_a_global_shutter(known):
    mean, std = inner90(known.distances.signed)
    assert abs(mean) < BIAS_M
    assert std < STD_M
    assert known.completeness(2.0 * GSD) > 0.99
    report = known.report()
    assert report["survey"]["shutter"].startswith("rolls in 35 ms; velocities of 10 of 10 images (10 by XMP)")
    assert report["warnings"] == []
    assert "rolls in 35 ms" in known.run.report_html_path.read_text(encoding="utf-8")


@pytest.mark.slow
def test_without_the_key_the_bed_is_off_and_the_report_says_why(ignored):
    mean, std = inner90(ignored.distances.signed)
    assert abs(mean) > 4.0 * BIAS_M or std > 2.0 * STD_M
    warnings = " ".join(ignored.report()["warnings"])
    assert "by XMP the camera flew at up to 5.0 m/s" in warnings
    assert "give [cameras] rolling_shutter_s" in warnings
