"""A trained field from where a browser looks."""

import math
import time
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import numpy as np
import pytest
from plane_field import field_over, level_layer
from shown_run import served, shown_of

from refract import FlatWater
from survey.run.trained_field import save_layer_field
from survey.viewer.shown import TrainedField, field_of_run
from survey.viewer.tree import camera_of_screen

WATER = FlatWater((0.0, 0.0, 0.0))
DOWN = np.diag([1.0, -1.0, -1.0])


@pytest.fixture
def folder(tmp_path):
    """A field over a bed of 8 by 8 m, 2 m deep."""
    save_layer_field(tmp_path, field_over(level_layer(-2.0), WATER))
    return tmp_path


def test_the_camera_of_a_screen_sees_what_it_shows():
    camera = camera_of_screen(np.array([1.0, 2.0, 9.0]), DOWN, math.radians(50.0), 1.5, 900.0)
    assert (camera.width, camera.height) == (1350, 900)
    top = camera.directions(np.array([675.0, 0.0]))
    assert math.degrees(math.acos(-top[2])) == pytest.approx(25.0)


@pytest.mark.parametrize("dry", [True, False])
def test_the_picture_shows_the_field_and_white_beside_it(folder, dry):
    view = camera_of_screen(np.array([0.0, 0.0, 8.0]), DOWN, math.radians(60.0), 1.5, 900.0)
    picture = field_of_run(folder, WATER).picture(view, dry=dry)
    assert picture.shape == (200, 300, 3)
    is_white = (picture == 255).all(axis=2)
    assert not is_white[100, 150]
    assert is_white[:, :5].all()
    # Eight metres of bed, ten under the camera: straight rays show it as that part of the width, bent ones wider.
    width = 200 / math.tan(math.radians(30.0)) / 2.0 * 8.0 / 10.0
    found = (~is_white[100]).sum()
    assert abs(found - width) <= 3 if dry else width < found < 1.1 * width


def test_a_field_is_loaded_once_however_many_clicks_there_are_and_keeps_its_note():
    loads: list[int] = []
    seen = SimpleNamespace(coloured=np.ones((2, 2), bool), rgb=np.zeros((2, 2, 3), np.uint8))

    def load(note):
        loads.append(1)
        time.sleep(0.05)
        note("half trained")
        return lambda camera, dry: seen

    field = TrainedField("mdw", load)
    view = camera_of_screen(np.array([0.0, 0.0, 8.0]), DOWN, math.radians(60.0), 1.5, 900.0)
    with ThreadPoolExecutor(4) as pool:
        pictures = list(pool.map(lambda _click: field.picture(view, dry=True), range(4)))
    assert len(loads) == 1
    assert field.notes == ["half trained"]
    assert all((picture == 0).all() for picture in pictures)


def test_a_run_with_a_field_offers_it(folder, tmp_path):
    shown = shown_of(tmp_path / "t", num=20)
    shown.fields = [field_of_run(folder, WATER)]
    with served(shown) as session:
        labels = [handle.label for handle in session.server.gui._gui_input_handle_from_uuid.values()]
    assert "render from here" in labels
