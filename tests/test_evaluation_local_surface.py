"""Heights over a reference of points: whatever its spacing, errors are those of what is compared, or said to be not."""

import numpy as np
import pytest

from evaluation import iho_s44, local_surface
from evaluation.standards import TO_95

RNG = np.random.default_rng(7)
HALF = 12.0
PLACES = np.random.default_rng(3).uniform(-8.0, 8.0, (2000, 2))
TO_ROUNDING = 1e-9


def reference(kind, spacing_m):
    """Places of points: a grid, at random (as many per area), or lines of soundings eight steps apart."""
    rng = np.random.default_rng(11)
    if kind == "random":
        return rng.uniform(-HALF, HALF, (round((2 * HALF / spacing_m) ** 2), 2))
    across = spacing_m * (8.0 if kind == "lines" else 1.0)
    x, y = np.meshgrid(np.arange(-HALF, HALF + 1e-9, spacing_m), np.arange(-HALF, HALF + 1e-9, across))
    return np.column_stack([x.ravel(), y.ravel()])


def bed(plan, slope, relief_m):
    x, y = plan.T
    return slope * (0.8 * x + 0.6 * y) + relief_m * np.sin(2.0 * np.pi * x / 5.0) * np.cos(2.0 * np.pi * y / 4.0)


def over(kind, spacing_m, slope, relief_m, noise_m=0.0):
    plan = reference(kind, spacing_m)
    heights = bed(plan, slope, relief_m) + noise_m * np.random.default_rng(5).normal(size=len(plan))
    return local_surface(np.column_stack([plan, heights]), PLACES)


@pytest.mark.parametrize("slope", [0.0, 0.2, 1.0])
@pytest.mark.parametrize("spacing_m", [0.1, 0.35, 1.0, 2.5])
@pytest.mark.parametrize("kind", ["grid", "random"])
def test_on_a_plane_heights_are_exact_whatever_the_spacing(kind, spacing_m, slope):
    found = over(kind, spacing_m, slope, 0.0)
    known = np.isfinite(found.height)
    # Points at random leave a hole here and there.
    assert known.mean() > 0.99
    np.testing.assert_allclose(found.height[known], bed(PLACES[known], slope, 0.0), rtol=0.0, atol=TO_ROUNDING)
    assert found.std[known].max() < 1e-6
    assert found.spacing_m == pytest.approx(spacing_m, rel=0.15)


@pytest.mark.parametrize("slope", [0.0, 0.5])
@pytest.mark.parametrize("relief_m", [0.05, 0.3])
@pytest.mark.parametrize("spacing_m", [0.2, 0.5, 1.0, 2.0, 3.0])
@pytest.mark.parametrize("kind", ["grid", "random", "lines"])
def test_relief_between_points_is_in_the_std_and_makes_no_bias(kind, spacing_m, slope, relief_m):
    found = over(kind, spacing_m, slope, relief_m)
    known = np.isfinite(found.height)
    # Of lines only what is near one is known.
    assert known.mean() > (0.05 if kind == "lines" else 0.99)
    errors, std = bed(PLACES, slope, relief_m)[known] - found.height[known], found.std[known]
    rms = np.sqrt(np.square(errors).mean())
    # Between lines relief, and across single lines the slope, does not show in the points.
    assert rms < (2.0 if kind == "lines" else 1.0) * np.sqrt(np.square(std).mean()) + slope * 0.1 * spacing_m
    if kind != "lines":
        # No more than relief hides from the points: curvature times square of the spacing, or all of it, 0.5 in rms.
        assert rms < relief_m * min(0.7 * spacing_m**2, 0.6)
    assert abs(errors.mean()) < 0.1 * relief_m


def test_noise_of_a_dense_reference_averages_out_and_does_not_shrink_an_error():
    """The distance to the nearest of dense points that scatter is shorter than their surface is away."""
    found = over("grid", 0.05, 0.3, 0.0, noise_m=0.05)
    errors = bed(PLACES, 0.3, 0.0) + 0.1 - found.height
    assert errors.mean() == pytest.approx(0.1, abs=0.003)
    assert errors.std() < 0.03
    assert np.median(found.std) == pytest.approx(0.05, rel=0.2)


def test_beyond_the_rim_in_a_hole_and_beside_a_line_nothing_is_known():
    plan = reference("grid", 0.5)
    holed = plan[np.linalg.norm(plan, axis=1) > 4.0]
    places = np.array([[0.0, 0.0], [1.0, -1.0], [HALF + 1.0, 0.0], [40.0, 40.0], [6.0, 6.0], [np.nan, 0.0]])
    found = local_surface(np.column_stack([holed, np.zeros(len(holed))]), places)
    assert np.isfinite(found.height).tolist() == [False, False, False, False, True, False]
    line = np.column_stack([np.arange(0.0, 10.0, 0.5), np.zeros(20), np.arange(0.0, 5.0, 0.25)])
    found = local_surface(line, np.array([[5.1, 0.1], [5.1, 1.0], [12.0, 0.0]]))
    assert found.height[0] == pytest.approx(2.55)
    assert np.isnan(found.height[1:]).all()


@pytest.mark.parametrize("num", [0, 1, 3, 4, 11, 12])
def test_few_points_and_equal_points_are_no_error(num):
    points = RNG.uniform(-1.0, 1.0, (num, 3))
    found = local_surface(points, np.zeros((2, 2)))
    assert num >= 4 or np.isnan(found.height).all()
    assert np.isnan(found.spacing_m) == np.isnan(found.height).all()
    same = local_surface(np.zeros((num, 3)), np.zeros((2, 2)))
    assert np.isnan(same.height).all() or (same.height == 0.0).all()


@pytest.mark.parametrize("error_m", [0.0, 0.1, 0.3, 0.8])
@pytest.mark.parametrize("relief_m", [0.0, 0.1, 0.4])
@pytest.mark.parametrize("spacing_m", [0.2, 0.7, 2.0])
def test_no_order_is_denied_that_is_met_nor_granted_that_is_not(spacing_m, relief_m, error_m):
    found = over("random", spacing_m, 0.2, relief_m)
    known = np.isfinite(found.height)
    errors = (bed(PLACES, 0.2, relief_m) + error_m - found.height)[known]
    truly = iho_s44(np.full(len(errors), error_m), np.full(len(errors), 3.0))
    said = iho_s44(errors, np.full(len(errors), 3.0), found.std[known])
    assert truly is not None
    assert said is not None
    for true, order in zip(truly.orders, said.orders, strict=True):
        assert order.meets_tvu in (True, False)
        if true.meets_tvu:
            assert order.meets_tvu or order.is_undecided
        else:
            assert not order.meets_tvu
    if relief_m == 0.0:
        assert not any(order.is_undecided for order in said.orders)


def test_the_uncertainty_of_the_reference_widens_what_is_possible_by_its_1_96_fold():
    errors = np.where(np.arange(100) < 10, 0.2, 0.0)
    for std, undecided in ((0.02, False), (0.03, True)):
        exclusive, special, *_ = iho_s44(errors, np.full(100, 1.0), np.full(100, std)).orders
        assert (0.15 + TO_95 * std >= 0.2) is undecided
        assert (exclusive.meets_tvu, exclusive.is_undecided) == (False, undecided)
        assert (special.meets_tvu, special.is_undecided) == (True, False)
