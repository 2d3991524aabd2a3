"""The pages of help: whole words, an example each, units and exit codes."""

from __future__ import annotations

import re

import pytest
from command_line import bathynerf

from survey.commands.faults import BAD_INPUT as BAD_INPUT_CODE
from survey.commands.faults import BROKEN_PIPE, OUR_BUG, STOPPED
from survey.commands.verbs import VERBS, app
from survey.run.process import QUALITY_GATE_FAILED


@pytest.mark.parametrize("width", [60, 80])
@pytest.mark.parametrize("verb", [None, *(verb.__name__.rpartition(".")[2] for verb in VERBS)])
def test_every_page_of_help_has_an_example_and_breaks_no_word(verb, width, monkeypatch, capsys):
    def page(columns: int) -> str:
        monkeypatch.setenv("COLUMNS", str(columns))
        app([verb, "--help"] if verb else ["--help"], standalone_mode=False, prog_name="bathynerf")
        return capsys.readouterr().out

    narrow = page(width)
    assert max(map(len, narrow.splitlines())) <= width
    # The same words, however the lines are broken.
    assert sorted(narrow.split()) == sorted(page(200).split())
    examples = re.findall(r"^    bathynerf (.*)", narrow.partition("Examples:\n")[2].replace("\\\n", ""), re.MULTILINE)
    assert examples
    for example in examples:
        name, *words = example.split()
        assert verb in (None, name)
        for option in (word for word in words if word.startswith("-")):
            assert re.search(rf"(^|\W){option}\b", narrow), f"{option} is not explained"


def test_units_in_brackets_are_shown():
    assert "this level [m]" in bathynerf("waterline", "--help").stdout
    assert "F-score [m]" in bathynerf("compare", "--help").stdout


def test_help_lists_the_exit_codes():
    listed = re.findall(r"^    (\d+) ", bathynerf("--help").stdout, re.MULTILINE)
    assert [int(code) for code in listed] == [0, OUR_BUG, BAD_INPUT_CODE, QUALITY_GATE_FAILED, STOPPED, BROKEN_PIPE]
