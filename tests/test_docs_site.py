"""The site of the documentation has every page and the options of every command."""

from __future__ import annotations

import re
from pathlib import Path

from survey.commands.verbs import VERBS

DOCS = Path(__file__).resolve().parent.parent / "docs"


def test_every_page_is_in_a_section():
    listed = {
        (page.parent / f"{entry}.md").resolve()
        for page in (DOCS / "sections").glob("*.md")
        for entry in re.findall(r"^\.\./\S+$", page.read_text(), re.MULTILINE)
    }
    assert set(DOCS.glob("*.md")) | set(DOCS.glob("notebooks/*.md")) <= listed | {DOCS / "index.md"}


def test_the_options_of_every_command_are_in_the_reference():
    named = re.findall(r"^```\{help\} (\S+)$", (DOCS / "options.md").read_text(), re.MULTILINE)
    assert named == [verb.__name__.rpartition(".")[2] for verb in VERBS]
