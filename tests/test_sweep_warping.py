"""Images carried along bent paths, in Dr.Jit and in torch, against float64 optics and closed forms."""

from dataclasses import replace

import numpy as np
import pytest
from plane_survey import TILTED, PlaneBed, held_in, look, ring, windows_of

from fields.device import choose_device
from fields.sweep.kernels.arrays import floats, host
from fields.sweep.kernels.rays import project_rays, rays_of_rows, sample
from fields.sweep.kernels.stack import Hypotheses, ViewStack
from fields.sweep.matching import kernels
from refract import FlatWater, PinholeCamera
from refract.distortion import BROWN, FISHEYE, RATIONAL, Distortion

EPS32 = np.finfo(np.float32).eps
# Local coordinates of 10 m after some ten float32 operations; measured 2.3e-6 m.
POINT_M = 5e-6
# The same through a camera of 800 px focal length, the search for the crossing included; measured 1.0e-4 px, and
# 2.6e-4 px through a fisheye on CUDA.
PIXEL_PX = 4e-4
# Two steps towards the row of a rolling shutter, of at first several pixels; measured 1.2e-3 px.
ROLLING_PX = 2e-3
BARREL = Distortion(BROWN, (-0.3, 0.1, 1e-3, -2e-3, -0.01))
PINCUSHION = Distortion(RATIONAL, (0.3, 0.05, -2e-3, 1e-3, 0.01, -0.1, 0.02, 0.0))
ROUND = Distortion(FISHEYE, (0.02, -0.01, 0.002, 0.001))
# Of a drone at 12 m/s whose rows are read in 20 us: 0.24 mm from row to row.
WEST, NORTH_EAST = np.array([-2.4e-4, 0.0, 0.0]), np.array([1.7e-4, -1.6e-4, 1e-5])
# Lenses, motions, and levels of the water over the plane [m] of four cameras, each in turn.
CAMERAS = {
    "pinhole": ((None,), (None,), (0.0,)),
    "brown": ((BARREL,), (None,), (0.0,)),
    "rational": ((PINCUSHION,), (None,), (0.0,)),
    "fisheye": ((ROUND,), (None,), (0.0,)),
    "brown beside pinhole": ((None, BARREL), (None,), (0.0,)),
    "all kinds": ((BARREL, ROUND, PINCUSHION, None), (None,), (0.0,)),
    "all shutters roll": ((BARREL,), (NORTH_EAST, WEST), (0.0,)),
    "some shutters roll": ((None,), (None, -WEST), (0.0,)),
    "all levels move": ((None, BARREL), (None,), (0.3, -0.2, 0.1, 0.2)),
    "one level moves": ((None, BARREL), (None,), (0.0, 0.3, 0.0, 0.0)),
    "shutters roll and levels move": ((None, BARREL), (None, -WEST), (0.3, -0.2, 0.1, 0.2)),
}
WATERS = {"wet": TILTED, "dry": None, "index one": FlatWater((0.0, 0.0, 0.0), n_water=1.0)}


def heights_everywhere(rng, stack: ViewStack) -> np.ndarray:
    """Heights (height, width) float32 from 3 m under the plane to 3 m over it."""
    return rng.uniform(-3.0, 3.0, (stack.height, stack.width)).astype(np.float32)


def points_of_legs(stack: ViewStack, view: int, heights: np.ndarray) -> np.ndarray:
    """Points (height, width, 3) of the paths of a view at their heights, by `rays_of_rows`."""
    device = stack.device
    rays = [host(device, row) for row in rays_of_rows(stack, view, 0, stack.height)]
    foot, air, wet = (np.stack(rays[i : i + 2], -1).reshape(*heights.shape, 2) for i in (0, 2, 4))
    flat = foot + heights[..., None] * np.where(heights[..., None] > 0.0, air, wet)
    return (
        np.concatenate([flat, heights[..., None]], axis=-1) @ stack.kernel_water.from_local + stack.kernel_water.origin
    )


def project_all(stack: ViewStack, view: int, other: int, heights: np.ndarray):
    """Pixels (height, width, 2) in `other`, and whether inside it, of the paths of a view at their heights."""
    device = stack.device
    rays = rays_of_rows(stack, view, 0, stack.height)
    u, v, inside = project_rays(stack, rays, floats(device, heights), other)
    uv = np.stack([host(device, u), host(device, v)], -1).reshape(*heights.shape, 2)
    return uv, host(device, inside).reshape(heights.shape)


