"""The tables of the documentation are those that results give; their rows."""

from __future__ import annotations

import pytest
import tables


def test_pages_have_the_tables_of_the_results():
    for (page, name), lines in tables.tables().items():
        begin, end = tables.marks(name)
        text = page.read_text(encoding="utf-8")
        assert text[text.index(begin) + len(begin) : text.index(end)].strip().split("\n") == lines, (page, name)


def test_a_table_stands_between_its_marks_and_the_rest_of_the_page_stays(tmp_path):
    (begin, end), page = tables.marks("drawn"), tmp_path / "page.md"
    page.write_text(f"before\n{begin}\nold table\n{end}\nafter\n")
    tables.publish(page, "drawn", ["| new |"])
    assert page.read_text() == f"before\n{begin}\n\n| new |\n\n{end}\nafter\n"
    with pytest.raises(SystemExit, match="has no lines"):
        tables.publish(page, "other", [])


def test_a_shutter_is_said_with_what_it_does_to_heights():
    rolling = {"check_up_m": [0.03, -0.03], "readout_s": 0.0021, "std_s": 0.0012}
    said = " ".join(tables.shutter_rows({"global": {"check_up_m": [0.04, 0.04]}, "rolling": rolling}))
    assert "answers 2.1 ms ± 1.2 ms" in said
    assert "an rms of 40 mm with a global shutter and 30 mm with that" in said


def test_a_target_with_wrong_coordinates_does_not_count():
    sound = {"off_m": [0.01, 0.0, -0.02], "std_m": [0.02, 0.02, 0.02], "marks": 3}
    wrong = {"off_m": [0.8, -2.0, -5.0], "std_m": [0.02, 0.02, 0.2], "marks": 2}
    lines = tables.target_rows({"targets": {"a": sound, "b": wrong}, "warnings": []})
    assert "| wrong coordinates |" in lines[3]
    assert "Heights of 1 of 1 sound targets" in " ".join(lines)
