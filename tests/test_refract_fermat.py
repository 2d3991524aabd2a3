"""The way back up through waves: brute force, known numbers of paths, and the bounds that the proof rests on."""

from __future__ import annotations

import math

import numpy as np
import pytest
from surface_rays import bed_points, cameras, falling_rays, view_angle

from refract.curved import _branches, _disc, fermat
from refract.curved._branches import Interval
from refract.curved.wavy import WavyWater


def ripples(amplitude, wavelength, *, phase=0.3, n_water=1.333) -> WavyWater:
    """Waves that run along x only."""
    return WavyWater((0.0, 0.0, 0.0), (amplitude,), ((2.0 * math.pi / wavelength, 0.0),), (phase,), n_water=n_water)


# Two crossing trains that focus light from about a metre below: several paths for many deeper points.
CHOP = WavyWater((0.0, 0.0, 0.0), (0.03, 0.012), ((6.0, 1.0), (-4.0, 13.0)), (0.3, 1.1))


def optical_length(water, camera, point, x, y):
    """|C - S| + n |S - P|, straight from the definition."""
    s = np.stack([x, y, water.height(x, y)], -1)
    return np.linalg.norm(s - camera, axis=-1) + water.n_water * np.linalg.norm(s - point, axis=-1)


def arrays(*rows):
    """Triples of arrays, one entry per row."""
    return tuple(np.array(rows, dtype=np.float64).T)


def test_of_all_paths_the_shortest_is_taken(rng):
    for _ in range(4):
        camera = np.array([*rng.uniform(-6, 6, 2), rng.uniform(5, 20)])
        point = np.array([*rng.uniform(-2, 2, 2), -rng.uniform(0.2, 3.0)])
        (x, y, z), _, count = CHOP.crossing(arrays(camera), arrays(point), 4)
        assert count[0] >= 1
        found = optical_length(CHOP, camera, point, x[0], y[0])
        # A grid about the straight line's foot, 5 mm apart; its best node lies at most curvature times 7 mm^2 higher.
        ways = np.linspace(-2.0, 2.0, 801)
        grid = np.stack(np.meshgrid(point[0] + ways, point[1] + ways), -1)
        lengths = optical_length(CHOP, camera, point, grid[..., 0], grid[..., 1])
        assert found <= lengths.min() + 1e-13
        nearest = grid[np.unravel_index(lengths.argmin(), lengths.shape)]
        assert math.hypot(nearest[0] - x[0], nearest[1] - y[0]) < 0.05
        assert z[0] == CHOP.height(x[0], y[0])


@pytest.mark.parametrize("amplitude", [0.004, 0.02, 0.04])
def test_paths_through_ripples_are_as_many_as_a_dense_scan_finds(rng, amplitude):
    """With camera, point and waves in one vertical plane every path stays in it: a scan of dL/dx counts them all."""
    water = ripples(amplitude, 0.8, phase=math.pi / 2.0)  # a crest at x = 0
    seen = set()
    for depth in (0.1, 0.7, 2.0, 6.0):
        camera, point = (
            np.array([rng.uniform(-0.05, 0.05), 0.0, 12.0]),
            np.array([rng.uniform(-0.01, 0.01), 0.0, -depth]),
        )
        _, _, count = water.crossing(arrays(camera), arrays(point), 4)
        x = np.linspace(-2.0 * depth, 2.0 * depth, 400_001)
        z, zx, *_ = water.derivatives(x, 0.0 * x)
        slope = sum(
            weight * ((x - end[0]) + zx * (z - end[2])) / np.hypot(x - end[0], z - end[2])
            for end, weight in ((camera, 1.0), (point, water.n_water))
        )
        expected = int(np.count_nonzero(slope[1:] * slope[:-1] < 0.0))
        assert count[0] == expected
        seen.add(expected)
    assert amplitude < 0.01 or max(seen) > 1


def test_newton_from_everywhere_finds_as_many_paths(rng):
    """Waves that cross: 3600 starts over the disc find every root that there is, and none besides."""
    counts = []
    for _ in range(12):
        camera = arrays((*rng.uniform(-3, 3, 2), rng.uniform(5, 20)))
        point = arrays((*rng.uniform(-2, 2, 2), -rng.uniform(4, 8)))
        _, depth, count = CHOP.crossing(camera, point, 4)
        disc = _disc.search_disc(CHOP, camera, point, depth)
        ways = disc.radius[0] * np.linspace(-1.0, 1.0, 60)
        x, y = (c.ravel() for c in np.meshgrid(disc.x[0] + ways, disc.y[0] + ways))
        with np.errstate(all="ignore"):  # starts that run away
            for _ in range(30):
                (gx, gy), (hxx, hxy, hyy) = fermat.path_slope(CHOP, camera, point, x, y)
                determinant = hxx * hyy - hxy * hxy
                x, y = x + (hxy * gy - hyy * gx) / determinant, y + (hxy * gx - hxx * gy) / determinant
        roots = (np.hypot(gx, gy) < 1e-10) & (np.hypot(x - disc.x, y - disc.y) <= disc.radius)
        distinct = np.unique(np.round(np.stack([x[roots], y[roots]]), 4), axis=1)
        assert count[0] == distinct.shape[1]
        counts.append(count[0])
    assert max(counts) > 1


