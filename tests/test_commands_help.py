"""The pages of help: whole words, an example each, units and exit codes."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import bathynerf, console

from survey.commands.faults import BAD_INPUT as BAD_INPUT_CODE
from survey.commands.faults import BROKEN_PIPE, OUR_BUG, STOPPED
from survey.commands.verbs import VERBS, app
from survey.run.process import QUALITY_GATE_FAILED

# Lines of a small terminal.
SCREEN = 24


@pytest.mark.parametrize("width", [60, 80])
@pytest.mark.parametrize("verb", [None, *(verb.__name__ for verb in VERBS)])
def test_every_page_of_help_has_an_example_and_breaks_no_word(verb, width, monkeypatch, capsys):
    def page(columns: int) -> str:
        monkeypatch.setenv("COLUMNS", str(columns))
        app([verb, "--help"] if verb else ["--help"], standalone_mode=False, prog_name="bathynerf")
        return capsys.readouterr().out

    narrow = page(width)
    assert max(map(len, narrow.splitlines())) <= width
    # Placeholders are words as they are typed, and what is longer than a screen has panels.
    assert not re.search(r"[{}<>]", re.sub(r"\d<=x<=\d", "", narrow))
    panels = re.findall(r"^(\S.*):$", narrow, re.MULTILINE)
    assert width < 80 or len(narrow.splitlines()) <= SCREEN or len(panels) > 2 or verb is None
    # The same words, however the lines are broken.
    assert sorted(narrow.split()) == sorted(page(200).split())
    examples = re.findall(r"^    bathynerf (.*)", narrow.partition("Examples:\n")[2].replace("\\\n", ""), re.MULTILINE)
    assert examples
    for example in examples:
        name, *words = example.split()
        assert verb in (None, name)
        for option in (word for word in words if word.startswith("-")):
            assert re.search(rf"(^|\W){option}\b", narrow), f"{option} is not explained"


@pytest.mark.parametrize(("typed", "number", "found"), [
    ("bathynerf wat", 1, "waterline"),
    ("bathynerf process --qua", 2, "--quality"),
    ("bathynerf process --quality f", 3, "fine"),
    ("bathynerf -v exp", 2, "export"),
])  # fmt: skip
def test_a_shell_completes_verbs_options_and_their_words(typed, number, found):
    asked = {"_BATHYNERF_COMPLETE": "complete_bash", "COMP_WORDS": typed, "COMP_CWORD": str(number)}
    assert console(env={**os.environ, **asked}, stdout=subprocess.PIPE).stdout.split() == [found]


def test_the_package_runs_as_a_module(tmp_path):
    root = Path(__file__).resolve().parent.parent
    command = [sys.executable, "-m", "bathynerf", "-q"]
    shown = subprocess.run(command, cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(root)}, capture_output=True)
    # Without a verb it is help.
    assert shown.returncode == 0
    assert shown.stdout.startswith(b"Usage: bathynerf ")


def test_units_in_brackets_are_shown():
    assert "F-score [m]" in bathynerf("compare", "--help").stdout


def test_help_lists_the_exit_codes():
    listed = re.findall(r"^    (\d+) ", bathynerf("--help").stdout, re.MULTILINE)
    assert [int(code) for code in listed] == [0, OUR_BUG, BAD_INPUT_CODE, QUALITY_GATE_FAILED, STOPPED, BROKEN_PIPE]
