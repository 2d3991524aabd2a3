"""Snell's law, its invariants, and where no ray passes; apparent depth in closed form; Fresnel's shares, both ways."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from slow_reference import meeting_of_lines
from surface_rays import LIBRARIES, array_of

from refract import (
    FlatWater,
    PinholeCamera,
    apparent_depth,
    apparent_depth_tangential,
    bend,
    crossing_point,
    tangential_shift,
    trace,
    true_depth,
)
from refract.snell import fresnel_coefficients

EPS = np.finfo(np.float64).eps
UP = np.array([0.0, 0.0, 1.0])


def downward(angle):
    """Unit rays (..., 3) that fall at ``angle`` [rad] to the vertical, toward +x."""
    angle = np.asarray(angle, dtype=np.float64)
    return np.stack([np.sin(angle), np.zeros_like(angle), -np.cos(angle)], axis=-1)


def scattered(rng, count):
    """Random unit normals and unit rays that meet them from their own side."""
    normal = rng.normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    ray = rng.normal(size=(count, 3))
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    ray *= -np.sign(np.sum(ray * normal, axis=-1, keepdims=True))
    return ray, normal


def test_equal_indices_return_the_ray_to_the_last_bit(rng):
    ray, normal = scattered(rng, 10_000)
    np.testing.assert_array_equal(bend(ray, normal, n_from=1.333, n_to=1.333), ray)


def test_grazing_rays_enter_the_water_at_the_critical_angle():
    grazing = downward(np.pi / 2 - np.array([1e-3, 1e-6, 1e-9, 1e-12, 1e-15]))
    bent = bend(grazing, UP, n_from=1.0, n_to=1.333)
    # sin(a) = 1 - delta^2 / 2: the last four angles have the critical sine to the last bit
    np.testing.assert_allclose(bent[1:, 0], 1.0 / 1.333, rtol=1e-12)
    np.testing.assert_allclose(bent[1:, 2], -math.sqrt(1.0 - 1.0 / 1.333**2), rtol=1e-12)


def test_total_reflection_starts_at_the_critical_angle_and_gives_nan():
    critical = math.asin(1.0 / 1.333)  # 48.6066 deg
    assert math.degrees(critical) == pytest.approx(48.61, abs=0.005)
    just = 1e-9
    assert np.isfinite(bend(downward(critical - just), UP, n_from=1.333, n_to=1.0)).all()
    assert np.isnan(bend(downward(critical + just), UP, n_from=1.333, n_to=1.0)).all()


def test_totally_reflected_rays_have_zero_gradient_and_leave_the_others_alone():
    angle = np.radians([20.0, 60.0, math.degrees(math.asin(1 / 1.333)) + 1e-6])
    rays = torch.tensor(downward(angle), requires_grad=True)
    up = torch.tensor(UP, requires_grad=True)
    bent = bend(rays, up, n_from=1.333, n_to=1.0)
    bent.nansum().backward()
    assert torch.isnan(bent).all(dim=-1).tolist() == [False, True, True]
    assert rays.grad[1:].abs().max() == 0.0
    assert rays.grad[0].abs().min() > 0.0
    assert torch.isfinite(up.grad).all()


def test_gradient_is_finite_exactly_at_the_critical_angle():
    # 0.8 and 0.6 with an index of 1.25: the cosine in air is zero, and its root has an infinite slope
    ray = torch.tensor([0.8, 0.0, -0.6], dtype=torch.float64, requires_grad=True)
    bent = bend(ray, torch.tensor(UP), n_from=1.25, n_to=1.0)
    bent.nansum().backward()
    assert torch.isfinite(ray.grad).all()


def test_indices_cannot_be_swapped_by_position():
    with pytest.raises(TypeError):
        bend(-UP, UP, 1.0, 1.333)


CLOSED = 1e-12  # relative: coordinates of some 10 m, depths of 3 m, a few dozen roundings
N, H, DEPTH = 1.333, 12.0, 3.0
WATER = FlatWater((0.0, 0.0, 0.0), n_water=N)
ANGLES_DEG = [5.0, 10.0, 20.0, 30.0, 40.0, 45.0, 60.0, 75.0]


def camera_and_ray(angle):
    """A camera at x < 0 that sees the bed point (0, 0, -DEPTH) at incidence `angle` [rad], and its ray."""
    ray = np.array([math.sin(angle), 0.0, -math.cos(angle)])
    way = trace(np.array([0.0, 0.0, H]), ray, WATER).at_height(-DEPTH, WATER)[0]
    return np.array([-way, 0.0, H]), ray


@pytest.mark.parametrize("angle_deg", ANGLES_DEG)
def test_rays_from_opposite_sides_meet_at_the_sagittal_depth(angle_deg):
    angle = math.radians(angle_deg)
    centre, ray = camera_and_ray(angle)
    mirror = np.array([-1.0, 1.0, 1.0])
    met = meeting_of_lines([centre, centre * mirror], [ray, ray * mirror])
    assert -met[2] == pytest.approx(apparent_depth(DEPTH, angle, n_water=N), rel=CLOSED)
    assert abs(met[0]) < CLOSED


@pytest.mark.parametrize("angle_deg", ANGLES_DEG)
def test_the_caustic_lies_at_the_tangential_depth_and_shift(angle_deg):
    """Neighbouring rays of one vertical plane touch where ``x(s) + z s`` is stationary, s the slope in air."""
    angle = math.radians(angle_deg)
    camera_x = torch.tensor(camera_and_ray(angle)[0][0], dtype=torch.float64, requires_grad=True)
    centre = torch.stack([camera_x, camera_x * 0.0, camera_x * 0.0 + H])
    bed = torch.tensor([0.0, 0.0, -DEPTH], dtype=torch.float64)
    crossing = crossing_point(bed, centre, WATER)[0]
    slope = (crossing - camera_x) / H
    d_crossing = torch.autograd.grad(crossing, camera_x, retain_graph=True)[0]
    d_slope = torch.autograd.grad(slope, camera_x)[0]
    depth = (-d_crossing / d_slope).item()
    x, slope = crossing.detach().item(), slope.detach().item()
    assert slope == pytest.approx(math.tan(angle), rel=CLOSED)
    assert depth == pytest.approx(apparent_depth_tangential(DEPTH, angle, n_water=N), rel=CLOSED)
    # Toward the camera, which stands at negative x; metres are subtracted to leave as little as a millimetre.
    assert -(x + depth * slope) == pytest.approx(tangential_shift(DEPTH, angle, n_water=N), abs=CLOSED * H)


def sample_camera(row) -> PinholeCamera:
    """A camera of the sample of pyBathySfM: its Euler angles turn north, east, up; 8.8 mm over 13.2 x 8.8 mm."""
    yaw = row["yaw"] if row["yaw"] <= 180.0 else row["yaw"] - 360.0
    turn = Rotation.from_euler("ZYX", [yaw, 90.0 - row["pitch"], -row["roll"]], degrees=True).as_matrix()
    forward, side, up = turn.T[:, [1, 0, 2]]
    return PinholeCamera(
        [row["x"], row["y"], row["z"]], np.stack([side, -up, forward]), 880.0, 880.0, 660.0, 440.0, 1320, 880
    )


def test_corrections_of_another_package_are_met_camera_by_camera(data_dir):
    """pyBathySfM corrects each point once per camera that sees it, at the incidence there: `true_depth`."""
    folder = data_dir / "real" / "pyBathySfM"
    points = np.genfromtxt(folder / "SamplePoints_recovered.csv.gz", delimiter=",", names=True)
    theirs = np.genfromtxt(folder / "pyBathySfM_output_n1.337.csv.gz", delimiter=",", names=True)
    rows = np.genfromtxt(folder / "BathySfM_SampleCameras.csv", delimiter=",", names=True, usecols=range(1, 7))
    xyz = np.stack([points["x"], points["y"], points["sfm_z"]], axis=-1)
    # Their footprints lie at the mean height of the first 10 000 points.
    ground = np.concatenate([xyz[:, :2], np.full((len(xyz), 1), xyz[:10_000, 2].mean())], axis=-1)
    depths = np.full((len(rows), len(xyz)), np.nan)
    near = np.zeros(depths.shape, dtype=bool)
    for row, depth, kept in zip(rows, depths, near, strict=True):
        camera = sample_camera(row)
        pixels = camera.project(ground, None)
        seen = ((pixels > 0.0) & (pixels < (camera.width, camera.height))).all(axis=-1)
        way = camera.centre - xyz
        distance = np.hypot(way[:, 0], way[:, 1])
        angle = np.arctan2(distance, way[:, 2])
        depth[seen] = true_depth(points["w_surf"] - points["sfm_z"], angle, n_water=1.337)[seen]
        kept[:] = (angle <= np.radians(35.0)) & (distance <= 100.0)
    np.testing.assert_array_equal(np.isfinite(depths).sum(axis=0), theirs["n_cams"])
    rounded = 5.1e-6  # five decimals
    np.testing.assert_allclose(np.nanmin(depths, axis=0), theirs["h_min"], rtol=0.0, atol=rounded)
    np.testing.assert_allclose(np.nanmax(depths, axis=0), theirs["h_max"], rtol=0.0, atol=rounded)
    np.testing.assert_allclose(np.nanmean(depths, axis=0), theirs["h_avg"], rtol=0.0, atol=rounded)
    filtered = np.nanmean(np.where(near, depths, np.nan), axis=0)
    np.testing.assert_allclose(filtered, theirs["h_filt"], rtol=0.0, atol=rounded)


def test_true_depth_undoes_apparent_depth():
    angle = np.radians(np.linspace(0.0, 89.0, 500))
    back = true_depth(apparent_depth(DEPTH, angle, n_water=N), angle, n_water=N)
    np.testing.assert_allclose(back, DEPTH, rtol=CLOSED)


def test_nadir_and_index_one_are_exact():
    for form in (apparent_depth, apparent_depth_tangential):
        assert form(DEPTH, 0.0, n_water=N) == pytest.approx(DEPTH / N, rel=1e-15)
        np.testing.assert_allclose(form(DEPTH, np.radians(ANGLES_DEG), n_water=1.0), DEPTH, rtol=CLOSED)
    assert tangential_shift(DEPTH, 0.0, n_water=N) == 0.0


def test_torch_takes_gradients_through_the_closed_forms():
    depth = torch.tensor(3.0, dtype=torch.float64, requires_grad=True)
    angle = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    for form in (apparent_depth, apparent_depth_tangential, tangential_shift, true_depth):
        expected = float(form(3.0, 0.5, n_water=N))
        assert form(depth, angle, n_water=N).detach().item() == pytest.approx(expected, rel=1e-15)
        assert torch.autograd.gradcheck(lambda d, a, form=form: form(d, a, n_water=N), (depth, angle))


N_FRESNEL = 1.333
BREWSTER, CRITICAL = math.atan(N_FRESNEL), math.asin(1.0 / N_FRESNEL)
EPS32 = float(np.finfo(np.float32).eps)
# Angles in air over all incidences, and in water up to 0.01 degrees from the critical angle.
IN_AIR = np.radians(np.linspace(0.0, 90.0, 181))
IN_WATER = np.linspace(0.0, CRITICAL - 1.7e-4, 181)


def into_water(angle):
    return fresnel_coefficients(np.cos(angle), n_from=1.0, n_to=N_FRESNEL)


def test_reflectance_is_that_of_fresnels_sine_and_tangent_laws():
    angle = IN_AIR[1:-1]
    other = np.arcsin(np.sin(angle) / N_FRESNEL)
    found = into_water(angle)
    # The laws themselves lose digits where the two angles or their tangents are near to each other.
    np.testing.assert_allclose(found.reflectance_s, (np.sin(angle - other) / np.sin(angle + other)) ** 2, rtol=1e-11)
    tangents = (np.tan(angle - other) / np.tan(angle + other)) ** 2
    np.testing.assert_allclose(found.reflectance_p, tangents, rtol=1e-11, atol=1e-15)


def test_light_along_the_surface_is_reflected_and_none_at_equal_indices():
    assert fresnel_coefficients(0.0, n_from=1.0, n_to=N_FRESNEL)[:] == (1.0, 1.0, 0.0, 0.0)
    for cosine in (1.0, 0.7, 1e-9):
        assert fresnel_coefficients(cosine, n_from=N_FRESNEL, n_to=N_FRESNEL)[:] == (0.0, 0.0, 1.0, 1.0)


def test_beyond_the_critical_angle_all_is_reflected():
    assert math.degrees(CRITICAL) == pytest.approx(48.61, abs=0.005)
    for angle in (CRITICAL + 1e-9, 1.0, 0.5 * math.pi):
        assert fresnel_coefficients(math.cos(angle), n_from=N_FRESNEL, n_to=1.0)[:] == (1.0, 1.0, 0.0, 0.0)
    # Just inside, R_s = 1 - 4 b / a with b the root of a small difference: 1e-8 off the angle leaves 6e-4.
    assert 0.0 < 1.0 - fresnel_coefficients(math.cos(CRITICAL - 1e-8), n_from=N_FRESNEL, n_to=1.0).reflectance < 2e-3


def test_a_cosine_of_the_other_side_is_not_known():
    assert np.isnan(fresnel_coefficients(np.array(-0.1), n_from=1.0, n_to=N_FRESNEL)).all()


def test_the_surface_is_the_same_from_both_sides():
    down = into_water(IN_AIR)
    up = fresnel_coefficients(np.sqrt(1.0 - (np.sin(IN_AIR) / N_FRESNEL) ** 2), n_from=N_FRESNEL, n_to=1.0)
    # Near 90 degrees in air, the cosine there comes out of the one in water as the root of a small difference.
    for ours, others in zip(down, up, strict=True):
        np.testing.assert_allclose(ours, others, atol=4e-8)
        np.testing.assert_allclose(ours[:-2], others[:-2], rtol=1e-11, atol=1e-15)


@pytest.mark.parametrize("library", LIBRARIES)
def test_what_is_reflected_and_what_passes_add_up_to_one(library):
    eps = EPS32 if library == "torch.float32" else float(np.finfo(np.float64).eps)
    for angles, n_from, n_to in (
        (IN_AIR, 1.0, N_FRESNEL),
        (IN_WATER, N_FRESNEL, 1.0),
        (np.linspace(0.9, 1.5, 50), N_FRESNEL, 1.0),
    ):
        exact = fresnel_coefficients(np.cos(angles), n_from=n_from, n_to=n_to)
        found = fresnel_coefficients(array_of(library, np.cos(angles)), n_from=n_from, n_to=n_to)
        sums = (found.reflectance_s + found.transmittance_s, found.reflectance_p + found.transmittance_p)
        for total in (*sums, found.reflectance + found.transmittance):
            np.testing.assert_allclose(np.asarray(total), 1.0, atol=4 * eps)  # measured 2
        # The derivative by the cosine reaches 1e2 at 0.01 degrees from the critical angle; measured 93.
        for ours, truth in zip(found, exact, strict=True):
            np.testing.assert_allclose(np.asarray(ours), truth, atol=200 * eps)


@pytest.mark.parametrize(
    ("n_from", "n_to", "angles_deg"),
    [
        (1.0, N_FRESNEL, [1.0, 30.0, 53.1, 80.0, 89.9]),
        (N_FRESNEL, 1.0, [1.0, 20.0, 36.9, 48.0]),
        (N_FRESNEL, N_FRESNEL, [1.0, 30.0, 80.0]),
    ],
)
def test_gradients_are_right_in_angle_and_indices(n_from, n_to, angles_deg):
    leaves = [
        torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in (np.cos(np.radians(angles_deg)), n_from, n_to)
    ]
    # Second derivatives reach 1e3 at the steepest of these angles: differences of 1e-7 are known to 1e-6.
    assert torch.autograd.gradcheck(
        lambda c, a, b: fresnel_coefficients(c, n_from=a, n_to=b), leaves, eps=1e-7, atol=1e-5
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradients_are_finite_everywhere_and_zero_beyond_the_critical_angle(dtype):
    cosine = torch.linspace(0.0, 1.0, 2001, dtype=dtype)
    exactly_critical = torch.tensor([math.cos(CRITICAL)], dtype=dtype)
    for n_from, n_to in ((1.0, N_FRESNEL), (N_FRESNEL, 1.0), (N_FRESNEL, N_FRESNEL)):
        leaf = torch.cat([cosine, exactly_critical]).requires_grad_()
        indices = [torch.tensor(n, dtype=dtype, requires_grad=True) for n in (n_from, n_to)]
        for share in fresnel_coefficients(leaf, n_from=indices[0], n_to=indices[1]):
            gradients = torch.autograd.grad(share.sum(), [leaf, *indices], retain_graph=True)
            assert all(torch.isfinite(g).all() for g in gradients)
            if n_from > n_to:
                beyond = leaf < math.cos(CRITICAL + 1e-3)
                assert not gradients[0][beyond].any()
    leaf = torch.tensor([0.0, 1.0], dtype=dtype, requires_grad=True)
    fresnel_coefficients(leaf, n_from=1.0, n_to=N_FRESNEL).reflectance_s.sum().backward()
    # Along the surface R_s falls as 1 - 4 a / b.
    assert leaf.grad[0].item() == pytest.approx(-4.0 / math.sqrt(N_FRESNEL * N_FRESNEL - 1.0), rel=1e-6)
