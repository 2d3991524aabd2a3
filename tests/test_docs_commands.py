"""The commands that documents show are those of the program: verbs, and options of each verb."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer

from survey.commands.verbs import app

ROOT = Path(__file__).resolve().parent.parent
PAGES = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]
PROGRAM = typer.main.get_command(app)
VERBS = {
    name: {"--help"}.union(*((*parameter.opts, *parameter.secondary_opts) for parameter in verb.params))
    for name, verb in PROGRAM.commands.items()
}
BEFORE_VERB = {"--help", "--install-completion"}.union(*(parameter.opts for parameter in PROGRAM.params))


def lines_of_code(text: str) -> Iterator[str]:
    """Lines of blocks of code, continued ones joined, and code in a line of text."""
    fences = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)
    blocks = [*fences.findall(text), *re.findall(r"(?<=\n\n)(?:    .*\n)+", text)]
    for block in blocks:
        yield from re.sub(r"\\\n\s*", " ", block).splitlines()
    for span in re.findall(r"`([^`]+)`", fences.sub("", text)):
        yield " ".join(span.split())


def call_of(line: str) -> tuple[str | None, set[str]] | None:
    """Verb and options of a line that calls the program, without a comment; None of other lines."""
    found = re.match(r"\s*(?:\$ |\.venv/bin/|python -m )*bathynerf(?: (.*))?$", line)
    if found is None:
        return None
    words = re.split(r"\s#|\s{3,}|[|;&]", found[1] or "")[0].split()
    verb = next((word for word in words if re.fullmatch(r"[a-z]+", word)), None)
    return verb, {re.sub(r"^\[|[=\]].*", "", word) for word in words if re.match(r"\[?--", word)}


def wrong_in(text: str) -> list[str]:
    """Calls of verbs or options that there are not."""
    found = []
    for verb, options in filter(None, map(call_of, lines_of_code(text))):
        if verb is not None and verb not in VERBS:
            found.append(f"bathynerf {verb}")
        else:
            known = BEFORE_VERB if verb is None else VERBS[verb]
            found += [f"bathynerf {verb or ''} {option}" for option in sorted(options - known)]
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_commands_of_a_page_are_accepted(page):
    assert wrong_in(page.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("Type\n\n    $ bathynerf procss S\n", ["bathynerf procss"]),
        (
            "Type\n\n    bathynerf export RUN --las F \\\n        --lass F    # --not-this\n",
            ["bathynerf export --lass"],
        ),
        ("```\n.venv/bin/bathynerf --no-such check S\n```", ["bathynerf check --no-such"]),
        ("as `bathynerf process S\n--qualty=draft` does", ["bathynerf process --qualty"]),
        ("`bathynerf check S [--wind W]`, `from bathynerf import x`, `--other`", []),
    ],
)
def test_a_command_that_does_not_exist_is_seen(text, wrong):
    assert wrong_in(text) == wrong
