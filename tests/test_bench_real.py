"""Sentences and tables of docs/real.md from results."""

from __future__ import annotations

from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture
def tables(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    import real_tables

    return real_tables


def test_a_shutter_is_said_with_what_it_does_to_heights(tables):
    rolling = {"check_up_m": [0.03, -0.03], "readout_s": 0.0021, "std_s": 0.0012}
    said = " ".join(tables.shutter_rows({"global": {"check_up_m": [0.04, 0.04]}, "rolling": rolling}))
    assert "answers 2.1 ms ± 1.2 ms" in said
    assert "an rms of 40 mm with a global shutter and 30 mm with that" in said


def test_a_target_with_wrong_coordinates_does_not_count(tables):
    sound = {"off_m": [0.01, 0.0, -0.02], "std_m": [0.02, 0.02, 0.02], "marks": 3}
    wrong = {"off_m": [0.8, -2.0, -5.0], "std_m": [0.02, 0.02, 0.2], "marks": 2}
    lines = tables.target_rows({"targets": {"a": sound, "b": wrong}, "warnings": []})
    assert "| wrong coordinates |" in lines[3]
    assert "Heights of 1 of 1 sound targets" in " ".join(lines)
