"""Photographs against the surface of the others: a wrong pose is told, of dry and wet beds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from plane_survey import TILTED, PlaneBed, look, ring
from scipy.spatial.transform import Rotation

from fields.sweep.block import Block
from fields.sweep.maps import HeightMap
from fields.sweep.photo_consistency import photo_consistency

WRONG = 3


def turned(camera, degrees: float, axis: str):
    turn = Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
    return replace(camera, cam_from_local=turn @ camera.cam_from_local)


POSES = {
    "upside down": lambda camera: turned(camera, 180.0, "x"),
    "a quarter turn": lambda camera: turned(camera, 90.0, "z"),
    "beside its place": lambda camera: replace(camera, centre=np.add(camera.centre, (0.5, 0.3, 0.0))),
    "of another place": lambda camera: look((40.0, 0.0, 10.0), (40.0, 0.0, -2.0)),
}


@pytest.mark.parametrize("water", [TILTED, None], ids=["wet", "dry"])
@pytest.mark.parametrize("wrong", POSES)
def test_a_photograph_with_a_wrong_pose_does_not_show_the_bed_of_the_others(device, water, wrong):
    bed, cameras = PlaneBed(water, -2.0), ring(6)
    images = [bed.photograph(camera) for camera in cameras]
    maps = []
    for view in (0, 1, 2):
        height = bed.true_height(cameras[view]).astype(np.float32)
        ones = np.ones_like(height)
        maps.append(HeightMap(view, height, ones, np.full(height.shape, 4, np.uint8), 0.0 * ones))
    cameras[WRONG] = POSES[wrong](cameras[WRONG])
    found = photo_consistency(Block(device, cameras, images, water, -2.0), maps)
    right = [each.correlation for view, each in enumerate(found) if view != WRONG]
    # Noise-free photographs of one plane.
    assert min(right) > 0.9
    one = found[WRONG]
    assert one.num_points == 0 or one.correlation is None or one.correlation < 0.3


def test_without_maps_nothing_is_known(device):
    bed, cameras = PlaneBed(None, -2.0), ring(3)
    images = [bed.photograph(camera) for camera in cameras]
    assert all(each.correlation is None for each in photo_consistency(Block(device, cameras, images, None, -2.0), []))


def test_windows_give_as_many_points_as_their_share_of_the_photograph(device):
    bed, cameras = PlaneBed(None, -2.0), ring(6)
    images = [bed.photograph(camera) for camera in cameras]
    height = bed.true_height(cameras[0]).astype(np.float32)
    ones = np.ones_like(height)
    maps = [HeightMap(0, height, ones, np.full(height.shape, 4, np.uint8), 0.0 * ones)]
    block = Block(device, cameras, images, None, -2.0)
    larger = replace(cameras[0], width=2 * cameras[0].width, height=2 * cameras[0].height)
    # All photographs of the ring show the same place.
    (whole, *_), (window, *_) = (
        [each.num_points for each in photo_consistency(block, maps, of)[1:]] for of in (cameras[0], larger)
    )
    assert 0.0 < window < 0.35 * whole
