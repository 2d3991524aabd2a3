"""Still water over a large survey: heights below its tangent plane, and the bed under it, against a sphere."""

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from test_run_curved_water import bed_of, cameras, intersected

from geo.crs import parse_crs
from geo.frames import LocalFrame
from refract import FlatWater
from refract.curved import CurvedWater
from survey.folder.observations import Observations, PlacedViews
from survey.folder.survey import shifted_above_water
from survey.photos.cameras import View
from survey.photos.poses import TiePoints
from survey.run.points import through_surface
from survey.water.surface import EARTH, curvature_drop, still_water

N, LATITUDE = 1.333, math.radians(46.9)
FRAME = LocalFrame(parse_crs("EPSG:25832+5778"), (589012.0, 5194736.0, 2105.0))
PLANE = FlatWater((0.0, 0.0, 0.0), n_water=N)
# WGS 84. Gaussian radius of curvature at the latitude: a sqrt(1 - e^2) / (1 - e^2 sin^2) (Torge and Mueller, 4.1).
E_SQUARED = 1.0 / 298.257223563 * (2.0 - 1.0 / 298.257223563)
RADIUS = 6_378_137.0 * math.sqrt(1.0 - E_SQUARED) / (1.0 - E_SQUARED * math.sin(LATITUDE) ** 2) + 2105.0


class Sphere(CurvedWater):
    n_water = N

    def height(self, x, y):
        return -curvature_drop(np.hypot(x, y), RADIUS)

    def gradient(self, x, y):
        up = np.sqrt(RADIUS**2 - x**2 - y**2)
        return -x / up, -y / up


def around(reach, middle=(0.0, 0.0)):
    corners = reach * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    return np.column_stack([corners + middle, np.full(4, 80.0)])


@pytest.mark.parametrize("slope", [0.0, 0.004])
@pytest.mark.parametrize("reach", [300.0, 1000.0, 3000.0])
def test_still_water_falls_as_a_sphere_does(rng, reach, slope):
    plane = replace(PLANE, slope_x=slope, slope_y=-slope)
    water = still_water(FRAME, plane, around(reach))
    assert water is not None
    assert water.source == EARTH
    xy = rng.uniform(-reach, reach, (200, 2))
    over, std = water.at(xy)
    drop = curvature_drop(np.linalg.norm(xy, axis=1), RADIUS)
    # The radii of the ellipsoid differ by 0.3 % there.
    np.testing.assert_allclose(over, -drop, atol=0.003 * drop.max() + 1e-4)
    assert (std == 0.0).all()


def test_water_that_touches_its_plane_elsewhere_falls_from_there(rng):
    away = np.array([800.0, -500.0])
    level = FRAME.local_from_crs(FRAME.crs_from_local([[*away, 0.0]]) * [1.0, 1.0, 0.0] + [0.0, 0.0, 2105.0])[0]
    slope = -away / RADIUS
    plane = FlatWater(tuple(level.tolist()), n_water=N, slope_x=slope[0], slope_y=slope[1])
    water = still_water(FRAME, plane, around(1000.0))
    xy = rng.uniform(-900.0, 900.0, (100, 2))
    over, _ = water.at(xy)
    # Whichever plane they count from, heights of the water are the same.
    np.testing.assert_allclose(
        over + plane.height(*xy.T), -curvature_drop(np.linalg.norm(xy, axis=1), RADIUS), atol=1e-3
    )


def test_cameras_at_one_place_far_from_where_the_water_touches_its_plane():
    place = np.array([[800.0, -500.0, 80.0]] * 2)
    water = still_water(FRAME, PLANE, place)
    over, _ = water.at(place[:1, :2])
    assert over == pytest.approx(-curvature_drop(np.hypot(800.0, 500.0), RADIUS), abs=5e-4)


@pytest.mark.parametrize("reach", [20.0, 170.0])
def test_a_plane_is_as_good_over_a_small_survey(reach):
    assert still_water(FRAME, PLANE, around(reach)) is None


def test_the_bed_a_kilometre_away_lies_where_rays_through_a_sphere_meet(rng):
    middle = np.array([900.0, 400.0])
    drop = float(curvature_drop(np.linalg.norm(middle), RADIUS))
    moved = np.array([*middle, -drop])
    views = [replace(each, centre=each.centre + moved) for each in cameras()]
    points = rng.uniform((-6.0, -2.0, -2.5), (6.0, 2.0, -0.5), (200, 3)) + moved
    bed = bed_of(intersected(views, points, Sphere(), PLANE))
    water = still_water(FRAME, PLANE, around(1000.0))
    found = through_surface(bed, views, PLANE, water)
    assert np.abs(bed.xyz[:, 2] - points[:, 2]).max() > 0.02
    assert np.abs(found.xyz - points).max() < 5e-4
    np.testing.assert_allclose(found.depth, -drop - found.xyz[:, 2], atol=2e-3)


@pytest.mark.parametrize(("up", "is_lifted"), [(5.0, False), (-2.0, True)])
def test_low_flights_kilometres_away_are_over_their_water(up, is_lifted):
    """5 m over the water, 10 km from where its plane touches it, a camera lies 3 m under the plane."""
    there = np.array([10_000.0, 0.0, -curvature_drop(10_000.0)])
    views = [
        View(str(number), Path(f"{number}.jpg"), replace(camera, centre=np.add(there, (0.0, 3.0 * number, up))), None)
        for number, camera in enumerate(cameras()[:3])
    ]
    departure = still_water(FRAME, PLANE, np.array([view.camera.centre for view in views]))
    priors = {"0": SimpleNamespace(position=there, common_up_std=30.0)}
    ties = TiePoints(there + np.zeros((10, 3)), *[np.zeros(0, dtype=int)] * 2, np.zeros((0, 2)))
    placed = PlacedViews(None, FRAME, views, Observations(ties.start, ties, priors))
    moved, said = shifted_above_water(placed, PLANE, departure)
    assert bool(said.warnings) == is_lifted
    assert (moved.views is views) != is_lifted
