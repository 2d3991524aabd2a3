"""The lines of progress where there is no terminal, and durations as people read them."""

import io
import logging
import time

import pytest
from command_line import Terminal, without_times
from PIL import Image

from survey import progress as progress_room
from survey.progress import Progress, clock
from survey.words import wrap_for


def test_stages_are_plain_lines_with_the_time_left_where_there_is_no_terminal(tmp_path):
    now = [0.0]
    stream = io.StringIO()
    with Progress(stream=stream, log_path=tmp_path / "run" / "log.txt", now=lambda: now[0]) as progress:
        assert progress_room.current() is progress
        with progress.stage("sweep", total=4) as stage:
            for _ in range(3):
                now[0] += 30.0
                stage.advance(detail="0001.jpg")
            now[0] += 60.0
            progress.say_if_due(stage)
        progress.detail("a detail")
        progress.warn("a doubt")
    minutes = ["sweep: 50 %, about 60 seconds left, 0001.jpg", "sweep: 75 %, about 30 seconds left"]
    assert without_times(stream.getvalue()).splitlines() == [*minutes, "warning: a doubt"]
    lines = [line.split(" ", 2)[2] for line in (tmp_path / "run" / "log.txt").read_text().splitlines()]
    assert lines == ["sweep ...", *minutes, "sweep: done in 2 min 30 s", "a detail", "warning: a doubt"]
    assert progress_room.current() is not progress


def test_a_notebook_has_one_line_and_one_picture_that_are_written_anew(tmp_path):
    nbformat, nbclient = (pytest.importorskip(name) for name in ("nbformat", "nbclient"))
    path = tmp_path / "curve.png"
    Image.new("RGB", (4, 3)).save(path)
    code = f"""
from pathlib import Path
from survey.progress import current, opened
with opened() as progress:
    progress.picture(Path({str(path)!r}))
    progress.picture(Path({str(path)!r}))
with current().stage("sweep", total=2) as stage:
    stage.advance()
    stage.advance()
current().note("a note")
"""
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(code)])
    nbclient.NotebookClient(notebook, timeout=120, kernel_name="python3").execute()
    picture, *lines = (output["data"] for output in notebook.cells[0].outputs)
    assert picture["image/png"]
    sweep, note = (line["text/plain"] for line in lines)
    assert sweep.startswith("sweep: 100 %")
    assert note.endswith("a note\n")


def test_a_stage_that_fails_is_not_said_to_be_done():
    stream = io.StringIO()
    with Progress(stream=stream, verbosity=1) as progress, pytest.raises(RuntimeError), progress.stage("sweep"):
        raise RuntimeError
    assert without_times(stream.getvalue()) == "sweep ...\n"


def test_a_quiet_run_says_only_warnings():
    stream = io.StringIO()
    with Progress(stream=stream, verbosity=-1) as progress, progress.stage("sweep"):
        progress.note("a note")
        progress.warn("a doubt")
    assert without_times(stream.getvalue()) == "warning: a doubt\n"


def test_lines_without_a_terminal_begin_with_their_time():
    stream = io.StringIO()
    with Progress(stream=stream) as progress:
        progress.note("a note")
    time.strptime(stream.getvalue(), "%Y-%m-%d %H:%M:%S a note\n")


@pytest.mark.parametrize("columns", [40, 80])
def test_a_terminal_gets_whole_words_and_paths(monkeypatch, columns):
    monkeypatch.setenv("COLUMNS", str(columns))
    monkeypatch.setenv("TERM", "xterm")
    stream = Terminal()
    words = "warnings have sentences of many well-known words with " + "x" * 100 + "/survey.toml among them"
    with Progress(stream=stream) as progress:
        progress.warn(words)
    lines = stream.getvalue().splitlines()
    assert " ".join(line.strip() for line in lines) == f"warning: {words}"
    assert all(len(line) <= columns or "xxx" in line for line in lines)
    assert wrap_for(words, io.StringIO()) == words


def test_all_lines_go_to_the_logger_and_its_handlers_take_the_place_of_warnings(caplog, capsys):
    with caplog.at_level(logging.DEBUG, logger="bathynerf"):
        progress_room.current().warn("a doubt")
        with Progress(stream=io.StringIO(), verbosity=-2) as progress, progress.stage("sweep"):
            progress.detail("a detail")
    assert [(record.levelname, record.getMessage().partition(": done")[0]) for record in caplog.records] == [
        ("WARNING", "a doubt"),
        ("INFO", "sweep ..."),
        ("DEBUG", "a detail"),
        ("INFO", "sweep"),
    ]
    # pytest's handler is one.
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.04, "0.0 s"), (9.94, "9.9 s"), (9.96, "10 s"), (59.6, "1 min 00 s"), (185, "3 min 05 s"), (7800, "2 h 10 min")],
)
def test_durations_are_for_people(seconds, text):
    assert clock(seconds) == text
