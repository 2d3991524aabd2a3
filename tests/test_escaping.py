"""Texts of files at every place that shows them: nothing in them is obeyed by a terminal, a browser or Markdown."""

import io
import json
import re
import unicodedata
from dataclasses import replace
from html.parser import HTMLParser
from types import SimpleNamespace

import pytest
from command_line import Terminal, bathynerf
from hypothesis import given
from hypothesis import strategies as st
from markdown_it import MarkdownIt
from matplotlib.figure import Figure
from shown_run import served, shown_of
from small_survey import TOML, small_survey

from survey.commands.faults import BAD_INPUT, say_error
from survey.errors import SurveyError
from survey.marking.server import page
from survey.marking.session import MarkingSession
from survey.progress import Progress
from survey.report.page import render_page
from survey.viewer.page import write_page
from survey.words import MOST_CHARACTERS, figure_text, markdown, printable

NAMES = (
    '<iframe srcdoc="<script>parent.ran = 1</script>">',
    "<script>ran = 1</script>",
    "</title><img src=x onerror='ran = 1'>",
    "![picture](http://192.0.2.1/a.png) [link](javascript:ran)",
    "`code` | *bold* | # head | {1 + 1} | &lt; | \\ | ~~a~~",
    "1. - + > = www.example.org http://192.0.2.1/",
    "\x1b]0;title\x07\x1b[2J\r\x9b2J\x08",
    "gpj.\u202eevil\u2066\u200f",
    "two\nlines\x0b\x85\u2028of it",
    "no UTF-8: \udcff",
    "{{ 7 * 7 }} {% raw %} $\\frac{$",
)
texts = st.text(st.characters()) | st.sampled_from(NAMES)


def is_obeyed(text: str) -> bool:
    """Whether a terminal could obey a character of a text in one line."""
    return any(unicodedata.category(each) in ("Cc", "Cf", "Cs", "Zl", "Zp") for each in text)


@given(texts)
def test_a_printable_text_has_no_character_that_a_terminal_obeys_and_is_as_it_was_without_any(text):
    shown = printable(text)
    assert not is_obeyed(shown)
    assert printable(shown) == shown
    assert (shown == text) or is_obeyed(text) or not text.isprintable()
    shown.encode("utf-8")


@pytest.mark.parametrize("text", ["a" * 10**7, "many words " * 10**6, "[" * 10**6 + " is no number", "\x1b" * 10**6])
def test_long_texts_are_shown_by_their_start_and_their_end(text):
    shown = printable(f"key {text} is unknown, give another")
    # An escape takes at most ten characters.
    assert len(shown) < 10 * (MOST_CHARACTERS + 100)
    assert shown.startswith("key ")
    assert "characters) ..." in shown
    assert shown.endswith(" is unknown, give another")


READER = MarkdownIt("commonmark", {"html": True}).enable(["table", "strikethrough"])


def kinds_and_text(content: str) -> tuple[set[str], str]:
    """Kinds of the parts of a text in Markdown, and what it shows."""
    tokens = [inner for token in READER.parse(content) for inner in (token, *(token.children or []))]
    return {each.type for each in tokens}, "".join(each.content for each in tokens if each.type == "text")


@given(texts)
def test_markdown_shows_a_text_as_it_is(text):
    kinds, shown = kinds_and_text(f"of **{markdown(text)}**  \n| {markdown(text)} | b")
    assert printable(text).strip() in shown
    assert kinds <= {
        *("paragraph_open", "paragraph_close", "inline", "strong_open", "strong_close"),
        *("text", "text_special", "softbreak", "hardbreak"),
    }


class Tags(HTMLParser):
    """Names of elements and attributes of a page, and texts of its title."""

    def __init__(self, page: str):
        super().__init__()
        self.names: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.names += [tag, *(f"{tag} {name}" for name, _ in attrs)]


@pytest.mark.parametrize("name", [*NAMES, "$", "$$", r"\$a$ costs $b\$"])
def test_a_figure_shows_a_text_as_it_is(name):
    title = Figure().text(0.0, 0.0, figure_text(name))
    assert title._preprocess_math(title.get_text()) == (printable(name), False)
    title.figure.savefig(io.BytesIO())


