"""Arrays and maps of a run: they come back as they were, or are named where they cannot be read."""

import math
from dataclasses import replace

import numpy as np
import pytest

from fields.solver.noise import NoiseShares, Shifts
from fields.solver.solver import SolvedMap, SolverFigures
from fields.sweep.maps import HeightMap, views_of
from survey.errors import SurveyError
from survey.run.stage_solver import load_figures, save_figures
from survey.run.stored import load_arrays, mapped_arrays, save_arrays
from survey.run.stored_maps import Stored, map_store, save_maps


def test_height_maps_come_back_as_they_were_whatever_their_sizes(tmp_path, rng):
    def height_map(view: int, *size: int) -> HeightMap:
        height, score, spread = rng.normal(size=(3, *size)).astype(np.float32)
        return HeightMap(view, height, score, rng.integers(0, 9, size).astype(np.uint8), spread)

    maps = [height_map(7, 4, 6), height_map(3, 3, 5)]
    save_maps(tmp_path / "maps.npz", HeightMap, maps)
    again = Stored(tmp_path / "maps.npz", HeightMap)
    assert [m.view for m in again] == [7, 3]
    for old, new in zip(maps, again, strict=True):
        for name in ("height", "score", "agreeing", "spread"):
            assert getattr(old, name).dtype == getattr(new, name).dtype
            np.testing.assert_array_equal(getattr(old, name), getattr(new, name))


def test_stored_maps_stay_in_memory_where_there_is_room_and_cannot_be_changed_there(tmp_path, rng):
    maps = [SolvedMap(np.arange(3), *rng.normal(size=(2, 3)).astype(np.float32)) for _ in range(2)]
    save_maps(tmp_path / "solved.npz", SolvedMap, maps)
    kept = Stored(tmp_path / "solved.npz", SolvedMap, in_memory=maps[0].pixels.nbytes + 24)
    assert (kept[0] is kept[0], kept[1] is kept[1]) == (True, False)
    np.testing.assert_array_equal(kept[0].height, maps[0].height)
    with pytest.raises(ValueError, match="read-only"):
        kept[0].height[0] = 0.0


def test_views_of_stored_maps_are_known_without_reading_them(tmp_path, rng):
    sizes = {7: (4, 6), 3: (3, 5)}
    maps = [
        HeightMap(view, *rng.normal(size=(2, *size)), np.zeros(size, np.uint8), np.zeros(size))
        for view, size in sizes.items()
    ]
    save_maps(tmp_path / "maps.npz", HeightMap, maps)
    stored = Stored(tmp_path / "maps.npz", HeightMap)
    (tmp_path / "maps.npz").unlink()
    assert views_of(stored) == views_of(maps) == [7, 3]


@pytest.mark.parametrize(("in_memory", "num_files"), [(0, 2), (48, 1), (96, 0)])
def test_maps_that_are_worked_on_lie_in_a_folder_where_memory_has_no_room(tmp_path, rng, in_memory, num_files):
    maps = [SolvedMap(np.arange(3), *rng.normal(size=(2, 3)).astype(np.float32)) for _ in range(2)]
    assert maps[0].pixels.nbytes + maps[0].height.nbytes + maps[0].std.nbytes == 48
    with map_store(tmp_path / "scratch", SolvedMap, in_memory) as make_store:
        first, second = make_store(), make_store()
        for place, solved in zip((first, second), maps, strict=True):
            place[4] = solved
            place[4] = solved
            np.testing.assert_array_equal(place[4].height, solved.height)
        assert len(list(tmp_path.rglob("*.npy"))) == num_files
        assert (list(first), 4 in first, 5 in first, len(second)) == ([4], True, False, 1)
        first.clear()
        with pytest.raises(KeyError):
            first[4]
        second[5] = maps[0]
        assert (list(first), list(second)) == ([], [4, 5])
    assert list(tmp_path.iterdir()) == []


def test_height_maps_that_lack_an_array_are_named_with_the_mend(tmp_path):
    save_arrays(tmp_path / "maps.npz", views=np.array([0]), height_0=np.zeros((2, 2)))
    with pytest.raises(SurveyError, match=r"maps\.npz cannot be read .*lacks the array score_0.*delete.*process"):
        Stored(tmp_path / "maps.npz", HeightMap)


@pytest.mark.parametrize("load", [load_arrays, mapped_arrays])
@pytest.mark.parametrize("spoil", ["missing", "cut", "text", "changed"])
def test_arrays_that_cannot_be_read_are_named_with_the_mend(tmp_path, load, spoil):
    path = tmp_path / "data.npz"
    save_arrays(path, x=np.zeros(1000))
    whole = path.read_bytes()
    if spoil == "missing":
        path.unlink()
    elif spoil == "cut":
        path.write_bytes(whole[:2000])
    elif spoil == "changed":
        path.write_bytes(whole[:2000] + b"\x01" + whole[2001:])
    else:
        path.write_text("not arrays")
    with pytest.raises(SurveyError, match=r"data\.npz cannot be read.*process"):
        load(path)


def test_arrays_that_stay_in_the_file_are_those_that_are_loaded(tmp_path, rng):
    values = rng.normal(size=(3, 4))
    arrays = {"c": values, "f": np.asfortranarray(values), "empty": np.empty((0, 3)), "scalar": np.array(2.5)}
    save_arrays(tmp_path / "data.npz", **arrays)
    loaded, mapped = load_arrays(tmp_path / "data.npz"), mapped_arrays(tmp_path / "data.npz")
    assert list(mapped) == list(loaded) == list(arrays)
    for name, array in arrays.items():
        np.testing.assert_array_equal(loaded[name], array)
        np.testing.assert_array_equal(mapped[name], array)


def test_what_the_solver_could_not_learn_comes_back_as_unknown(tmp_path):
    known = SolverFigures(0.011, Shifts(0.02, 0.0), NoiseShares(0.7, 0.1, 0.2, 1.5), -1.25, 0.9)
    save_figures(tmp_path, known)
    assert load_figures(tmp_path) == known
    save_figures(tmp_path, replace(known, spectral_slope=math.nan, shifts=Shifts(math.nan, 0.0)))
    again = load_figures(tmp_path)
    assert math.isnan(again.spectral_slope)
    assert math.isnan(again.shifts.pose_std_px)
    save_figures(tmp_path, None)
    assert load_figures(tmp_path) is None