@pytest.mark.parametrize("name", CAMERAS)
@pytest.mark.parametrize("water", WATERS.values(), ids=WATERS.keys())
def test_paths_and_projections_are_those_of_the_optics(device, rng, water, name):
    lenses, motions, tides = ([of[k % len(of)] for k in range(4)] for of in CAMERAS[name])
    changes = zip(lenses, motions, tides, strict=True)
    cameras = [
        replace(camera, distortion=lens, motion=motion, tide=tide)
        for camera, (lens, motion, tide) in zip(ring(3), changes, strict=True)
    ]
    stack = PlaneBed(water, -2.0).stack(device, cameras)
    heights = heights_everywhere(rng, stack)
    for view in (0, 1):
        path = cameras[view].paths(cameras[view].pixel_centres(), water)
        points = path.at_height(heights.astype(np.float64), water)
        assert np.isfinite(points).all()
        if cameras[view].tide == 0.0:
            np.testing.assert_allclose(points_of_legs(stack, view, heights), points, atol=POINT_M)
        for other, camera in enumerate(cameras):
            truth = camera.project(points, water)
            moves = camera.motion is not None or (camera.tide != 0.0 and water is TILTED)
            still = replace(camera, motion=None, tide=0.0)
            assert not moves or np.abs(truth - still.project(points, water)).max() > 0.3
            off = PIXEL_PX if all(m is None for m in motions) and not any(tides) else ROLLING_PX
            uv, inside = project_all(stack, view, other, heights)
            np.testing.assert_allclose(uv, truth, atol=off)
            margin = np.minimum(truth - 0.5, np.array([camera.width, camera.height]) - 0.5 - truth).min(axis=-1)
            clear = np.abs(margin) > off
            np.testing.assert_array_equal(inside[clear], margin[clear] > 0.0)


def test_a_path_crosses_the_surface_without_a_step(device):
    stack = PlaneBed(TILTED, -2.0).stack(device, ring(2))
    shape = (stack.height, stack.width)
    at = {h: project_all(stack, 0, 1, np.full(shape, h, np.float32))[0] for h in (-1e-4, 0.0, 1e-4)}
    # Parallax is 24 px per metre of height: 800 px of focal length, 3 m of baseline, 10 m of distance.
    for height in (-1e-4, 1e-4):
        assert np.abs(at[height] - at[0.0]).max() < 2.4e-3 + PIXEL_PX
    points = points_of_legs(stack, 0, np.zeros(shape, np.float32))
    assert np.abs(TILTED.depth(points.astype(np.float64))).max() < POINT_M


def test_pixels_and_points_beyond_the_fold_of_a_lens_match_nothing(device):
    # r (1 - 80 r^2) turns back at r = 0.065, 52 px from the middle, distorted to 34 px; the corners are 60 px away.
    folded = Distortion(BROWN, (-80.0, 0.0, 0.0, 0.0, 0.0))
    cameras = [replace(camera, distortion=lens) for camera, lens in zip(ring(1), (folded, None), strict=True)]
    stack = PlaneBed(TILTED, -2.0).stack(device, cameras)
    heights = np.full((stack.height, stack.width), -2.0, np.float32)
    dark = ~np.isfinite(cameras[0].directions(cameras[0].pixel_centres())).all(axis=-1)
    assert 0.0 < dark.mean() < 0.5
    np.testing.assert_array_equal(np.isnan(points_of_legs(stack, 0, heights)).any(axis=-1), dark)
    points = cameras[1].paths(cameras[1].pixel_centres(), TILTED).at_height(heights.astype(np.float64), TILTED)
    seen = np.isfinite(cameras[0].project(points, TILTED)).all(axis=-1)
    assert 0.5 < seen.mean() < 0.99
    inside = project_all(stack, 1, 0, heights)[1]
    # A ray within float32 of the reach may be on either side.
    assert (inside & ~seen).mean() < 1e-3
    assert not project_all(stack, 0, 1, heights)[1][dark].any()