@pytest.mark.parametrize("name", NAMES)
def test_a_report_has_the_same_elements_under_any_name(plane_report, name):
    figures = plane_report.figures
    page = render_page(figures | {"survey": figures["survey"] | {"name": name}}, [])
    assert Tags(page).names == Tags(render_page(figures, [])).names


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    return shown_of(tmp_path_factory.mktemp("shown") / "s", num=40)


@pytest.fixture
def in_markdown(monkeypatch):
    """What viser is given as Markdown."""
    import viser

    contents, add, change = [], viser.GuiApi.add_markdown, viser.GuiMarkdownHandle.content.fset

    def recorded(gui, content, **options):
        contents.append(content)
        return add(gui, content, **options)

    def changed(handle, content):
        contents.append(content)
        change(handle, content)

    monkeypatch.setattr(viser.GuiApi, "add_markdown", recorded)
    monkeypatch.setattr(viser.GuiMarkdownHandle, "content", property(viser.GuiMarkdownHandle.content.fget, changed))
    return contents


@pytest.mark.parametrize("name", NAMES)
def test_the_panels_of_the_viewer_show_names_as_they_are(shown, in_markdown, name, monkeypatch, tmp_path):
    folder = tmp_path / name.replace("/", "_")
    folder.mkdir()

    def fail(*_given):
        raise SurveyError(f"{folder.name} cannot be read")

    with served(replace(shown, name=folder.name)) as session:
        monkeypatch.setattr(session.clicks._photographs, "window", fail)
        session.clicks._show_windows([SimpleNamespace()])
    told = [kinds_and_text(content) for content in in_markdown]
    of_markup = {"html_block", "html_inline", "image", "link_open", "code_inline", "s_open"}
    assert of_markup.isdisjoint(kind for kinds, _ in told for kind in kinds)
    assert sum(printable(folder.name).strip() in text for _, text in told) >= 3


@pytest.mark.parametrize("name", NAMES)
def test_an_exported_page_has_the_same_elements_under_any_name(shown, name, tmp_path):
    without = replace(shown, has_photographs=False)
    for number, each in enumerate((name, "small")):
        write_page(tmp_path / f"{number}.html", replace(without, name=each))
    found, expected = (Tags((tmp_path / f"{n}.html").read_text(encoding="utf-8")).names for n in range(2))
    assert found == expected


@pytest.mark.parametrize("name", NAMES)
def test_the_page_of_mark_is_the_same_for_all_surveys_and_sets_texts_alone(name, tmp_path):
    toml = TOML.replace('"small"', json.dumps(printable(name)))
    state = MarkingSession(small_survey(tmp_path / "s", toml=toml)).state()
    assert json.loads(json.dumps(state))["name"] == printable(name)
    script = page().decode()
    assert "textContent" in script
    assert re.findall(r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\b|srcdoc", script) == []


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("stream", [io.StringIO, Terminal])
def test_a_terminal_and_a_log_obey_no_text_of_a_file(name, stream, tmp_path, monkeypatch):
    to, log = stream(), tmp_path / "log.txt"
    monkeypatch.setattr("sys.stderr", to)
    with Progress(verbosity=1, log_path=log, stream=to) as progress:
        for say in (progress.note, progress.detail, progress.warn):
            say(f"the file {name} is named")
        if stream is io.StringIO:
            # On a terminal its bar is drawn by control characters.
            with progress.stage(name, 2.0) as step:
                step.advance(1.0, detail=name)
    say_error(f"{name} cannot be read")
    for text in (to.getvalue(), log.read_text(encoding="utf-8")):
        assert not is_obeyed(text.replace("\n", ""))
        assert len(text.splitlines()) <= 6 or stream is Terminal


@pytest.mark.parametrize("name", [each.replace("/", "_") for each in NAMES])
def test_the_command_line_obeys_no_name_of_a_file(name, tmp_path):
    folder = small_survey(tmp_path / name, toml=TOML + "wrong_key = 1\n")
    (folder / "images" / f"{name}.jpg").write_bytes(b"none")
    for options in (("check", folder), ("process", folder), ("init", folder), ("view", folder), ("mark", folder)):
        said = bathynerf(*options)
        assert said.exit_code == BAD_INPUT
        assert not is_obeyed((said.stdout + said.stderr).replace("\n", ""))
