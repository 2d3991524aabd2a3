"""The command line: what the verbs print, how quiet they are, and the options that they hand on."""

import re
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from command_line import Terminal, bathynerf, fake_module, raising, without_times
from small_survey import small_survey

from survey import progress as progress_room
from survey.commands.console import ConsoleResults
from survey.compare.options import CompareOptions
from survey.display.blocks import Rows, Section, Table
from survey.errors import SurveyError
from survey.export.registry import PRODUCTS, ExportOptions


def test_check_of_a_good_survey_prints_findings_and_plan_and_ends_with_code_0(tmp_path):
    folder = small_survey(tmp_path / "s")
    result = bathynerf("check", folder)
    assert result.exit_code == 0
    # At once: libraries alone take seconds to load.
    assert re.fullmatch(rf"[-0-9]+ [:0-9]+ reading {re.escape(str(folder))}\n", result.stderr)
    for words in ("Found\n", "Plan\n", "  water", "  refraction", "on: water of index 1.3330 at 2105 m"):
        assert words in result.stdout


@pytest.fixture(autouse=True)
def has_settings(monkeypatch):
    """Commands here are given no folder, and write none."""
    fake_module(monkeypatch, "survey.init.draft", require_settings=lambda *_: None, draft=None)


def test_one_q_leaves_out_the_progress_and_two_the_results_too(monkeypatch):
    def process(*_args, **_options):
        progress_room.current().note("a note")
        progress_room.current().warn("a doubt")
        return 3

    fake_module(monkeypatch, "survey.run.process", process=process)
    paths = "s/bathynerf/cloud.las\ns/bathynerf/report.html\n"
    for options, stdout, stderr in (
        ((), paths, "a note\nwarning: a doubt\n"),
        (("-q",), paths, "warning: a doubt\n"),
        (("-qq",), "", ""),
    ):
        result = bathynerf("process", "s", *options)
        assert (result.exit_code, result.stdout, without_times(result.stderr)) == (3, stdout, stderr)
        before = bathynerf(*options, "process", "s")
        assert (before.stdout, without_times(before.stderr)) == (stdout, stderr)


@pytest.mark.parametrize("quiet", [(), ("-q",), ("-qq",)])
def test_an_error_is_said_however_quiet_the_command_is(monkeypatch, quiet):
    fake_module(monkeypatch, "survey.run.process", process=raising(SurveyError("wrong")))
    assert bathynerf("process", "s", *quiet).stderr == "error: wrong\n"


def test_results_on_a_terminal_are_wrapped_between_words_and_nothing_in_them_is_obeyed(monkeypatch):
    stream = Terminal()
    monkeypatch.setattr(sys, "stdout", stream)
    monkeypatch.setenv("COLUMNS", "40")
    words = [f"word{number}" for number in range(20)]
    ConsoleResults(is_silent=False).columns(None, [("  water", " ".join([*words, "\x1b[2J"]))])
    lines = re.sub(r"\x1b\[0?m|\x1b\[22m", "", stream.getvalue()).splitlines()
    assert [word for line in lines for word in line.split()] == ["water", *words, "\\x1b[2J"]
    assert len(lines) > 3
    assert all(len(line) <= 40 for line in lines)


def test_a_quiet_check_and_comparison_still_print_what_they_found(monkeypatch, tmp_path):
    folder = small_survey(tmp_path / "s")
    assert bathynerf("check", folder, "-q").stdout == bathynerf("check", folder).stdout
    assert bathynerf("check", folder, "-qq").stdout == ""
    options = SimpleNamespace(CompareOptions=SimpleNamespace, compare_files=lambda *_, **__: "figures")
    fake_module(monkeypatch, "survey.compare.comparison", **vars(options))
    fake_module(monkeypatch, "survey.compare.tables", sections_of=lambda _: [Section("", [Rows([("points", "12")])])])
    assert bathynerf("compare", "c.las", "r.ply", "-q").stdout == "points  12\n"
    assert bathynerf("compare", "c.las", "r.ply", "-qq").stdout == ""