def test_light_is_focused_below_crests_at_the_depth_that_optics_says():
    """From far above, a crest of curvature K focuses at n / ((n - 1) K): one path above that depth, three below."""
    amplitude, wavelength, n = 0.01, 1.0, 1.333
    focus = n / ((n - 1.0) * amplitude * (2.0 * math.pi / wavelength) ** 2) + amplitude
    water = ripples(amplitude, wavelength, phase=math.pi / 2.0)  # a crest at x = 0
    depths = np.array([0.9, 0.98, 1.02, 1.1]) * focus
    camera = np.zeros(4), np.zeros(4), np.full(4, 1e6)
    _, _, count = water.crossing(camera, (np.zeros(4), np.zeros(4), amplitude - depths), 4)
    np.testing.assert_array_equal(count, [1, 1, 3, 3])


def test_the_number_of_paths_is_odd_and_the_right_one_among_them(rng):
    """Light paths vanish and appear in pairs. Where there is one, it is the ray that was traced."""
    camera, ray = cameras(rng, 100, (5.0, 20.0)), falling_rays(rng, 100, flattest_deg=45.0)
    bed = bed_points(CHOP, camera, ray, rng.uniform(0.2, 5.0, 100))
    found, _, count = CHOP.crossing(camera, bed, 4)
    assert np.all(count % 2 == 1)
    assert (count == 1).sum() > 30
    assert (count > 1).sum() > 10
    angle = view_angle(camera, found, ray)
    assert angle[count == 1].max() < 1e-12
    # Among several, a shorter one may have been taken, never a longer one.
    for i in np.flatnonzero(angle > 1e-9):
        ends = np.stack(camera, -1)[i], np.stack(bed, -1)[i]
        own = CHOP.intersect(tuple(c[i : i + 1] for c in camera), tuple(c[i : i + 1] for c in ray))
        x, y = (c[i] + own[0] * d[i] for c, d in zip(camera[:2], ray[:2], strict=True))
        assert optical_length(CHOP, *ends, found[0][i], found[1][i]) < optical_length(CHOP, *ends, x, y)


def test_what_is_not_proven_is_nan_and_counted(monkeypatch):
    monkeypatch.setattr(_branches, "_BUDGET", 3)
    camera, point = arrays((0.0, 0.0, 10.0), (0.0, 0.0, 10.0)), arrays((0.0, 0.0, -4.0), (0.1, 0.0, -0.05))
    found, depth, count = CHOP.crossing(camera, point, 4)
    np.testing.assert_array_equal(count, [-1, 1])
    np.testing.assert_array_equal(np.isnan(found[0]), [True, False])
    assert np.all(np.isfinite(depth))


def test_a_point_on_a_caustic_is_not_guessed():
    """Just at the cusp three paths are one: the proof must fail, or the paths be found at the same place."""
    amplitude, k, n, H = 0.01, 2.0 * math.pi, 1.333, 10.0
    # L'' = 0 straight below a crest: 1 / a + n / w = (n - 1) K with a = H - amplitude.
    w = n / ((n - 1.0) * amplitude * k * k - 1.0 / (H - amplitude))
    water = ripples(amplitude, 1.0, phase=math.pi / 2.0)
    (x, _, _), _, count = water.crossing(arrays((0.0, 0.0, H)), arrays((0.0, 0.0, amplitude - w)), 4)
    assert count[0] == -1 or abs(x[0]) < 1e-4  # the third root of a rounding: 1e-16^(1/3) is 5e-6


def test_without_refraction_every_path_is_straight(rng):
    air = WavyWater((0.0, 0.0, 0.0), (0.02, 0.015), ((6.0, 1.0), (-4.0, 13.0)), n_water=1.0)
    camera = cameras(rng, 100, (5.0, 20.0))
    bed = rng.uniform(-4, 4, 100), rng.uniform(-4, 4, 100), rng.uniform(-3.0, -0.1, 100)
    found, _, count = air.crossing(camera, bed, 4)
    assert np.all(count == 1)
    straight = np.stack([p - c for p, c in zip(bed, camera, strict=True)], -1)
    straight /= np.linalg.norm(straight, axis=-1, keepdims=True)
    assert view_angle(camera, found, tuple(straight.T)).max() < 1e-15


