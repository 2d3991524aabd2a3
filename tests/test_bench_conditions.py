"""Scenes of what real photographs hold: they change photographs and not the truth."""

from __future__ import annotations

from dataclasses import replace

import condition_scenes
import numpy as np
import pytest

from survey.simulate.drawn import DrawnScene, stage_drawing


@pytest.fixture(scope="module")
def still():
    scene = stage_drawing(DrawnScene.tiny(image_px=(40, 30), focal_px=70.0, objects=False))
    return replace(scene, sensor=replace(scene.sensor, samples=1))


@pytest.mark.parametrize(
    ("name", "value"), [("foam", 0.2), ("people", 40.0), ("ripples", 0.1), ("focal_drift", 0.01), ("shadow", 0.5)]
)
def test_photographs_differ_from_each_other_and_the_truth_does_not(still, name, value):
    # The same camera twice: what is left between both is what moved.
    twice = replace(still, cameras=(still.cameras[0],) * 3)
    changed = getattr(condition_scenes, name)(twice, value)
    assert changed.renderer is twice.renderer
    first, later = (changed.photograph(index).astype(float) for index in (0, 2))
    calm = twice.photograph(0).astype(float)
    if name == "shadow":
        # It goes with the camera, and two photographs of one camera are the same.
        np.testing.assert_array_equal(first, later)
        assert (first < calm - 5.0).any(axis=2).sum() in range(1, calm[..., 0].size)
    else:
        assert np.abs(first - later).max() > 5.0


def test_foam_covers_what_it_is_asked_to(still):
    eye = condition_scenes.foam(still, 0.2).of_photograph(still, 1).radiance_of
    x, y = (v.ravel() for v in np.meshgrid(np.linspace(-5.0, 5.0, 90), np.linspace(-5.0, 5.0, 90)))
    down = np.tile([0.0, 0.0, -1.0], (len(x), 1))
    above = np.column_stack([x, y, np.full(len(x), 5.0)])
    covered = (eye(above, down, 0) != still.renderer.radiance_of_rays(above, down)).any(axis=1)
    # Flecks of a patch overlap.
    assert 0.08 < covered.mean() < 0.22


def test_rows_of_a_zone_are_read_at_once(still):
    camera = replace(still.cameras[0], motion=np.array([0.01, 0.0, 0.0]))
    scene = replace(still, cameras=(camera,))
    at = []
    scene = replace(scene, radiance_of=lambda origin, direction, seed: at.append(origin) or np.zeros_like(direction))
    condition_scenes.zones(scene, 3.0).photograph(0)
    # 30 rows in three zones; their middles are 10 rows apart.
    late = np.unique(np.round((np.concatenate(at)[:, 0] - camera.centre[0]) / 0.01, 6))
    np.testing.assert_allclose(late, np.array([5.0, 15.0, 25.0]) - camera.cy)


def test_brown_water_takes_the_contrast_of_deep_ground(still):
    clear, brown = (scene.photograph(0).astype(float) for scene in (still, condition_scenes.brown(still, 2.0)))
    assert brown.std(axis=(0, 1)).max() < 0.5 * clear.std(axis=(0, 1)).max()
