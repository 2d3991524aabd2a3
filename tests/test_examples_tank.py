"""The example for a laboratory's tank: index and pane come back from drawn corners, as well as it says."""

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.stats import chi2

EXAMPLE = Path(__file__).resolve().parent.parent / "examples" / "tank" / "tank.py"
_spec = importlib.util.spec_from_file_location("tank", EXAMPLE)
tank = importlib.util.module_from_spec(_spec)
sys.modules["tank"] = tank
_spec.loader.exec_module(tank)

SIZE, NOISE_PX, INDEX, PANE_M = (4000, 3000), 0.1, 1.334, 0.012


def drawn(seed: int, pane: float = 0.0, places: int = 3, columns: int = 4, rows: int = 3):
    """True values, corners with noise, and the known parameters of the optics."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.linspace(-0.1, 0.1, columns), np.linspace(-0.08, 0.08, rows))
    board = np.tile(np.column_stack([x.ravel(), y.ravel()]), (2 * places, 1))
    place = np.repeat(np.arange(places), 2 * x.size)
    wet = np.tile(np.repeat([False, True], x.size), places)
    boards = [[*rng.uniform(-0.5, 0.5, 3), *rng.uniform(-0.1, 0.1, 2), rng.uniform(0.8, 1.0)] for _ in range(places)]
    inner = [rng.normal(3000.0, 50.0), rng.normal(2000.0, 10.0), rng.normal(1500.0, 10.0), -0.05, 0.02]
    truth = np.concatenate([inner, rng.normal(0.0, 0.05, 2), [rng.normal(0.5, 0.02), INDEX, pane], np.ravel(boards)])
    corners = tank.Corners(tuple(f"p{k}" for k in range(places)), place, wet, board, np.zeros_like(board))
    optics = tank.Optics(SIZE, (0.5, np.inf), (1.33, np.inf), (pane, 0.0))
    pixels = tank.project(truth, corners, optics) + NOISE_PX * rng.standard_normal(board.shape)
    return truth, replace(corners, pixel=pixels), optics


def test_corners_in_air_are_where_opencv_has_them():
    truth, corners, optics = drawn(0)
    f, cx, cy, k1, k2 = truth[:5]
    matrix, first = np.array([[f, 0.0, cx - 0.5], [0.0, f, cy - 0.5], [0.0, 0.0, 1.0]]), corners.place == 0
    board = np.column_stack([corners.board[first], np.zeros(first.sum())])
    expected, _ = cv2.projectPoints(board, truth[10:13], truth[13:16], matrix, np.array([k1, k2, 0.0, 0.0]))
    found = tank.project(truth, replace(corners, wet=np.zeros_like(corners.wet)), optics)[first]
    np.testing.assert_allclose(found, expected[:, 0] + 0.5, atol=1e-6)


def test_index_comes_back_within_its_std():
    off = []
    for seed in range(2):
        truth, corners, optics = drawn(seed)
        value, std = tank.estimate(corners, optics)[tank.INDEX]
        assert std < 0.02
        off.append((value - truth[8]) / std)
    # One in ten thousand is further off.
    assert np.sum(np.square(off)) < chi2.ppf(0.9999, len(off))


def test_thickness_of_a_pane_comes_back_where_the_way_to_it_is_measured():
    truth, corners, optics = drawn(1, PANE_M, places=4)
    known = replace(optics, distance_m=(truth[7], 0.0005), index=(INDEX, 0.0), pane_m=(0.010, np.inf))
    value, std = tank.estimate(corners, known)[tank.PANE]
    assert std < 0.005
    assert abs(value - PANE_M) < 3.9 * std


@pytest.mark.slow
def test_stated_std_of_the_index_is_that_of_its_errors():
    off = []
    for seed in range(20):
        truth, corners, optics = drawn(seed, PANE_M)
        value, std = tank.estimate(corners, optics)[tank.INDEX]
        off.append((value - truth[8]) / std)
    low, high = chi2.ppf([0.0005, 0.9995], len(off))
    assert low < np.sum(np.square(off)) < high


def test_a_table_is_read_and_the_estimates_are_printed(tmp_path, capsys):
    _, corners, _ = drawn(2)
    path = tmp_path / "corners.csv"
    rows = [
        f"{corners.places[k]},{'water' if wet else 'air'},{x},{y},{u},{v}"
        for k, wet, (x, y), (u, v) in zip(corners.place, corners.wet, corners.board, corners.pixel, strict=True)
    ]
    path.write_text("\n".join([",".join(tank.COLUMNS), *rows]), encoding="utf-8")
    tank.main([str(path), "--size", "4000", "3000", "--distance", "0.5"])
    printed = capsys.readouterr().out
    assert "index" in printed
    assert "p2, water" in printed
    path.write_text("\n".join([",".join(tank.COLUMNS), *(row for row in rows if "water" not in row)]))
    with pytest.raises(SystemExit, match="expected photographs in air and in water"):
        tank.main([str(path), "--size", "4000", "3000", "--distance", "0.5"])
