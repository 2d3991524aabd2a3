"""Surveys whose photographs fall into blocks that share no points: each is placed by itself, and all are kept."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic_block import synthetic_block
from test_sfm_control import FRAME, PLACES, block_control

from geo.frames import Similarity
from survey.errors import PosesError
from survey.sfm import block as sfm_block
from survey.sfm.absolute_orientation import place_by_control, place_by_gps, views_of_block
from survey.sfm.control_fit import BlockControl
from survey.sfm.features import CameraBody
from survey.sfm.gps import GpsPositions
from survey.sfm.solve import FreeBlocks, without_shared_images

APART = (200.0, -30.0)


class Apart:
    """Two synthetic blocks, each in a frame of its own, with their true centres and control."""

    def __init__(self, rng: np.random.Generator):
        self.blocks, self.centres, self.controls = [], {}, []
        for first, at in ((0, (0.0, 0.0)), (18, APART)):
            block, centres = synthetic_block(rng, first=first, at=at, tilt_deg=8.0)
            control = block_control(views_of_block(block), places=PLACES + np.array([*at, 0.0]))
            self.controls.append(_named(control, f"at{first}"))
            turn = Rotation.random(rng=rng).as_matrix()
            sfm_block.transform(block, Similarity(rng.uniform(0.02, 3.0), turn, rng.normal(0.0, 20.0, 3)))
            self.blocks.append(block)
            self.centres |= centres
        self.sensors = [CameraBody(tuple(self.centres), (800, 600), 900.0)]
        self.free = FreeBlocks(tuple(self.blocks), ("some are left out",))

    def gps(self, rng: np.random.Generator, std: float, names=None) -> GpsPositions:
        """Positions of the photographs of these names."""
        heard = {name: self.centres[name] + std * rng.standard_normal(3) for name in names or self.centres}
        return GpsPositions(FRAME, heard, ())

    def worst(self, placed) -> float:
        """Largest distance of a camera from its true place [m]."""
        origin = np.array(placed.frame.origin) - FRAME.origin
        poses = {name: pose for block in placed.blocks for name, pose in sfm_block.poses_of(block).items()}
        return max(float(np.abs(centre + origin - self.centres[name]).max()) for name, (centre, _) in poses.items())


def _named(control: BlockControl, prefix: str) -> BlockControl:
    points = tuple(replace(point, name=f"{prefix} {point.name}") for point in control.points)
    marks = tuple(replace(mark, point=f"{prefix} {mark.point}") for mark in control.marks)
    return replace(control, points=points, marks=marks)


def _both(first: BlockControl, second: BlockControl) -> BlockControl:
    slack = np.concatenate([first.slack, second.slack])
    return BlockControl(FRAME, first.points + second.points, first.marks + second.marks, slack)


@pytest.mark.parametrize("seed", range(8))
def test_every_block_is_placed_by_its_own_positions(seed):
    rng = np.random.default_rng(seed)
    apart, std = Apart(rng), [0.0, 0.02, 0.3][seed % 3]
    placed = place_by_gps(apart.free, apart.gps(rng, std), apart.sensors)
    assert [block.num_reg_images() for block in placed.blocks] == [18, 18]
    # 18 positions tell the place of a block 20 m wide to half of their std, and its tilt to 1.3 of it at the border.
    assert apart.worst(placed) < 1e-6 + 5.0 * std
    assert any("fall into 2 blocks without common points, of 18 and 18 photographs" in note for note in placed.notes)


def test_every_block_is_placed_by_its_own_control(rng):
    apart = Apart(rng)
    control = _both(*apart.controls)
    placed = place_by_control(apart.free, control, apart.sensors)
    assert apart.worst(placed) < 1e-6
    assert [note.count("at18 gcp") for note in placed.notes][-1] == 6


def test_a_block_whose_positions_are_lost_is_placed_by_its_control(rng):
    apart = Apart(rng)
    gps = apart.gps(rng, 0.0, [name for name in apart.centres if name < "20"])
    args = (apart.free, gps, apart.sensors)
    placed = place_by_gps(*args, spare=apart.controls[1])
    assert len(placed.blocks) == 2
    assert apart.worst(placed) < 1e-6
    assert "GPS positions differ from it by about" in placed.notes[-2]
    assert "placed by control points alone (at18 gcp0" in placed.notes[-1]


@pytest.mark.parametrize("lost", [0, 1])
def test_a_block_that_nothing_places_is_left_out_by_name_whichever_it_is(rng, lost):
    apart = Apart(rng)
    known = [name for name in apart.centres if (name < "18") == (lost == 1)]
    placed = place_by_gps(apart.free, apart.gps(rng, 0.0, known), apart.sensors)
    assert [set(sfm_block.poses_of(block)) for block in placed.blocks] == [set(known)]
    assert apart.worst(placed) < 1e-6
    (note,) = [note for note in placed.notes if "form a separate block" in note]
    assert "0 of 18 solved images have GPS positions" in note
    assert f"left out: {sorted(set(apart.centres) - set(known))[0]}" in note


def test_a_block_that_neither_positions_nor_control_place_says_what_both_lack(rng):
    apart = Apart(rng)
    gps = apart.gps(rng, 0.0, ["00.jpg", "01.jpg"])
    control = apart.controls[0]
    two = replace(control, points=control.points[:2], slack=control.slack[:2])
    with pytest.raises(PosesError, match=r"2 of 18 solved images.*nor can control place it: 2 of 2 control"):
        place_by_gps(FreeBlocks(apart.free.blocks[:1], ()), gps, apart.sensors, spare=two)


def test_where_nothing_places_any_block_the_largest_says_why(rng):
    apart = Apart(rng)
    with pytest.raises(PosesError, match=r"2 of 18 solved images have GPS positions, .*some are left out"):
        place_by_gps(apart.free, apart.gps(rng, 0.0, ["00.jpg", "01.jpg"]), apart.sensors)


def test_all_images_of_a_sensor_have_one_lens(rng):
    apart = Apart(rng)
    sfm_block.camera_of(apart.blocks[1], "18.jpg").focal_length = 921.0
    placed = place_by_gps(apart.free, apart.gps(rng, 0.0), apart.sensors)
    lenses = {sfm_block.lens_of(block, name) for block in placed.blocks for name in sfm_block.poses_of(block)}
    assert len(lenses) == 1


def test_an_image_of_two_blocks_counts_for_the_larger(rng):
    (large, _), (small, _) = synthetic_block(rng), synthetic_block(rng, first=14)
    apart = without_shared_images([large, small])
    assert set(sfm_block.poses_of(apart[1])) == {f"{k}.jpg" for k in range(18, 32)}
    same, _ = synthetic_block(rng, first=2)
    # Two of its own are no block.
    assert len(without_shared_images([synthetic_block(rng)[0], same])) == 1
