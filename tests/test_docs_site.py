"""The site of the documentation has every page and the options of every command."""

import importlib
import re
from pathlib import Path

from survey.commands.verbs import VERBS

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
# What a reader has the patience for. Rows of tables cannot be broken in Markdown.
README_LINES, LINE, PAGE_WORDS, MEASUREMENT_WORDS, ALL_WORDS = 110, 120, 1500, 1200, 34_800
# For whoever works on the program, with their most words: not counted among the pages of users.
FOR_AUTHORS = {"decisions.md": 10_000, "theory.md": 1500, "field-theory.md": 1500, "papers.md": 3500}


def test_every_page_is_in_a_section():
    listed = {
        (page.parent / f"{entry}.md").resolve()
        for page in (DOCS / "sections").glob("*.md")
        for entry in re.findall(r"^\.\./\S+$", page.read_text(), re.MULTILINE)
    }
    assert set(DOCS.glob("*.md")) | set(DOCS.glob("notebooks/*.md")) <= listed | {DOCS / "index.md"}


def test_the_options_of_every_command_are_in_the_reference():
    named = re.findall(r"^```\{help\} (\S+)$", (DOCS / "options.md").read_text(), re.MULTILINE)
    assert named == [verb.__name__ for verb in VERBS]


def pages() -> dict[Path, str]:
    """All pages of the site, with their text."""
    found = [*DOCS.glob("*.md"), *DOCS.glob("sections/*.md"), *DOCS.glob("notebooks/*.md")]
    return {page: page.read_text(encoding="utf-8") for page in sorted(found)}


def words(text: str) -> int:
    """Words of a page; bars and rules of tables are none."""
    return sum(any(letter.isalnum() for letter in word) for word in text.split())


def test_pages_are_short():
    measurements = re.findall(r"^\.\./(\S+)$", (DOCS / "sections" / "measurements.md").read_text(), re.MULTILINE)
    counts = {page: words(text) for page, text in pages().items()}
    for name, most in FOR_AUTHORS.items():
        assert counts.pop(DOCS / name) <= most
    long = {
        page.name: count
        for page, count in counts.items()
        if count > (MEASUREMENT_WORDS if page.stem in measurements else PAGE_WORDS)
    }
    assert long == {}
    assert sum(counts.values()) < ALL_WORDS
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= README_LINES


def test_lines_of_pages_fit_a_screen():
    texts = pages() | {page: page.read_text(encoding="utf-8") for page in ROOT.glob("*.md")}
    wide = {
        f"{page.relative_to(ROOT)}:{number}": len(line)
        for page, text in texts.items()
        for number, line in enumerate(text.splitlines(), 1)
        if len(line) > LINE and not line.startswith("|")
    }
    assert wide == {}


def test_the_functions_that_equations_name_are_in_their_files():
    file, found = ROOT, 0
    for line in (DOCS / "theory.md").read_text(encoding="utf-8").splitlines():
        # Rows of four columns: what, equation, source, file: function.
        for name in re.findall(r"`([^`]+)`", line.rpartition(" | ")[2]) if line.startswith("| ") else ():
            if name.endswith(".py"):
                file = ROOT / name if "/" in name else file.parent / name
                assert file.is_file(), name
            else:
                defined = rf"^ *(?:def|class) {name.rpartition('.')[2]}\b"
                assert re.search(defined, file.read_text(encoding="utf-8"), re.MULTILINE), f"{file}: {name}"
                found += 1
    assert found > 30


def test_the_defaults_on_the_page_of_papers_are_those_of_the_code():
    found = 0
    for line in (DOCS / "papers.md").read_text(encoding="utf-8").splitlines():
        # Rows of five columns: where, what, here, default, deviation. Of "`scales` 6" the names stand under "here".
        cells = line[1:-1].split("|") if line.startswith("| ") else ()
        for name, number in re.findall(r"`(\w+)` (\d+(?:\.\d+)?)", cells[3]) if len(cells) == 5 else ():
            places = [owner for dotted in re.findall(r"`(\w+(?:\.\w+)+)`", cells[2]) for owner in owners(dotted)]
            values = [getattr(owner, name) for owner in places if hasattr(owner, name)]
            assert values, f"no default {name} in {cells[2]}"
            assert values[0] == float(number), f"{name} of {cells[2]}"
            found += 1
    assert found > 50


def owners(dotted: str) -> list[object]:
    """What a dotted name stands for, a class of a module or a module, and the module."""
    try:
        return [importlib.import_module(dotted)]
    except ModuleNotFoundError:
        module = importlib.import_module(dotted.rpartition(".")[0])
        return [getattr(module, dotted.rpartition(".")[2]), module]
