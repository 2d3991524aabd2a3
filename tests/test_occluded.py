"""The bed beside and under edges, where photographs agree pixel by pixel."""

import cv2
import numpy as np
import pytest
from plane_survey import look

from fields.device import choose_device
from fields.occluded.agreement import FoundPoints, explained_above, trial_heights
from fields.occluded.holes import CONTEXT_GSD, SIDE_GSD, BedLayer, Holes, KnownBed, StepBox, boxes_about, smooth
from fields.occluded.occluded import find_occluded, show_bed
from fields.occluded.sightings import Colours, consensus
from fields.sweep.block import Block
from fields.sweep.maps import HeightMap
from refract import FlatWater, PinholeCamera

GSD = 0.02
WATER = FlatWater((0.0, 0.0, 0.0), n_water=1.34)
# Local z of the bed and of a plate over it, half of the side of the plate, and its middle, which is that of a box [m].
BED, PLATE, HALF = -2.0, -1.4, 0.35
MIDDLE = np.array([1.0, 1.0])
# By so many pixels the windows of the sweep make the plate larger.
FATTER_PX = 5


def test_a_thin_plate_carries_a_plane_on():
    x, y = np.meshgrid(np.arange(12.0), np.arange(9.0))
    plane, known = 0.3 * x - 0.1 * y + 2.0, x < 6.0
    np.testing.assert_allclose(smooth(np.where(known, plane, np.nan), known, 5.0), plane, atol=1e-8)


def test_the_layer_is_the_bed_below_what_stands_over_it():
    rng = np.random.default_rng(0)
    xy = rng.uniform(-1.0, 3.0, (60_000, 2))
    over = (np.abs(xy - 1.0) < 0.4).all(axis=1)
    bed = -2.0 + 0.1 * xy[:, 0]
    z = np.where(over, -1.2, bed) + rng.normal(0.0, 0.003, len(xy))
    layer = BedLayer.of(StepBox(0.0, 0.0, GSD), np.column_stack([xy, z]))
    x, y = np.meshgrid(np.linspace(0.7, 1.3, 7), np.linspace(0.7, 1.3, 7))
    # Of 3 mm of noise in each point: the lowest of a cell lie lower, by three times that at most.
    np.testing.assert_allclose(layer.at(x, y), -2.0 + 0.1 * x, atol=0.009)


def test_the_layer_ends_far_from_the_bed():
    xy = np.random.default_rng(0).uniform((-1.6, -1.6), (0.5, 3.6), (20_000, 2))
    layer = BedLayer.of(StepBox(0.0, 0.0, GSD), np.column_stack([xy, np.full(len(xy), -2.0)]))
    assert np.isfinite(layer.at(np.array([0.4]), np.array([0.4]))).all()
    assert np.isnan(layer.at(np.array([1.6]), np.array([0.4]))).all()


@pytest.mark.parametrize("depth_gsd", [5.0, 8.0])
@pytest.mark.parametrize("half_gsd", [3, 8])
def test_where_the_bed_is_lower_than_the_layer_is_no_hole(half_gsd, depth_gsd):
    x, y = (each.ravel() * GSD for each in np.meshgrid(np.arange(-30, 130), np.arange(-30, 130)))
    pit = (np.abs(x / GSD - 50) < half_gsd) & (np.abs(y / GSD - 50) < half_gsd)
    cloud = np.column_stack([x, y, np.where(pit, -depth_gsd * GSD, 0.0)])
    box = StepBox(0.0, 0.0, GSD)
    middle = np.array([50 * GSD])
    assert BedLayer.of(box, cloud).at(middle, middle) == pytest.approx(0.0, abs=0.5 * GSD)
    assert Holes.of(box, KnownBed(cloud, GSD)) is None
    assert Holes.of(box, KnownBed(cloud[~pit], GSD)) is not None


