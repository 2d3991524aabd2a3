"""The tables of the documentation are those that results give."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def test_pages_have_the_tables_of_the_results(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    from published import marks
    from tables import tables

    for (page, name), lines in tables().items():
        begin, end = marks(name)
        text = page.read_text(encoding="utf-8")
        assert text[text.index(begin) + len(begin) : text.index(end)].strip().split("\n") == lines, (page, name)