def test_rays_that_never_fall_to_the_plane_match_nothing(device):
    up = look((0.0, 0.0, 10.0), (20.0, 0.0, 14.0))
    cameras = [up, look((0.5, 0.0, 10.0), (20.0, 0.0, 14.0))]
    image = np.ones((up.height, up.width), np.float32)
    stack = ViewStack.build(device, cameras, [image, image], None)
    assert np.isnan(points_of_legs(stack, 0, np.zeros(image.shape, np.float32))).all()
    assert not project_all(stack, 0, 1, np.zeros(image.shape, np.float32))[1].any()


def two_images(device, image: np.ndarray) -> ViewStack:
    """A stack of zeros and an image."""
    camera = PinholeCamera((0, 0, 10), np.diag([1.0, -1.0, -1.0]), 50, 50, 8, 6, image.shape[1], image.shape[0])
    return ViewStack.build(device, [camera, camera], [np.zeros_like(image), image], None)


def sampled(stack: ViewStack, u: np.ndarray, v: np.ndarray, inside: np.ndarray, way=sample) -> np.ndarray:
    device = stack.device
    return host(device, way(stack, 1, floats(device, u), floats(device, v), floats(device, inside) > 0.5))


def test_lookups_at_pixel_centres_give_the_pixels_back(device, rng):
    image = rng.normal(0.0, 50.0, (12, 16)).astype(np.float32)
    v, u = (axis.ravel() + 0.5 for axis in np.mgrid[0:11, 0:15])
    found = sampled(two_images(device, image), u, v, np.ones(u.size))
    np.testing.assert_array_equal(found, image[:11, :15].ravel())


def test_lookups_between_pixels_are_bilinear_and_nan_outside(device, rng):
    def plane(u, v):
        return 3.0 * u - 7.0 * v + 0.5 * u * v  # bilinear in each cell

    image = plane(*np.meshgrid(np.arange(16) + 0.5, np.arange(12) + 0.5)).astype(np.float32)
    u, v = rng.uniform(0.5, 15.4, 500), rng.uniform(0.5, 11.4, 500)
    inside = rng.uniform(size=500) > 0.2
    found = sampled(two_images(device, image), u, v, inside)
    np.testing.assert_array_equal(np.isnan(found), ~inside)
    # Values up to 150, positions up to 16 px in float32 with slopes up to 9 a pixel.
    np.testing.assert_allclose(found[inside], plane(u, v)[inside], atol=16 * EPS32 * 9 * 4)


@pytest.mark.parametrize("levels", ["of 8 bits", "of 8 bits, masked", "means of four", "of any kind"])
def test_packed_lookups_are_bilinear_lookups(device, rng, levels):
    image = rng.integers(-128, 128, (12, 16)).astype(np.float32)
    if levels == "means of four":
        image += rng.integers(0, 4, image.shape) / 4
    if levels == "of any kind":
        image = rng.normal(0.0, 300.0, image.shape)
    if levels == "of 8 bits, masked":
        image[3:5, 7] = np.nan
    stack = two_images(device, image)
    assert stack.packed.bits == (8 if levels == "of 8 bits" else 16)
    where = rng.uniform(0.5, 15.4, 3000), rng.uniform(0.5, 11.4, 3000), rng.uniform(size=3000) > 0.2
    found, expected = (sampled(stack, *where, way) for way in (kernels(device).sample_packed, sample))
    np.testing.assert_array_equal(np.isnan(found), np.isnan(expected))
    # Whole steps and quarters are exact, but for rounding; others are rounded to a step.
    rounding = 0.5 * stack.packed.step if levels == "of any kind" else 4 * 256 * EPS32
    np.testing.assert_allclose(found, expected, atol=rounding + 4 * 256 * EPS32)
    if levels == "of 8 bits, masked":
        column, row = np.floor(where[0] - 0.5), np.floor(where[1] - 0.5)
        beside = (column >= 6) & (column <= 7) & (row >= 2) & (row <= 4)
        np.testing.assert_array_equal(np.isnan(found), beside | ~where[2])


def test_images_of_one_level_and_images_all_masked_are_packed(device):
    for level in (30.0, 0.3, np.nan):
        stack = two_images(device, np.full((6, 8), level, np.float32))
        found = sampled(stack, np.full(4, 3.7), np.full(4, 2.2), np.ones(4), kernels(device).sample_packed)
        np.testing.assert_allclose(found, np.float32(level), rtol=EPS32, atol=0.5 * stack.packed.step)