@pytest.mark.parametrize("origin", [(0.0, 0.0), (-800.0, 300.0)])
def test_points_about_a_box_are_those_within_its_surroundings(rng, origin):
    cloud = np.column_stack([rng.uniform(0.0, 700.0 * GSD, (20_000, 2)) + origin, rng.normal(size=20_000)])
    known = KnownBed(cloud, GSD)
    corners = np.floor(cloud[:200, :2] / (SIDE_GSD * GSD)) * SIDE_GSD * GSD
    for x, y in [*corners.tolist(), (origin[0] - 1e4 * SIDE_GSD * GSD, 0.0)]:
        box = StepBox(x, y, GSD)
        np.testing.assert_array_equal(known.about(box), cloud[box.around(cloud, CONTEXT_GSD)])


def test_boxes_are_where_enough_steps_are():
    places = np.concatenate([np.full((40, 2), 0.5), np.full((3, 2), 9.0)])
    for parts in ([places, np.empty((0, 2))], [places[:20], places[20:]]):
        assert boxes_about(parts, GSD) == [StepBox(0.0, 0.0, GSD)]
    assert boxes_about([], GSD) == []


def test_those_photographs_agree_that_show_the_same():
    rng = np.random.default_rng(1)
    texture = rng.uniform(60.0, 200.0, (24, 24, 3))
    values = np.stack([texture] * 3 + [rng.uniform(60.0, 200.0, (24, 24, 3)) for _ in range(3)])
    values = (values + rng.normal(0.0, 2.0, values.shape)).astype(np.float32)
    found = consensus(Colours(values, np.ones((6, 24, 24), dtype=bool), np.full(3, 2.0)))
    assert (found[:3].mean(axis=(1, 2)) > 0.8).all()
    assert found[3:].mean() < 0.01


@pytest.mark.parametrize("height", [0.0, 10.0])
def test_what_other_photographs_see_over_the_layer_explains_those_that_agree_on_it(height):
    rng = np.random.default_rng(3)
    texture = rng.uniform(60.0, 200.0, (64, 64, 3)).astype(np.float32)
    # Three photographs that look along each other, and four from the sides, for which the layer itself is hidden.
    slopes = np.array([(0, 0)] * 3 + [(1, 0), (-1, 0), (0, 1), (0, -1)], dtype=float)
    hidden = [rng.uniform(60.0, 200.0, texture.shape).astype(np.float32) for _ in slopes]

    def colours(at: float) -> Colours:
        shifts = [(slope[::-1] * (at - height)).astype(int) for slope in slopes]
        values = [np.roll(texture, tuple(shift), axis=(0, 1)) for shift in shifts]
        if height == 0.0:
            values[3:] = hidden[3:]
        return Colours(np.stack(values), np.ones((7, 64, 64), dtype=bool), np.full(3, 2.0))

    members = np.zeros((7, 64, 64), dtype=bool)
    members[:3] = True
    explained = explained_above(slopes, colours(0.0), [colours(each) for each in trial_heights(1.0)], members, 1.0)
    assert explained.mean() == (1.0 if height else 0.0)


@pytest.fixture(scope="module")
def plate() -> tuple[Block, list[HeightMap], list[np.ndarray], np.ndarray]:
    """A level bed with a plate over it, seen by eight cameras: block, maps with a fat plate, photographs, cloud."""
    rng = np.random.default_rng(2)
    cameras = [_camera(angle) for angle in np.arange(8) * np.pi / 4.0]
    textures = [cv2.GaussianBlur(rng.uniform(0.0, 255.0, (700, 700, 3)), (0, 0), 1.0) for _ in range(2)]
    photographs, maps, clouds = [], [], []
    for number, camera in enumerate(cameras):
        photograph, height, fat, cloud = _seen(camera, textures, rng)
        photographs.append(photograph)
        maps.append(_map(number, height, fat))
        clouds.append(cloud)
    grey = [cv2.cvtColor(each, cv2.COLOR_RGB2GRAY).astype(np.float32) for each in photographs]
    block = Block(choose_device("cpu"), cameras, grey, WATER, BED)
    return block, maps, photographs, np.concatenate(clouds)


