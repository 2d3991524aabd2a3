"""Tables in text files: what may separate the values, and every fault with its line."""

import pytest

from survey.errors import ConfigError, PosesError
from survey.files.csv_table import column_names, read_table

COLUMNS = ("easting", "height")


def table(tmp_path, text: str, **options):
    path = tmp_path / "t.csv"
    path.write_text(text, encoding="utf-8")
    return [[row.number(name) for name in COLUMNS] for row in read_table(path, COLUMNS, **options)]


@pytest.mark.parametrize(
    "text",
    ["easting,height\n1.5,2.25\n", "\ufeffHeight, Name, Easting\n2.25, a, 1.5\n",
     "# surveyed by level; in May\n\neasting;height\n1,5;2,25\n;\n", "easting\theight\n1,5\t2.25\n",
     '"easting; grid",easting,height\n"a, b",1.5,2.25\n# the end\n', 'name;easting;height\n"a; b";1,5;2,25\r\n'],
)  # fmt: skip
def test_comma_semicolon_and_tab_give_the_same_numbers_with_a_decimal_comma_where_no_comma_separates(tmp_path, text):
    assert table(tmp_path, text) == [[1.5, 2.25]]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "the first line has no column easting, height; expected easting,height, found nothing"),
        ("easting,z\n1,2\n", "the first line has no column height"),
        ("easting,height\n\n# a\n1,2\n1\n", "line 5: 1 values were found, expected 2"),
        ("easting,height\n1,inf\n", "line 2: height is inf, expected a finite number"),
        ("easting;height\n1.234,5;2\n", "line 2: easting is 1.234,5, expected a finite number"),
        ("easting,height\n1,\n", "line 2: height is empty, expected a finite number"),
        ('easting,height\n"1,2\n', "line 2: .*expected a closing quote on the same line"),
    ],
)
def test_a_fault_is_named_with_its_line(tmp_path, text, words):
    with pytest.raises(PosesError, match=words):
        table(tmp_path, text, error=PosesError)


def test_an_optional_column_may_be_missing_or_empty(tmp_path):
    path = tmp_path / "t.csv"
    for text in ("easting,height\n1,2\n", "easting,height,sigma\n1,2,\n"):
        path.write_text(text)
        (row,) = read_table(path, COLUMNS, optional=("sigma",))
        assert row.number("sigma", default=0.5) == 0.5


def test_a_file_that_is_no_text_or_not_there_is_refused(tmp_path):
    path = tmp_path / "t.csv"
    path.write_bytes("easting,height,größe\n".encode("latin-1"))
    with pytest.raises(ConfigError, match=r"t\.csv is not UTF-8"):
        read_table(path, COLUMNS, error=ConfigError)
    assert column_names(path) == ()
    with pytest.raises(ConfigError, match=r"none\.csv cannot be read \(No such file"):
        read_table(tmp_path / "none.csv", COLUMNS, error=ConfigError)
