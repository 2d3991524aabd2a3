"""Agreement of height maps, and heights that others see through."""

from dataclasses import replace

import numpy as np
import pytest
from plane_survey import TILTED, PlaneBed, look, ring
from scipy.spatial.transform import Rotation

from fields.sweep import fusion
from fields.sweep.block import Block
from fields.sweep.fusion import num_comparable, remove_free_space_violations
from fields.sweep.kernels.arrays import run_job
from fields.sweep.kernels.stack import ViewStack
from fields.sweep.maps import HeightMap, height_std, trusted
from fields.sweep.photo_consistency import photo_consistency
from refract import FlatWater

OWN, TOLERANCE = -2.0, 0.05
# Heights of a few metres in float32; their mean is exact to a few roundings.
HEIGHT_M = 1e-6


def level_maps(device, heights, water=TILTED) -> ViewStack:
    """Height maps, each of one height over the water plane, of a ring of cameras."""
    cameras = ring(len(heights) - 1)
    shape = (cameras[0].height, cameras[0].width)
    return ViewStack.build(device, cameras, [np.full(shape, h, np.float32) for h in heights], water)


def agreement(stack: ViewStack, view: int, peers: list[int], tolerance: float):
    """What `fields.sweep.fusion.agreement` finds."""
    return run_job(stack.device, fusion.agreement(stack, view, peers, tolerance))


def seen_by(stack: ViewStack, peer: int, height: float = OWN) -> np.ndarray:
    """Which pixels (height, width) of view 0 a peer sees, by the exact projection; margins of 0.01 px are NaN."""
    cameras, water = stack.cameras, stack.water
    points = cameras[0].paths(cameras[0].pixel_centres(), water).at_height(height, water)
    uv = cameras[peer].project(points, water)
    margin = np.minimum(uv - 0.5, np.array([stack.width - 0.5, stack.height - 0.5]) - uv).min(axis=-1)
    return np.where(np.abs(margin) < 0.01, np.nan, margin > 0.0)


@pytest.mark.parametrize("water", [TILTED, None], ids=["wet", "dry"])
def test_equal_heights_agree_in_every_peer_that_sees_them(device, water):
    stack = level_maps(device, [OWN] * 4, water)
    agreeing, fused, spread = agreement(stack, 0, [1, 2, 3], TOLERANCE)
    expected = sum(seen_by(stack, peer) for peer in (1, 2, 3))
    clear = np.isfinite(expected)
    np.testing.assert_array_equal(agreeing[clear], expected[clear])
    assert (agreeing == 3).any()
    assert (agreeing < 3).any()
    assert agreeing.dtype == (np.uint8)
    np.testing.assert_array_equal(fused, np.float32(OWN))
    np.testing.assert_array_equal(spread, 0.0)


def test_the_mean_and_the_spread_are_those_of_the_heights_that_agree(device):
    offsets = [0.0, 0.03, -0.01, 0.5]
    stack = level_maps(device, [OWN + o for o in offsets])
    agreeing, fused, spread = agreement(stack, 0, [1, 2, 3], TOLERANCE)
    two = agreeing == 2
    assert two.mean() > 0.4
    assert agreeing.max() == 2  # the third stands half a metre off
    np.testing.assert_allclose(fused[two], OWN + np.mean(offsets[:3]), atol=HEIGHT_M)
    np.testing.assert_allclose(spread[two], np.std(offsets[:3]), atol=HEIGHT_M)
    only_first = (agreeing == 1) & (seen_by(stack, 1) == 1.0)
    assert only_first.any()
    np.testing.assert_allclose(fused[only_first], OWN + 0.015, atol=HEIGHT_M)
    np.testing.assert_allclose(spread[only_first], 0.015, atol=HEIGHT_M)


def test_a_height_that_is_not_there_confirms_nothing_and_is_confirmed_by_none(device):
    stack = level_maps(device, [OWN, np.nan, OWN])
    agreeing, fused, _ = agreement(stack, 0, [1, 2], TOLERANCE)
    clear = np.isfinite(seen_by(stack, 2))
    np.testing.assert_array_equal(agreeing[clear], seen_by(stack, 2)[clear])
    np.testing.assert_array_equal(fused, np.float32(OWN))
    agreeing, fused, _ = agreement(stack, 1, [0, 2], TOLERANCE)
    assert not agreeing.any()
    assert np.isnan(fused).all()


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


# Half a metre is a parallax of 10 px.
OVER_M = 0.5
PATCH = np.s_[30:42, 40:56]


