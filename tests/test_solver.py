"""The solver against closed forms and drawn beds; which heights of the sweep it keeps."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
from plane_survey import TILTED, ring
from scipy import ndimage
from slow_cases import slow
from solved_tiles import level, nowhere, plain_tile, residuals, white

from fields.device import choose_device
from fields.image_store import GreyImages
from fields.solver import solver
from fields.solver.gauss_newton import Start, TileSolution, second_differences_of, stiffness_of
from fields.solver.moving_water import bed_of, still_photograph, with_waves, without_waves
from fields.solver.noise import NoiseShares
from fields.solver.roughness import roughness_of
from fields.solver.tile import SolverTile, appearance_of, brightness_of, log_likelihood_ratio, tiles_of
from fields.solver.uncertainty import expected_variances
from fields.solver.views import Views
from fields.solver.visibility import DisplacementImage, Occluder, Projector, lookup, lookup_window, project_tiles
from fields.sweep.block import Block
from fields.sweep.maps import HeightMap
from fields.waves.waves import Waves
from refract import FlatWater, PinholeCamera
from refract.curved import WavyWater
from refract.distortion import Distortion

WATER = FlatWater((0.0, 0.0, 0.0), n_water=1.33)
SIZE, FOCAL, FLYING, DEPTH = 80, 160.0, 8.0, 2.0
GSD = (FLYING + DEPTH) / FOCAL
CELL = 0.25 * GSD


def camera(x: float, y: float) -> PinholeCamera:
    return PinholeCamera([x, y, FLYING], np.diag([1.0, -1.0, -1.0]), FOCAL, FOCAL, SIZE / 2, SIZE / 2, SIZE, SIZE)


class Bed:
    """A bed on a slope, with long waves, painted at random; drawn by following rays through the water."""

    def __init__(self, slope: float, seed: int = 3):
        random = np.random.default_rng(seed)
        self.slope = slope
        shape = (700, 700)
        paint = ndimage.gaussian_filter(random.standard_normal(shape), 2.0, mode="wrap")
        self.paint = ndimage.spline_filter(25.0 * paint / paint.std(), order=3, mode="grid-wrap")

    def height(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return -DEPTH + self.slope * x + 0.03 * np.sin(2.0 * x + 1.0) * np.cos(1.7 * y)

    def heights_seen(self, seen_by: PinholeCamera) -> np.ndarray:
        path = seen_by.paths(seen_by.pixel_centres(), WATER)
        height = np.full((SIZE, SIZE), -DEPTH)
        for _ in range(30):
            point = path.at_height(height, WATER)
            height = self.height(point[..., 0], point[..., 1])
        return height

    def points_through(self, seen_by: PinholeCamera, waves: WavyWater) -> np.ndarray:
        path = seen_by.paths(seen_by.pixel_centres(), waves)
        along = np.full((SIZE, SIZE), DEPTH)
        for _ in range(30):
            point = path.crossing + along[..., None] * path.water_direction
            along = along + (self.height(point[..., 0], point[..., 1]) - point[..., 2]) / path.water_direction[..., 2]
        return point

    def photograph(
        self, seen_by: PinholeCamera, gain: float, offset: float, waves: WavyWater | None = None
    ) -> np.ndarray:
        point = seen_by.paths(seen_by.pixel_centres(), WATER).at_height(self.heights_seen(seen_by), WATER)
        if waves is not None:
            point = self.points_through(seen_by, waves)
        at = [350.0 + point[..., 1] / CELL, 350.0 + point[..., 0] / CELL]
        grey = ndimage.map_coordinates(self.paint, at, order=3, mode="grid-wrap", prefilter=False)
        return (gain * grey + offset).astype(np.float32)


def moving_water(amplitude: float, moment: float) -> WavyWater:
    """Two trains of waves, whose heights have a standard deviation of an amplitude [m] together."""
    lengths, toward = np.array([3.1, 2.2]), np.array([0.4, 1.9])
    number = 2.0 * np.pi / lengths
    vectors = np.stack([number * np.cos(toward), number * np.sin(toward)], axis=-1)
    return WavyWater(
        (0.0, 0.0, 0.0), [amplitude, amplitude], vectors, 2.4 * moment * np.sqrt(9.81 * number), n_water=1.33
    )


@cache
def survey(
    noise: float, slope: float, wrong_gsd: float = 0.6, amplitude: float = 0.0
) -> tuple[Block, list[HeightMap], np.ndarray]:
    """A block of nine views, its maps with heights that are wrong by so much, and the true heights in the first."""
    random = np.random.default_rng(5)
    bed = Bed(slope)
    cameras = [camera(x, y) for x, y in [(0.0, 0.0), *((x, y) for x in (-1.6, 0.0, 1.6) for y in (-1.6, 0.0, 1.6))][:9]]
    cameras[5] = camera(1.1, -0.4)
    seas = [moving_water(amplitude, view) if amplitude else None for view in range(len(cameras))]
    images = [
        bed.photograph(c, random.uniform(0.8, 1.2), random.uniform(-5.0, 5.0), sea)
        for c, sea in zip(cameras, seas, strict=True)
    ]
    images = [image + (noise * random.standard_normal(image.shape)).astype(np.float32) for image in images]
    block = Block(choose_device("torch"), cameras, images, WATER, -DEPTH)
    block.set_overlap_height(-DEPTH)
    maps = []
    for view, seen_by in enumerate(cameras):
        truth = bed.heights_seen(seen_by)
        wrong = ndimage.gaussian_filter(random.standard_normal(truth.shape), 2.0)
        height = (truth + wrong_gsd * GSD * wrong / wrong.std()).astype(np.float32)
        whole = np.ones(truth.shape)
        maps.append(HeightMap(view, height, whole, np.full(truth.shape, 5, np.uint8), 0.0 * height))
    return block, maps, bed.heights_seen(cameras[0])


def middle(margin: int = 14) -> np.ndarray:
    wanted = np.zeros((SIZE, SIZE), dtype=bool)
    wanted[margin:-margin, margin:-margin] = True
    return wanted


def learned(block, maps, kept) -> solver.SolverFigures:
    """What a sample of the kept pixels of a block tells of its survey."""
    views = Views.of(block, maps)
    places = solver.spread(solver.count_in_squares(views.others, kept))
    return solver.figures_of(solver.solve_sample(views, kept, places, GSD), GSD, is_wet=block.water is not None)


def solved(
    noise: float, slope: float, wrong_gsd: float = 0.6
) -> tuple[np.ndarray, np.ndarray, np.ndarray, solver.SolverFigures]:
    """Errors of the sweep and of the solver in the first map, the std, and what was learned."""
    block, maps, truth = survey(noise, slope, wrong_gsd)
    kept = [middle() if m.view == 0 else np.zeros((SIZE, SIZE), dtype=bool) for m in maps]
    figures = learned(block, maps, kept)
    found, _, _ = solver.solve_maps(Views.of(block, maps), kept, figures, GSD, lambda share: None)
    start = (maps[0].height - truth).flat[found[0].pixels]
    return start, found[0].height - truth.flat[found[0].pixels], found[0].std, figures


def errors_in_waves(amplitude: float) -> tuple[np.ndarray, np.ndarray, Waves | None]:
    """Errors of the solver in the first map, their std, and the surfaces."""
    block, maps, truth = survey(1.0, 0.1, 0.6, amplitude)
    kept = [middle(6) if m.view == 0 else np.zeros((SIZE, SIZE), dtype=bool) for m in maps]
    found, _, waves = solver.solve_maps(
        Views.of(block, maps), kept, learned(block, maps, kept), GSD, lambda share: None
    )
    return found[0].height - truth.flat[found[0].pixels], found[0].std, waves


def test_waves_are_found_together_with_the_bed(monkeypatch):
    error, std, waves = errors_in_waves(0.015)
    assert waves is not None
    monkeypatch.setattr("fields.solver.solver.MOVING_PX", np.inf)
    without, _, still = errors_in_waves(0.015)
    assert still is None
    assert error.std() < 0.6 * without.std()
    assert np.mean(np.abs(error) < 1.96 * std) > 0.88


def test_still_water_is_solved_as_if_there_were_no_waves(monkeypatch):
    error, std, waves = errors_in_waves(0.0)
    assert waves is None
    monkeypatch.setattr("fields.solver.solver.MOVING_PX", np.inf)
    same, same_std, _ = errors_in_waves(0.0)
    assert np.array_equal(error, same)
    assert np.array_equal(std, same_std)


def over_still_water(amplitude: float) -> Block | None:
    """Photographs through waves as they would be over still water."""
    return still_block(*survey(1.0, 0.1, 0.6, amplitude)[:2])


def still_block(block: Block, maps: list[HeightMap]) -> Block | None:
    """A block as it would be over still water."""
    kept = [middle(6) if m.view == 0 else np.zeros(m.height.shape, dtype=bool) for m in maps]
    views = Views.of(block, maps)
    sample = solver.sampled(views, kept, solver.spread(solver.count_in_squares(views.others, kept)))
    found = without_waves(block, views, kept, sample, GSD)
    return None if found is None else found[0]


def test_rough_water_is_taken_out_of_photographs(monkeypatch):
    monkeypatch.setattr("fields.solver.moving_water.ROUGH_PX", 0.2)
    rough, found, still = survey(1.0, 0.1, 0.6, 0.05)[0], over_still_water(0.05), survey(1.0, 0.1)[0]
    assert found is not None
    for view in range(len(still.images)):
        before, after = (np.std((each.images[view] - still.images[view])[20:-20, 20:-20]) for each in (rough, found))
        # What waves of nine photographs have in common stays, a third of them, and what pixels do not resolve.
        assert after < 0.8 * before


def test_rough_water_is_taken_out_of_windows_of_photographs(monkeypatch):
    monkeypatch.setattr("fields.solver.moving_water.ROUGH_PX", 0.2)
    whole, maps, _ = survey(1.0, 0.1, 0.6, 0.05)
    rows = SIZE - 20
    cameras = [*whole.cameras[:-1], whole.cameras[-1].cropped(0, 0, rows, SIZE)]
    *others, last = whole.images
    images = GreyImages([*others, last[:rows]], of_one_size=False)
    cut = {name: getattr(maps[-1], name)[:rows] for name in ("height", "score", "agreeing", "spread")}
    found = still_block(Block(whole.device, cameras, images, WATER, -DEPTH), [*maps[:-1], replace(maps[-1], **cut)])
    assert found is not None
    assert [image.shape for image in found.images] == [image.shape for image in images]


def test_a_photograph_through_a_known_surface_is_as_over_still_water():
    count, spacing, turns = 64, 0.25, np.array([[5, 2], [-2, 7]])
    corner, vectors = np.full(2, -0.5 * count * spacing), 2.0 * np.pi * turns / (count * spacing)
    sea, bed = WavyWater((*corner, 0.0), [0.02, 0.01], vectors, n_water=1.33), Bed(0.1)
    # So that pixels resolve it.
    bed.paint = 20.0 * ndimage.gaussian_filter(bed.paint, 6.0, mode="wrap")
    block, maps, _ = survey(1.0, 0.1, 0.0)
    through = [bed.photograph(camera, 1.0, 0.0, sea) for camera in block.cameras]
    views = Views.of(block.with_images(GreyImages(through)), maps)
    nodes = spacing * np.arange(count) + corner[0]
    values = ndimage.spline_filter(sea.height(*np.meshgrid(nodes, nodes, indexing="ij")), order=3, mode="grid-wrap")
    of_all = np.tile(values.astype(np.float32), (len(through), 1, 1))
    optics = Waves.still(*views.projector.optics)
    corners = np.tile(corner, (len(through), 1))
    waves = replace(optics, corner=corners, spacing=spacing, coefficients=of_all)
    points = bed_of(views, [np.ones((SIZE, SIZE), dtype=bool)] * len(maps))
    for view in (0, 3):
        still = bed.photograph(block.cameras[view], 1.0, 0.0)
        left = still_photograph(views, waves, view, points) - still
        assert np.nanstd(left) < 0.2 * np.std(through[view] - still)


def test_waves_are_found_at_half_size_first_where_a_linear_step_reaches_twice_as_far(monkeypatch):
    block, maps, _ = survey(1.0, 0.1, 0.0)
    aside = [np.roll(image, 3 * (view == 3), axis=1) for view, image in enumerate(block.images)]
    kept = [middle(6) if m.view == 0 else np.zeros(m.height.shape, dtype=bool) for m in maps]
    spacings, found_px = [], []

    def waves_of(parts, still, spacing, _before, *, is_last):
        moved = np.concatenate([part.measured[part.view == 3] for part in parts])
        spacings.append(spacing / GSD)
        found_px.append(np.median(np.hypot(*moved.T)) / GSD)
        return still

    monkeypatch.setattr("fields.solver.moving_water.waves_of", waves_of)
    monkeypatch.setattr("fields.solver.moving_water.MOST_ROUNDS", 1)
    views = Views.of(block.with_images(GreyImages(aside)), maps)
    with ThreadPoolExecutor(1) as pool:
        with_waves(views, kept, GSD, pool)
    np.testing.assert_allclose(spacings, [16.0, 8.0])
    assert abs(found_px[0] - 3.0) < 0.4
    assert abs(found_px[1] - 3.0) > 0.8


def test_photographs_of_smooth_water_are_swept_as_they_are():
    assert over_still_water(0.0) is None
    assert over_still_water(0.005) is None


def test_ground_that_is_dry_has_no_waves():
    block, maps, _ = survey(1.0, 0.1, 0.6, 0.015)
    dry = Block(block.device, block.cameras, block.images, None, -DEPTH)
    kept = [middle(6) if m.view == 0 else np.zeros((SIZE, SIZE), dtype=bool) for m in maps]
    assert learned(dry, maps, kept).moved_px == 0.0


@pytest.mark.parametrize("slope", [slow(0.0), 0.5])
def test_errors_of_the_start_vanish_without_noise_and_slopes_are_kept(slope):
    start, error, _, _ = solved(0.3, slope)
    assert start.std() > 0.5 * GSD
    assert error.std() < 0.15 * GSD
    assert abs(error.mean()) < 0.05 * GSD


def test_the_error_is_what_the_standard_deviation_says():
    _, error, std, _ = solved(4.0, 0.2)
    assert np.mean(np.abs(error) < 1.96 * std) > 0.9
    # Measured 0.94; 2,700 neighbouring errors are worth some fifty.
    assert 0.7 < np.sqrt(np.mean(error**2) / np.mean(std**2)) < 1.2


@pytest.mark.slow
def test_more_noise_gives_larger_standard_deviations():
    quiet, noisy = (np.median(solved(noise, 0.2, 0.1)[2]) for noise in (0.5, 16.0))
    assert noisy > 1.2 * quiet


def test_pixels_that_look_along_a_wall_keep_the_heights_of_the_sweep():
    block, maps, _ = survey(0.3, 0.0)
    height = maps[0].height.copy()
    height[:, SIZE // 2 :] += 20.0 * GSD
    maps = [replace(maps[0], height=height), *maps[1:]]
    kept = [middle() if m.view == 0 else np.zeros((SIZE, SIZE), dtype=bool) for m in maps]
    found, _, _ = solver.solve_maps(Views.of(block, maps), kept, learned(block, maps, kept), GSD, lambda share: None)
    columns = np.arange(14, SIZE - 14)
    beside = (columns == SIZE // 2 - 1) | (columns == SIZE // 2)
    np.testing.assert_array_equal(np.unique(found[0].pixels % SIZE), columns[~beside])


def test_planes_have_no_bends_however_steep():
    tile = plain_tile(9)
    rows, columns = tile.places
    differences = second_differences_of(tile)
    np.testing.assert_allclose(
        differences.matrix @ (3.0 * rows - 7.0 * columns + 2.0).astype(np.float32), 0.0, atol=1e-4
    )
    assert np.abs(differences.matrix @ (rows == 4).astype(np.float32)).max() == 2.0


@pytest.mark.parametrize("shape", [(5, 7), (1, 7), (7, 1), (2, 2), (1, 1)])
def test_diagonals_of_the_normal_matrix_are_those_of_the_second_differences(shape):
    inside = np.ones(shape, dtype=bool)
    inside[1:2, 2:4] = inside[4:5, 0] = False
    differences = second_differences_of(SolverTile(0, 0, inside, np.ones(inside.sum(), dtype=bool)))
    random, matrix = np.random.default_rng(5), differences.matrix.toarray()
    stiffness = random.uniform(1.0, 2.0, len(matrix)).astype(np.float32)
    information = random.uniform(1.0, 2.0, inside.size).astype(np.float32)
    expected = np.diag(information)
    expected[np.ix_(inside.ravel(), inside.ravel())] += matrix.T @ (stiffness[:, None] * matrix)
    found = differences.normal_matrix(information, stiffness).toarray()
    np.testing.assert_allclose(found, expected, atol=1e-4)
    height = random.standard_normal(len(matrix.T)).astype(np.float32)
    known = information[inside.ravel()]
    right = known * height + differences.gradient(stiffness, height)
    np.testing.assert_allclose(differences.solve(known - 1e-2, stiffness, right, 1e-6), height, atol=1e-4)


def test_a_step_pulls_less_than_a_bend_of_the_roughness():
    differences = np.array([0.01, 1.0], dtype=np.float32)
    gradient = stiffness_of(differences, 0.01) * differences
    assert gradient[1] < 0.05 * gradient[0]


def test_gain_and_offset_are_found_again():
    tile, random = plain_tile(48), np.random.default_rng(1)
    albedo = 20.0 * random.standard_normal(len(tile)).astype(np.float32)
    gain, offset = np.array([1.0, 0.8, 1.3]), np.array([0.0, 7.0, -4.0])
    grey = (gain[:, None] * albedo + offset[:, None]).astype(np.float32)
    grey[2, :30] = np.nan
    appearance = appearance_of(tile, grey)
    np.testing.assert_allclose(appearance.gain, gain, atol=0.02)
    np.testing.assert_allclose(appearance.albedo(grey)[:, 30:], np.broadcast_to(albedo[30:], (3, 2274)), atol=2.0)
    assert np.isnan(appearance.albedo(grey)[2, :30]).all()


def test_the_noise_of_each_photograph_is_measured_and_outliers_lose_their_weight():
    random = np.random.default_rng(2)
    noise = np.array([1.0, 2.0, 4.0, 8.0, 2.0, 2.0, 2.0, 2.0])
    values = (noise[:, None] * random.standard_normal((8, 20_000))).astype(np.float32)
    values[1, :500] += 60.0
    found = brightness_of(values)
    np.testing.assert_allclose(found.noise[3:], noise[3:], rtol=0.15)
    assert found.weight[1, :500].mean() < 0.05 * found.weight[1, 500:].mean()
    np.testing.assert_allclose(found.minus_albedo(np.ones_like(values)), 0.0, atol=1e-5)


def drawn(roughness: float, views: int = 12) -> tuple[SolverTile, TileSolution]:
    """A tile whose photographs say, with noise, heights that bend as much as asked for, about level ones."""
    random, tile = np.random.default_rng(4), plain_tile(96)
    differences = second_differences_of(tile)
    height = ndimage.gaussian_filter(random.standard_normal((96, 96)), 1.5).ravel()
    height *= roughness / np.median(np.abs(differences.matrix @ height))
    slope = (50.0 * random.standard_normal((views, len(tile)))).astype(np.float32)
    brightness = brightness_of(random.standard_normal((views, len(tile))).astype(np.float32))
    slope = brightness.minus_albedo(slope)
    residual = brightness.minus_albedo(brightness.residual - slope * height.astype(np.float32))
    brightness = replace(brightness, residual=residual)
    information = np.einsum("kn,kn,kn->n", brightness.weight, slope, slope)
    zero = np.zeros(len(tile), dtype=np.float32)
    motion = 10.0 * random.standard_normal((views, 2, 1)).astype(np.float32) * np.ones((1, 1, len(tile)), np.float32)
    stiffness = stiffness_of(differences.matrix @ zero, 0.01)
    return tile, TileSolution(
        zero,
        information,
        stiffness,
        differences,
        brightness,
        slope,
        motion,
        1.0,
        Start(zero, zero),
        zero,
        nowhere(tile),
    )


def test_a_rougher_bed_is_learned_to_be_rougher():
    with ThreadPoolExecutor(1) as pool:
        smooth, rough = (roughness_of([drawn(bend)], 0.02, pool) for bend in (0.0005, 0.02))
    assert smooth < 0.4 * rough


def test_tiles_hold_every_wanted_pixel_once():
    wanted = np.random.default_rng(0).random((50, 70)) < 0.2
    count = np.zeros(wanted.shape, dtype=int)
    for tile in tiles_of(wanted, np.ones_like(wanted), side=16):
        rows, columns = tile.places
        count[rows[tile.requested] + tile.row, columns[tile.requested] + tile.column] += 1
    np.testing.assert_array_equal(count, wanted)


def test_a_map_takes_solved_heights_and_keeps_the_others():
    level = np.zeros((4, 5), dtype=np.float32)
    height_map = HeightMap(0, level, level, level.astype(np.uint8), level)
    refined, std = solver.SolvedMap(np.array([7]), np.array([-1.5]), np.array([0.01])).over(height_map)
    assert refined.height[1, 2] == -1.5
    assert np.count_nonzero(refined.height) == 1
    assert np.isfinite(std).sum() == 1


def test_nothing_kept_is_nothing_solved():
    block, maps, _ = survey(4.0, 0.2)
    nothing = [np.zeros((SIZE, SIZE), dtype=bool)] * 9
    assert solver.count_in_squares([(1,)] * 9, nothing) == [[]] * 9
    found, visibility, _ = solver.solve_maps(Views.of(block, maps), nothing, None, GSD, lambda share: None)
    assert [len(each.pixels) for each in found] == [0] * 9
    assert not visibility.any()


def test_a_position_outside_an_image_takes_no_value_from_those_beside_it(rng):
    image = rng.normal(size=(40, 60)).astype(np.float32)
    x, y = (rng.uniform(3.0, size - 3.0, 101).astype(np.float32) for size in (60, 40))
    x[[20, 50]] = -50.0, np.nan
    for way in (cv2.INTER_CUBIC, cv2.INTER_LINEAR):
        np.testing.assert_array_equal(np.flatnonzero(np.isnan(lookup(image, x, y, way))), [20, 50])


def test_a_lookup_in_the_part_of_an_image_that_it_needs_gives_the_same_bits(rng):
    image = rng.normal(size=(300, 400)).astype(np.float32)
    x, y = (rng.uniform(100.0, 150.0, 999).astype(np.float32) for _ in range(2))
    rows, columns = lookup_window(x, y)
    assert image[rows, columns].size < 0.1 * image.size
    for way in (cv2.INTER_CUBIC, cv2.INTER_LINEAR):
        part = lookup(image[rows, columns], x - columns.start, y - rows.start, way)
        np.testing.assert_array_equal(part, lookup(image, x, y, way))


def test_tiles_seen_together_are_seen_as_each_alone(device):
    """Also where only some of them are in another photograph."""
    cameras = {0: camera(0.0, 0.0), 1: camera(0.4 * SIZE * GSD, 0.0), 2: camera(0.0, 0.3)}
    heights = np.full((SIZE, SIZE), -DEPTH, dtype=np.float32) + np.linspace(0.0, 0.1, SIZE, dtype=np.float32)
    occluder = dict.fromkeys(cameras, Occluder(heights, heights < -1.95)).get
    wanted = np.random.default_rng(4).random((SIZE, SIZE)) < 0.7
    tiles = list(tiles_of(wanted, np.ones_like(wanted), 30))
    projector = Projector(device, cameras, WATER)
    together = project_tiles(tiles, (0, 1, 2), occluder, projector, 0.01)
    assert {tuple(projected.views) for projected in together} == {(0, 2), (0, 1, 2)}
    for tile, projected in zip(tiles, together, strict=True):
        (alone,) = project_tiles([tile], (0, 1, 2), occluder, projector, 0.01)
        assert alone.views == projected.views
        for name in ("position", "rise", "motion", "seen"):
            np.testing.assert_array_equal(getattr(alone, name), getattr(projected, name))


def test_displacements_over_an_image_are_those_of_the_surface(device, rng):
    projector = Projector(device, {0: camera(0.3, 0.4)}, WATER)
    still, count = Waves.still(*projector.optics), 24
    # Waves of five spacings and more, of slopes up to 0.1, over more than the photograph shows.
    waves = ndimage.gaussian_filter(rng.standard_normal((1, count, count)), (0.0, 1.5, 1.5), mode="wrap")
    waves = (0.1 * 8.0 * GSD * waves / waves.std()).astype(np.float32)
    corner = np.full((1, 2), -0.5 * count * 8.0 * GSD)
    surface = replace(still, corner=corner, spacing=8.0 * GSD, coefficients=waves, deep=DEPTH)
    pixels = rng.uniform(0.0, SIZE, (5000, 2))
    for heights in (rng.uniform(-1.1 * DEPTH, -0.3, 5000).astype(np.float32), np.ones(5000, dtype=np.float32)):
        points = np.stack([np.asarray(each) for each in projector.points(0, pixels, heights)])
        expected = surface.displacement(0, points)
        found = DisplacementImage.of(0, projector, surface).at(pixels.T.astype(np.float32), heights)
        assert np.sqrt(np.mean((found - expected) ** 2)) <= 0.03 * np.sqrt(np.mean(expected**2))


@pytest.mark.parametrize("water", [TILTED, None], ids=["wet", "dry"])
@pytest.mark.parametrize("bent", [False, True], ids=["pinhole", "lens"])
def test_points_of_pixels_are_seen_where_cameras_see_them(device, rng, water, bent):
    cameras = ring(4)
    if bent:
        lens = Distortion("brown", (-0.08, 0.02, 1e-3, -5e-4, 0.0))
        cameras = [replace(camera, distortion=lens) for camera in cameras]
    pixels = rng.uniform(1.0, np.array([95.0, 71.0]), (500, 2))
    heights = rng.uniform(-2.5, 0.4, 500).astype(np.float32)
    projector = Projector(device, dict(enumerate(cameras)), water)
    points = projector.points(0, pixels, heights)
    expected = cameras[0].paths(pixels, water).at_height(heights.astype(np.float64), water)
    for view, camera in enumerate(cameras):
        at, inside = projector.seen(view, points)
        where = camera.project(expected, water)
        np.testing.assert_allclose(at.T, where, atol=2e-3)
        size = np.array([camera.width, camera.height])
        clear = ((where > 0.51) & (where < size - 0.51)).all(axis=1)
        assert inside[clear].all()
        assert not inside[((where < 0.49) | (where > size - 0.49)).any(axis=1)].any()


TOLERANCE = 0.05
NOISE = NoiseShares(response=1.0, height_variance_ratio=1.0, smoothing_variance_ratio=1.0, excess_relief=0.0)


def kept(slope: float = 0.0, gain: float = 0.0, by_noise: float = 1e-8, noise: NoiseShares = NOISE) -> np.ndarray:
    """Of a tile whose pixels in the middle are so steep in the sweep, or were solved with such a gain."""
    tile, solved = level(1e4, 0.01)
    middle = np.zeros((40, 40), dtype=np.float32)
    middle[18:22, 18:22] = 1.0
    of_middle = middle.ravel()
    start = Start(solved.height, slope * of_middle)
    solved = replace(solved, start=start, improvement=gain * of_middle)
    found = solver.rejects_update(tile, solved, np.full(len(tile), by_noise), noise, 1.0, TOLERANCE)
    assert not found[middle.ravel() == 0.0].any() or gain < 0.0
    return found.reshape(40, 40)[19:21, 19:21]


def test_a_pixel_on_a_wall_keeps_the_height_of_the_sweep_and_one_on_a_slope_is_solved():
    assert kept(slope=1.1 * TOLERANCE).all()
    assert not kept(slope=0.9 * TOLERANCE).any()


def test_what_only_looks_steep_in_noise_is_solved():
    assert not kept(slope=2.0 * TOLERANCE, by_noise=(TOLERANCE / 2.9) ** 2).any()
    assert kept(slope=2.0 * TOLERANCE, by_noise=(TOLERANCE / 3.1) ** 2).all()


@pytest.mark.parametrize(("share", "limit"), [(0.5, 13.95), (1.0, 13.95), (2.5, 34.9)])
def test_a_solved_height_that_the_photographs_refute_is_not_taken_and_shared_noise_refutes_less(share, limit):
    noise = replace(NOISE, height_variance_ratio=share)
    assert kept(gain=-1.01 * limit / 9.0, noise=noise).all()
    assert not kept(gain=-0.99 * limit / 9.0, noise=noise).any()
    assert not kept(gain=limit, noise=noise).any()


def test_a_pixel_of_which_no_second_photograph_has_a_say_keeps_the_height_of_the_sweep():
    tile, solved = level(1e4, 0.01)
    weight = np.ones((3, len(tile)), dtype=np.float32)
    weight[1:, :5] = 0.0
    weight[2:, 5:9] = 0.0
    solved = replace(
        solved, brightness=replace(solved.brightness, weight=weight), improvement=np.zeros(len(tile), np.float32)
    )
    solved = replace(solved, start=Start(solved.height, np.zeros(len(tile), np.float32)))
    found = solver.rejects_update(tile, solved, np.full(len(tile), 1e-8), NOISE, 1.0, TOLERANCE)
    assert found[:5].all()
    assert not found[5:].any()


def test_slopes_by_noise_are_those_of_heights_that_are_noise_alone(rng):
    tile, solved = level(1e4, 0.01, size=80)
    std = float(np.sqrt(expected_variances(tile, solved, 1.0).noise.mean()))
    noisy = (3.0 * std * rng.standard_normal(len(tile))).astype(np.float32)
    noisy.reshape(tile.inside.shape)[30:33, 30:33] = 5.0
    moved = replace(solved, start=Start(solved.height - noisy, noisy))
    # Of the plane through nine independent heights each component is known to the root of a sixth of their variance.
    assert solver.sweep_slope_noise_ratio([(tile, moved)], 0.01, NOISE) == pytest.approx(3.0 / np.sqrt(6.0), rel=0.06)


def test_gain_is_large_where_photographs_came_to_agree_and_leaves_out_what_only_one_time_shows():
    _, solved = residuals(white(5))
    now, apart = solved.brightness, white(5, seed=2).reshape(5, -1)
    assert log_likelihood_ratio(now, now) == pytest.approx(0.0)
    worse = brightness_of((now.albedo + 3.0 * apart).astype(np.float32))
    assert np.median(log_likelihood_ratio(worse, now)) > 5.0
    unseen = replace(worse, weight=0.0 * worse.weight)
    assert (log_likelihood_ratio(unseen, now) == 0.0).all()
