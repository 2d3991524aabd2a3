"""Features and matches on workers: the same rows of the database as without."""

import pickle
import sqlite3
from contextlib import closing, nullcontext
from pathlib import Path

import cv2
import numpy as np
import pytest

from survey.sfm import features
from survey.sfm.features import CameraBody, computing_on, match_photographs

SIZE = (320, 240)


class Pickling:
    """Workers of another process, but for the process."""

    def __init__(self):
        self.items = 0

    def map(self, function, items):
        for item in items:
            self.items += 1
            yield pickle.loads(pickle.dumps(pickle.loads(pickle.dumps(function))(pickle.loads(pickle.dumps(item)))))


@pytest.fixture
def photographs(tmp_path, rng) -> Path:
    """Six that overlap, of one plane."""
    layers = [cv2.GaussianBlur(rng.normal(0.0, 1.0, (260, 900)), (0, 0), sigma) * sigma for sigma in (1.2, 3.0, 8.0)]
    plane = np.clip(128.0 + 40.0 * sum(layers), 0.0, 255.0).astype(np.uint8)
    folder = tmp_path / "images"
    folder.mkdir()
    for number in range(6):
        cv2.imwrite(str(folder / f"{number:06d}.png"), plane[:240, 100 * number : 100 * number + 320])
    return folder


def rows(database: Path) -> dict[str, list[tuple]]:
    with closing(sqlite3.connect(database)) as opened:
        named = [name for (name,) in opened.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
        return {name: sorted(opened.execute(f"SELECT * FROM {name}").fetchall(), key=repr) for name in named}


def test_workers_leave_the_rows_of_one_process(photographs, tmp_path, monkeypatch):
    # In parts of four pairs.
    monkeypatch.setattr(features, "_PAIRS_AT_ONCE", 4)
    sensors = [CameraBody(tuple(sorted(path.name for path in photographs.iterdir())), SIZE, 400.0)]
    workers, found = Pickling(), {}
    for name in ("here", "there"):
        work = tmp_path / name
        work.mkdir()
        with nullcontext() if name == "here" else computing_on(lambda: nullcontext(workers)):
            found[name] = rows(match_photographs(photographs, sensors, {}, work, lambda _text: None).database)
    assert found["here"] == found["there"]
    assert len(found["here"]["two_view_geometries"]) == 15
    assert sum(row[1] for row in found["here"]["two_view_geometries"]) > 300
    # Six photographs, and fifteen pairs.
    assert workers.items == 6 + 4