def test_every_true_crossing_lies_in_the_search_disc(rng):
    for water in (CHOP, ripples(0.05, 0.8), ripples(0.05, 5.0, n_water=1.6)):
        camera, ray = cameras(rng, 2000, (0.5, 20.0)), falling_rays(rng, 2000, flattest_deg=70.0)
        t = water.intersect(camera, ray)
        bed = bed_points(water, camera, ray, 10.0 ** rng.uniform(-3, 1, 2000))
        depth = water.height(*bed[:2]) - bed[2]
        wet = depth > 0.0
        camera, ray, bed = (tuple(c[wet] for c in v) for v in (camera, ray, bed))
        disc = _disc.search_disc(water, camera, bed, depth[wet])
        off = np.hypot(camera[0] + t[wet] * ray[0] - disc.x, camera[1] + t[wet] * ray[1] - disc.y)
        assert np.all(off <= disc.radius)
        assert np.median(off / disc.radius) > 0.01  # a bound, but not a meaningless one


def test_where_the_length_is_called_convex_it_is(rng):
    water = ripples(0.02, 1.0)
    camera = cameras(rng, 300, (2.0, 20.0))
    bed = rng.uniform(-4, 4, 300), rng.uniform(-4, 4, 300), rng.uniform(-6.0, -0.1, 300)
    disc = _disc.search_disc(water, camera, bed, water.height(*bed[:2]) - bed[2])
    assert 0.1 < disc.convex.mean() < 1.0
    radius, angle = disc.radius * np.sqrt(rng.uniform(0, 1, (50, 300))), rng.uniform(0, 2 * math.pi, (50, 300))
    x, y = disc.x + radius * np.cos(angle), disc.y + radius * np.sin(angle)
    _, (hxx, hxy, hyy) = fermat.path_slope(water, camera, bed, x, y)
    least = 0.5 * (hxx + hyy) - np.hypot(0.5 * (hxx - hyy), hxy)
    assert least[:, disc.convex].min() > 0.0


def test_the_hessian_is_the_derivative_of_the_gradient(rng):
    camera, point = arrays((1.0, 2.0, 9.0)), arrays((0.3, -0.2, -1.5))
    x, y = rng.uniform(-1.0, 1.0, (2, 40))
    step = 1e-5
    _, hessian = fermat.path_slope(CHOP, camera, point, x, y)
    (x1, y1), (x0, y0) = (fermat.path_slope(CHOP, camera, point, x + s, y)[0] for s in (step, -step))
    (_, y3), (_, y2) = (fermat.path_slope(CHOP, camera, point, x, y + s)[0] for s in (step, -step))
    numeric = (x1 - x0) / (2 * step), (y1 - y0) / (2 * step), (y3 - y2) / (2 * step)
    np.testing.assert_allclose(hessian, numeric, atol=1e-7)  # fourth derivatives of some 100 / m^3 times step^2 / 6


def test_intervals_enclose_what_they_stand_for(rng):
    lo = rng.uniform(-4.0, 4.0, (2, 200))
    width = 10.0 ** rng.uniform(-6.0, 0.5, (2, 200))
    a, b = (Interval(x, x + w) for x, w in zip(lo, width, strict=True))
    share = rng.uniform(0.0, 1.0, (2, 100, 200))
    p, q = (x + w * s for x, w, s in zip(lo, width, share, strict=True))
    pairs = (
        (a + b, p + q), (a - b, p - q), (a * b, p * q), (a * a, p * p), (-a, -p), (2.0 * a - 1.0, 2.0 * p - 1.0),
        (a / (b * b + 1.0), p / (q * q + 1.0)), (np.sqrt(a * a + b * b), np.hypot(p, q)),
        (np.sin(7.0 * a), np.sin(7.0 * p)), (np.cos(7.0 * a), np.cos(7.0 * p)),
    )  # fmt: skip
    for interval, value in pairs:
        assert np.all((interval.lo <= value) & (value <= interval.hi))
    assert np.isnan((1.0 / Interval(-1.0, 1.0)).lo)


def test_surface_derivatives_of_intervals_enclose_those_of_numbers(rng):
    mid, half = rng.uniform(-3.0, 3.0, (2, 100)), 10.0 ** rng.uniform(-6.0, 0.0, (2, 100))
    boxes = CHOP.derivatives(*(Interval(m - h, m + h) for m, h in zip(mid, half, strict=True)))
    x, y = mid[:, None] + half[:, None] * rng.uniform(-1.0, 1.0, (2, 50, 100))
    for interval, value in zip(boxes, CHOP.derivatives(x, y), strict=True):
        assert np.all((interval.lo <= value) & (value <= interval.hi))