def test_process_hands_its_options_on_and_returns_the_code_of_the_pipeline(monkeypatch, tmp_path):
    calls = []

    def process(*args, **options):
        calls.append((args, options, progress_room.current().verbosity))
        return 3

    fake_module(monkeypatch, "survey.run.process", process=process)
    result = bathynerf(
        "process", "s", "-o", "run", "--quality", "draft", "--device", "cpu", "--no-resume", "--field", "mdw",
        "--calibrate-water", "--true-colour", "--reference", "r.ply", "--visible", "v.ply", "-v",
        "--target-std", "0.02", "--time-budget", "300",
    )  # fmt: skip
    assert result.exit_code == 3
    expected = {
        "quality": "draft",
        "target_std_m": 0.02,
        "time_budget_s": 300.0,
        "device": "cpu",
        "field": "mdw",
        "poses": None,
        "image_scale": None,
        "tiles": None,
        "memory": None,
        "workers": None,
        "chooses_workers": True,
        "scheduler": None,
        "resume": False,
        "calibrate_water": True,
        "true_colour": True,
        "reference": Path("r.ply"),
        "visible": Path("v.ply"),
    }
    assert calls == [((Path("s"), Path("run")), expected, 1)]
    bathynerf("process", "s")
    defaults = dict.fromkeys(expected) | {"chooses_workers": True, "resume": True}
    assert calls[1] == ((Path("s"), None), defaults, 0)


def test_export_needs_something_to_write_and_prints_what_it_wrote(monkeypatch):
    result = bathynerf("export", "run")
    assert result.exit_code == 2
    assert "give at least one of --las F" in result.stderr
    calls = []

    def export(run, **files):
        calls.append((run, files))
        return [Path("a.las"), Path("b.ply")]

    fake_module(monkeypatch, "survey.export.export", export=export)
    result = bathynerf("export", "run", "--las", "a.las", "--ply", "b.ply", "--crs", "EPSG:32632", "--fill", "0.5")
    assert (result.exit_code, result.stdout) == (0, "a.las\nb.ply\n")
    ((run, files),) = calls
    assert (run, files.pop("options")) == (Path("run"), ExportOptions(crs="EPSG:32632", fill_m=0.5))
    assert files.keys() == {product.option for product in PRODUCTS}
    assert {name: path for name, path in files.items() if path} == {"las": Path("a.las"), "ply": Path("b.ply")}


def test_compare_hands_its_options_on_and_prints_the_lines_in_columns(monkeypatch):
    calls = []

    def compare_files(cloud, reference, *, options):
        calls.append((cloud, reference, options))
        return "figures"

    sections = {
        "figures": [
            Section("", [Rows([("points", "12"), ("sign", "up")])]),
            Section("Distances", [Table(("depth", "mean, inner"), [("0 to 1 m", "0.1")], heading="By depth")]),
        ]
    }
    fake_module(monkeypatch, "survey.compare.comparison", compare_files=compare_files)
    fake_module(monkeypatch, "survey.compare.tables", sections_of=sections.get)
    result = bathynerf("compare", "c.las", "r.ply", "--tolerance", "0.05", "--bounds", "-1", "2", "3", "4.5",
                       "--tolerance", "0.2", "--water-level", "3.5", "--checkpoints", "k.csv", "--outliers", "sor:6,2",
                       "--c2c", "--m3c2", "0.5", "--sign", "winding", "--json", "n.json", "--report", "d",
                       "--visible", "v.ply")  # fmt: skip
    assert result.exit_code == 0
    assert result.stdout.splitlines() == [
        "points  12",
        "sign    up",
        "",
        "Distances",
        "",
        "By depth",
        "          mean,",
        "depth     inner",
        "0 to 1 m    0.1",
    ]
    options = CompareOptions((0.05, 0.2), "winding", Path("k.csv"), True, 0.5, Path("v.ply"), (-1.0, 2.0, 3.0, 4.5),
                             3.5, "sor:6,2", Path("n.json"), Path("d"))  # fmt: skip
    assert calls == [(Path("c.las"), Path("r.ply"), options)]