def level_maps_space(water: FlatWater | None, agreeing: int = 4) -> tuple[list, list[HeightMap]]:
    """Cameras, and maps of a level bed that so many views confirm everywhere."""
    cameras = ring(5)
    shape = (cameras[0].height, cameras[0].width)
    level = np.full(shape, -2.0, dtype=np.float32)
    ones = np.ones(shape, dtype=np.float32)
    count = np.full(shape, agreeing, dtype=np.uint8)
    return cameras, [HeightMap(view, level.copy(), ones, count.copy(), 0.0 * ones) for view in range(len(cameras))]


def block_of(device, cameras, water=TILTED, holes: dict[int, tuple[slice, slice]] | None = None) -> Block:
    """The block, with a part of some photographs masked."""
    images = [np.zeros((camera.height, camera.width), dtype=np.float32) for camera in cameras]
    for view, hole in (holes or {}).items():
        images[view][hole] = np.nan
    return Block(device, cameras, images, water, -2.0)


@pytest.mark.parametrize("water", [TILTED, None], ids=["wet", "dry"])
def test_a_height_that_more_views_look_through_than_confirm_is_confirmed_by_none(device, water):
    cameras, maps = level_maps_space(water)
    maps[0].height[PATCH] += OVER_M
    maps[0].agreeing[PATCH] = 2
    found = remove_free_space_violations(block_of(device, cameras, water), maps)
    assert (found[0].agreeing[PATCH] == 0).all()
    beside = np.ones(maps[0].height.shape, dtype=bool)
    beside[PATCH] = False
    assert (found[0].agreeing[beside] == 4).all()
    assert all((m.agreeing == 4).all() for m in list(found)[1:])
    assert not trusted(found[0])[PATCH].any()


@pytest.mark.parametrize(
    ("off", "agreeing", "of_others", "score"),
    [(OVER_M, 6, 4, 1.0), (OVER_M, 2, 0, 0.5), (-OVER_M, 2, 4, 1.0)],
    ids=["a mast that more views confirm", "others that are not trusted", "under the bed it is hidden"],
)
def test_a_height_that_few_views_look_through_stays(device, off, agreeing, of_others, score):
    cameras, maps = level_maps_space(TILTED, of_others)
    maps = [replace(m, score=score * m.score) for m in maps]
    maps[0].height[PATCH] += off
    maps[0].agreeing[PATCH] = agreeing
    found = list(remove_free_space_violations(block_of(device, cameras), maps))
    assert (found[0].agreeing[PATCH] == agreeing).all()
    # The other views' bed on the rays of these pixels is looked through by one view at most.
    assert off > 0.0 or all((m.agreeing == 4).all() for m in found[1:])


def test_views_that_overlap_with_no_other_keep_their_maps(device):
    cameras, maps = level_maps_space(TILTED)
    found = remove_free_space_violations(block_of(device, cameras), maps[:1])
    assert found[0] is maps[0]


def test_photographs_that_are_masked_at_a_place_are_not_comparable_there(device):
    cameras, maps = level_maps_space(TILTED)
    assert list(num_comparable(block_of(device, cameras), maps)) == [None] * len(cameras)
    found = next(
        num_comparable(block_of(device, cameras, holes=dict.fromkeys(range(2, len(cameras)), np.s_[:, :])), maps)
    )
    assert found.shape == maps[0].height.shape
    assert set(np.unique(found)) == {0.0, 1.0, np.inf}
    # Where none of the photographs that show a place is masked there, all of them are comparable.
    found = next(num_comparable(block_of(device, cameras, holes={4: np.s_[:1, :1]}), maps))
    assert np.mean(np.isfinite(found)) < 0.01


def test_a_masked_pixel_changes_the_std_only_at_the_place_that_it_shows(device):
    cameras, maps = level_maps_space(TILTED)
    # One other photograph agrees in the patch; the others match nothing there, and are neither masked nor white.
    maps[0].agreeing[PATCH], maps[0].spread[:] = 1, 0.01
    maps = [*maps[:2], *(replace(m, score=0.0 * m.score) for m in maps[2:])]

    def std(holes: dict[int, tuple[slice, slice]]) -> np.ndarray:
        (found, *_) = num_comparable(block_of(device, cameras, holes=holes), maps)
        return height_std(maps[0].height, maps[0].agreeing, maps[0].spread, 0.03, found)

    corner = np.s_[:1, :1]
    whole, far = std({}), std({4: corner})
    assert (far[PATCH] == whole[PATCH]).all()
    assert np.mean(far != whole) < 0.05
    assert np.median(std(dict.fromkeys(range(2, len(cameras)), np.s_[:, :]))[PATCH] / whole[PATCH]) < 0.85
