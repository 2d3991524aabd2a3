"""Windows of photographs that show a tile, and arrays of which parts are read from files."""

from pathlib import Path

import numpy as np
import pytest
from plane_survey import TILTED, PlaneBed, ring

from fields.device import choose_device
from fields.image_store import GreyImages
from fields.sweep.map_points import places_in_plan
from fields.sweep.maps import HeightMap
from survey.plan.area import Tiling, inside
from survey.run.stored import ArrayFiles
from survey.run.stored_maps import load_masks, save_masks
from survey.run.tile_job import Outlines, windows_of

BED = PlaneBed(TILTED, -2.0)
BOUND = (-2.4, -1.7)


@pytest.fixture(scope="module")
def cameras():
    """A pixel is 1.5 cm: photographs of 6 x 4.5 m."""
    return ring(size=(400, 300))


@pytest.mark.parametrize("number", range(4))
def test_windows_hold_every_pixel_that_shows_the_tile_and_its_rim(cameras, number):
    tiling = Tiling.of((-2.0, -2.0, 2.0, 2.0), 4, rim=0.2)
    windows = windows_of(
        dict(enumerate(cameras)), TILTED, tiling.ground(number, 0.0), tiling.ground(number, tiling.rim), BOUND
    )
    assert {each.width % 64 for each in windows if each.width < 400} <= {0}
    assert sum(each.height * each.width for each in windows) < 0.8 * len(windows) * 300 * 400
    held = {each.view: each for each in windows}
    for view, camera in enumerate(cameras):
        path = camera.paths(camera.pixel_centres(), TILTED)
        for height in BOUND:
            shows = inside(path.at_height(height, TILTED)[..., :2], tiling.ground(number, tiling.rim))
            if not shows.any():
                continue
            shows[held[view].part] = False
            assert not shows.any()


def test_pixels_of_windows_look_along_the_rays_of_their_photograph(cameras):
    tiling = Tiling.of((-2.0, -2.0, 2.0, 2.0), 4, 0.2)
    window = windows_of(dict(enumerate(cameras)), TILTED, tiling.ground(1, 0.0), tiling.ground(1, 0.2), BOUND)[2]
    assert (window.row % 4, window.column % 4, window.height % 8, window.width % 16) == (0, 0, 0, 0)
    camera = cameras[window.view]
    part = camera.cropped(window.row, window.column, window.height, window.width)
    whole = camera.directions(camera.pixel_centres())[window.part]
    np.testing.assert_allclose(part.directions(part.pixel_centres()), whole, atol=1e-12)


def test_a_tile_that_no_view_shows_has_no_windows(cameras):
    assert windows_of(dict(enumerate(cameras)), TILTED, (50.0, 50.0, 60.0, 60.0), (49.8, 49.8, 60.2, 60.2), BOUND) == []


@pytest.mark.parametrize("water", [TILTED, None])
def test_outlines_leave_out_no_photograph_that_shows_an_area(cameras, water, rng):
    outlines, left_out = Outlines(cameras), 0
    for x, y in rng.uniform(-8.0, 8.0, (30, 2)).tolist():
        area = (x, y, x + 0.5, y + 0.5)
        showing = outlines.may_show(water, area, BOUND)
        left_out += len(cameras) - len(showing)
        seen = windows_of(dict(enumerate(cameras)), water, area, area, BOUND)
        assert {each.view for each in seen} <= set(showing)
    assert left_out > 40


def test_images_in_files_are_those_in_memory(tmp_path, rng):
    images = [np.rint(rng.normal(0.0, 30.0, (12, 17))).astype(np.float32) for _ in range(3)]
    images[1][3:5, 2:9] = np.nan
    images[2] += np.float32(0.25)
    kept, stored = GreyImages(images), GreyImages(images, ArrayFiles(tmp_path / "greys"))
    assert stored.are_unmasked is kept.are_unmasked is False
    for view in range(3):
        np.testing.assert_array_equal(stored[view], kept[view])
        part = np.s_[2:9, 4:11]
        np.testing.assert_array_equal(stored.window(view, *part), images[view][part])
    assert sum(path.stat().st_size for path in (tmp_path / "greys").iterdir()) == 12 * 17 * (1 + 1 + 4) + 12 * 3


def test_stored_images_are_found_from_another_working_directory(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    stored = GreyImages([np.zeros((4, 5), dtype=np.float32)], ArrayFiles(Path("greys")))
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert stored[0].shape == (4, 5)


def test_places_in_plan_are_those_of_the_points_of_a_map(device, cameras):
    camera = cameras[1].scaled(0.2)
    height = BED.true_height(camera).astype(np.float32)
    nothing = np.zeros(height.shape, dtype=np.uint8)
    block = BED.block(choose_device("torch") if device.name == "torch" else device, [camera, cameras[0].scaled(0.2)])
    found = places_in_plan(block, HeightMap(0, height, nothing, nothing, nothing))
    expected = camera.paths(camera.pixel_centres(), TILTED).at_height(height.astype(float), TILTED)[..., :2]
    # One step towards the crossing leaves less, and float32 much less.
    assert np.abs(found - expected).max() < 1e-4


def test_masks_come_back_from_a_file(tmp_path, rng):
    masks = [rng.random(shape) < 0.5 for shape in ((3, 5), (4, 4))]
    save_masks(tmp_path / "masks.npz", masks)
    for found, mask in zip(load_masks(tmp_path / "masks.npz"), masks, strict=True):
        np.testing.assert_array_equal(found, mask)
    save_masks(tmp_path / "none.npz", [])
    assert len(load_masks(tmp_path / "none.npz")) == 0