def _camera(angle: float) -> PinholeCamera:
    """A camera 8 m aside and 20 m over the water that looks at the plate, upright."""
    aside = np.array([np.cos(angle), np.sin(angle)])
    heading = np.arctan2(*-aside)
    return look((*MIDDLE + 8.0 * aside, 20.0), (*MIDDLE, -1.0), focal=1100.0, size=(240, 200), heading=heading)


def _seen(camera, textures, rng):
    """Photograph, heights as a sweep has them, where these are the plate's beside it, and points away from the edge."""
    path = camera.paths(camera.pixel_centres().reshape(-1, 2), WATER)
    on_plate, on_bed = (path.at_height(np.full(camera.width * camera.height, z), WATER) for z in (PLATE, BED))
    shape = camera.height, camera.width
    hits = (np.abs(on_plate[:, :2] - MIDDLE) < HALF).all(axis=1).reshape(shape)
    colours = [
        cv2.remap(t, *(100.0 * each[:, k].reshape(shape).astype(np.float32) + 250.0 for k in (0, 1)), cv2.INTER_LINEAR)
        for t, each in zip(textures, (on_bed, on_plate), strict=True)
    ]
    photograph = np.where(hits[..., None], colours[1], colours[0]) + rng.normal(0.0, 1.5, (*shape, 3))
    fat = cv2.dilate(hits.astype(np.uint8), np.ones((2 * FATTER_PX + 1,) * 2, np.uint8)) > 0
    cloud = np.concatenate([on_plate[(hits & fat).ravel()], on_bed[~fat.ravel()]])
    near = (np.abs(cloud[:, :2] - MIDDLE) < HALF + 0.1).all(axis=1)
    # The cloud has no bed near the plate.
    cloud = cloud[~near | (cloud[:, 2] > -1.7)]
    return (
        np.clip(photograph, 0.0, 255.0).astype(np.uint8),
        np.where(fat, PLATE, BED).astype(np.float32),
        fat & ~hits,
        cloud,
    )


def _map(view: int, height: np.ndarray, fat: np.ndarray) -> HeightMap:
    same = np.ones(height.shape)
    agreeing = np.where(fat, 2, 5).astype(np.uint8)
    return HeightMap(view, height, same.astype(np.float16), agreeing, (0 * same).astype(np.float16))


def test_the_bed_beside_and_under_an_edge_is_found_where_it_is_seen(plate):
    block, maps, photographs, cloud = plate
    found = find_occluded(block, maps, photographs.__getitem__, KnownBed(cloud, GSD))
    xyz = found.points.xyz
    aside = np.abs(xyz[:, :2] - MIDDLE)
    assert len(xyz) > 300
    np.testing.assert_allclose(xyz[:, 2], BED, atol=0.04)
    assert (aside < HALF + 0.15).all()
    assert (aside < HALF).all(axis=1).sum() > 50
    # Below the middle of the plate, which no camera sees, there is nothing.
    hidden = HALF - 0.6 * np.tan(np.arcsin(np.sin(np.arctan(8.0 / 20.0)) / 1.34)) * np.sqrt(2.0)
    assert not (aside < hidden - 0.05).all(axis=1).any()
    assert (found.points.origin == 1).all()
    assert (found.points.num_views >= 3).all()
    assert found.points.wet.all()


def test_nothing_is_looked_for_on_a_bed_without_steps(plate):
    block, maps, photographs, cloud = plate
    level = [_map(m.view, np.full_like(m.height, BED), np.zeros(m.height.shape, bool)) for m in maps]
    assert find_occluded(block, level, photographs.__getitem__, KnownBed(cloud, GSD)).num_boxes == 0


@pytest.mark.parametrize(("num", "shows"), [(0, False), (20, False), (40, True)])
def test_a_few_points_in_large_holes_show_no_bed(num, shows):
    cells = np.ones((25, 40), dtype=bool)
    holes = Holes(np.zeros((25, 40, 3)), cells, 0.1, 0.01)
    each = np.zeros(num)
    points = FoundPoints(np.zeros((num, 3)), np.zeros((num, 3), np.uint8), each, each, each, each)
    assert show_bed([holes], [points]) == shows
