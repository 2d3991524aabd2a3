"""Values in JSON files: plain, without NaN, each file whole."""

import json
from dataclasses import dataclass

import numpy as np
import pytest
from pyproj import CRS

from geo.errors import UnwritableFile
from survey.files.json_values import plain, read_json_object, write_json


@dataclass(frozen=True)
class Pair:
    """Something with fields."""

    low: float
    others: tuple


def test_values_become_plain_and_what_is_not_finite_becomes_none():
    value = {"a": np.float32(0.5), "b": (np.arange(2), [np.nan, -np.inf]), "c": np.bool_(True), 3: CRS(4326)}
    assert plain(value) == {"a": 0.5, "b": [[0, 1], [None, None]], "c": True, "3": "EPSG:4326"}


def test_dataclasses_become_dicts_of_plain_values():
    assert plain([Pair(np.float64(1.0), (float("nan"), "x"))]) == [{"low": 1.0, "others": [None, "x"]}]


def test_a_file_reads_back_as_it_was_written(tmp_path):
    write_json(tmp_path / "some.json", {"tiefe": "1 m – 2 m", "n": np.int64(3)})
    assert json.loads((tmp_path / "some.json").read_text(encoding="utf-8")) == {"tiefe": "1 m – 2 m", "n": 3}
    assert read_json_object(tmp_path / "some.json") == {"tiefe": "1 m – 2 m", "n": 3}


@pytest.mark.parametrize("content", [None, b"", b'{"cut": ', b"[1, 2]", b"\xff\xfe"])
def test_a_file_without_an_object_in_it_reads_as_an_empty_one(tmp_path, content: bytes | None):
    path = tmp_path / "some.json"
    if content is not None:
        path.write_bytes(content)
    assert read_json_object(path) == {}
    assert read_json_object(path / "below_a_file.json") == {}


def test_a_folder_that_is_missing_is_named(tmp_path):
    with pytest.raises(UnwritableFile, match="missing"):
        write_json(tmp_path / "missing" / "some.json", {})