def warped(stack: ViewStack, start: np.ndarray, others: list[int], step: float, count: int) -> np.ndarray:
    """W (neighbours, count, height, width) of view 0."""
    images, device = kernels(stack.device), stack.device
    rays = rays_of_rows(stack, 0, 0, stack.height)
    values = images.buffers(device, len(others), start.size * count)
    images.warp(values, stack, rays, Hypotheses(start, step, count), others)
    found = [held_in(device, each, start.size * count) for each in values[: len(others)]]
    return np.stack(found).reshape(len(others), count, stack.height, stack.width)


@pytest.mark.parametrize(
    "bed", [PlaneBed(TILTED, -2.0), PlaneBed(None, -2.0), PlaneBed(TILTED, 0.1, slope=0.2)], ids=["wet", "dry", "shore"]
)
def test_the_neighbours_warped_at_the_true_height_show_the_reference(device, bed):
    cameras = ring(3, target=(0.0, 0.0, bed.level))
    stack = bed.stack(device, cameras)
    reference, truth = bed.photograph(cameras[0]), bed.true_height(cameras[0])
    found = warped(stack, truth - 0.2, [1, 2, 3], 0.2, 3)
    seen = np.isfinite(found[:, 1])
    assert (seen.mean(axis=(1, 2)) > 0.5).all()
    # Bilinear interpolation loses up to amplitude * pi^2 / (2 wavelength^2): the shortest wave has 8 px.
    error = np.abs(found[:, 1] - reference)[seen]
    assert error.max() < 0.1 * reference.std()
    assert np.abs(found[:, 0] - reference)[seen & np.isfinite(found[:, 0])].mean() > 5.0 * error.mean()


def test_a_stack_refuses_images_of_another_size_than_their_camera(device):
    cameras = ring(1)
    right, wrong = np.zeros((72, 96), np.float32), np.zeros((96, 72), np.float32)
    with pytest.raises(ValueError, match=r"of the sizes of their cameras \[\(72, 96\), .*got images of .*\(96, 72\)\]"):
        ViewStack.build(device, cameras, [right, wrong], None)
    with pytest.raises(ValueError, match="got images of"):
        ViewStack.build(device, [cameras[0], cameras[0].scaled(0.5)], [right, right], None)


@pytest.fixture(scope="module")
def both():
    """Dr.Jit on LLVM and torch."""
    found = choose_device("cpu")
    if found.name != "llvm":
        pytest.skip(f"Dr.Jit does not run on this CPU: {found.reason}")
    return found, choose_device("torch")


def scored(device, reference: np.ndarray, images: np.ndarray) -> np.ndarray:
    """NCC of images with a reference over windows of 5 x 5."""
    width = reference.shape[1]
    windows = windows_of(device, reference, images, width, 2)
    scores, lost = kernels(device).ncc(windows, 2), 2 * (width + 1)
    return np.stack([np.pad(host(device, score), lost).reshape(reference.shape) for score in scores])


def test_the_twin_warps_and_scores_as_dr_jit_does(both):
    bed, cameras = PlaneBed(TILTED, 0.1, slope=0.2), ring(4, target=(0.0, 0.0, 0.1))
    truth, reference = bed.true_height(cameras[0]), bed.photograph(cameras[0])
    w = [warped(bed.stack(d, cameras), truth - 0.2, [4, 1, 3], 0.1, 5) for d in both]
    both_seen = np.isfinite(w[0]) & np.isfinite(w[1])
    assert (np.isfinite(w[0]) != np.isfinite(w[1])).mean() < 1e-4
    # Positions differ by 1e-4 px, the texture rises by up to 40 grey levels a pixel; measured 2e-3.
    assert np.abs(w[0] - w[1])[both_seen].max() < 4e-3
    inner = np.s_[..., 2:-2, 2:-2]
    scores = [scored(d, reference, w[0].reshape(-1, *reference.shape))[inner] for d in both]
    # Fused products round otherwise: the mean of 25 squares of 100 by 1e-3, in windows whose variance may be 10.
    np.testing.assert_allclose(*scores, atol=2e-4)
