"""Flights: overlaps and ground sampling are those asked for, through the water; blocks that tell no level are named."""

import math

import numpy as np
import pytest

from refract import FlatWater
from refract.lens import Lens
from survey.errors import SurveyError
from survey.simulate.flight import PATTERNS, FlightSettings, Site, plan_flight, views_of_bed

LENS = Lens("PINHOLE", (1750.0, 1750.0, 512.0, 384.0), 1024, 768)
WATER = FlatWater((0.0, 0.0, 0.0), n_water=1.333)
SITE = Site((30.0, 24.0), 3.5, WATER)
# Water bends the corners of an image, which are seen more aslant, a little more than the middles of its borders.
CORNER = 5e-3


def fly(site: Site = SITE, seed: int = 1, **flight):
    return plan_flight(FlightSettings(**({"height_m": 39.0, "wobble": 0.0} | flight)), LENS, site, seed)


def footprints(cameras) -> np.ndarray:
    """Corners (views, 4, 2) of the photographs on the bed, east and north."""
    shares = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    paths = [camera.paths(shares * (camera.width, camera.height), WATER) for camera in cameras]
    return np.array([path.at_height(np.full(4, -SITE.depth_m), WATER)[:, :2] for path in paths])


def tilts(cameras) -> np.ndarray:
    return np.degrees(np.arccos([-camera.cam_from_local[2, 2] for camera in cameras]))


def test_neighbours_of_a_strip_share_the_overlap_that_was_asked_for_on_the_bed():
    cameras = fly(patterns=("nadir",), forward_overlap=0.75, side_overlap=0.6, heading_deg=90.0)
    prints = footprints(cameras)
    first, second = prints[0], prints[1]
    along = np.ptp(first[:, 0])
    assert (second[:, 0].min() - first[:, 0].min()) == pytest.approx(0.25 * along, rel=CORNER)
    strips = np.unique(np.round([camera.centre[1] for camera in cameras], 6))
    assert np.diff(strips) == pytest.approx(0.4 * np.ptp(first[:, 1]), rel=CORNER)


def test_ground_sampling_on_the_bed_is_what_was_asked_for_through_the_water():
    (camera, *_) = fly(patterns=("nadir",), height_m=None, gsd_m=0.02)
    bed = np.array([*camera.centre[:2], -3.5])
    step = np.array([1e-3, 0.0, 0.0])
    per_m = np.linalg.norm(camera.project(bed + step, WATER) - camera.project(bed - step, WATER)) / 2e-3
    assert 1.0 / per_m == pytest.approx(0.02, rel=1e-6)


def test_strips_cover_the_area_and_turn_at_their_ends():
    cameras = fly(patterns=("nadir",))
    assert views_of_bed(cameras, SITE).min() >= 3
    x = np.array([camera.centre[0] for camera in cameras])
    turns = np.flatnonzero(np.diff(np.sign(np.diff(x))))
    assert len(turns) > 0
    tops = np.array([-camera.cam_from_local[1] for camera in cameras])
    assert {tuple(row) for row in np.round(tops).astype(int)} == {(1, 0, 0), (-1, 0, 0)}


def test_rings_look_at_the_point_of_interest_from_all_around():
    target = np.array([4.0, -3.0])
    cameras = fly(patterns=("oblique",), ring_views=6, ring_tilts_deg=(20.0, 40.0), target=(4.0, -3.0))
    np.testing.assert_allclose(tilts(cameras), np.repeat([20.0, 40.0], 6), atol=1e-9)
    for camera in cameras:
        # Aimed at the place where the point seems to lie for a steep view; a slanting one sees it within a quarter.
        pixel = camera.project(np.array([*target, -3.5]), WATER)
        assert np.abs(pixel - (512.0, 384.0)).max() < 0.25 * 384.0
    azimuths = [math.atan2(*(camera.centre[:2] - target)) for camera in cameras]
    assert len(np.unique(np.round(azimuths, 3))) == 12


def test_five_cameras_look_down_and_to_four_sides_at_every_place():
    cameras = fly(patterns=("five",), tilt_deg=35.0)
    assert len(cameras) % 5 == 0
    np.testing.assert_allclose(tilts(cameras[:5]), [0.0, 35.0, 35.0, 35.0, 35.0], atol=1e-9)
    sides = np.array([camera.cam_from_local[2, :2] for camera in cameras[1:5]])
    np.testing.assert_allclose(sides.sum(axis=0), 0.0, atol=1e-12)
    assert np.ptp([camera.centre for camera in cameras[:5]], axis=0).max() == 0.0


def test_outer_strips_stand_outside_and_look_in():
    cameras = fly(patterns=("outer",), tilt_deg=30.0)
    for camera in cameras:
        outside = np.abs(camera.centre[:2]) - 0.5 * np.array(SITE.size_m)
        assert outside.max() > 10.0
        side = int(np.argmax(outside))
        assert camera.cam_from_local[2, side] * camera.centre[side] < 0.0


def test_flights_deviate_by_chance_alike_for_the_same_seed():
    calm, shaken, again, other = fly(), fly(wobble=0.02), fly(wobble=0.02), fly(seed=2, wobble=0.02)
    move = np.array([a.centre - b.centre for a, b in zip(calm, shaken, strict=True)])
    assert move.std() == pytest.approx(0.02 * 39.0, rel=0.15)
    np.testing.assert_array_equal(shaken[3].centre, again[3].centre)
    assert (shaken[3].centre != other[3].centre).all()


@pytest.mark.parametrize(
    ("changes", "named"),
    [({"height_m": None}, "height_m, above the water, gsd_m"), ({"gsd_m": 0.02}, "not both"),
     ({"patterns": ("spiral",)}, "nadir, five, oblique, outer"), ({"forward_overlap": 0.99}, "share of the footprint"),
     ({"tilt_deg": 70.0}, "0 .straight down. to 60"), ({"height_m": -3.0}, "above 0"), ({"wobble": 0.5}, "at most 0.1"),
     ({"height_m": None, "gsd_m": 1e-4}, "under the water"), ({"height_m": 0.5}, "photographs, expected 3 to")],
)  # fmt: skip
def test_flights_that_cannot_be_are_refused_with_the_mend(changes, named):
    with pytest.raises(SurveyError, match=named):
        fly(**changes)


@pytest.mark.parametrize("pattern", PATTERNS)
def test_an_area_in_wrong_units_is_refused_before_its_stations_are_computed(pattern):
    with pytest.raises(SurveyError, match="more than 5000 photographs"):
        fly(Site((676120e3, 5311480e3), 3.5, WATER), patterns=(pattern,), ring_views=10**12)


def test_a_view_of_the_horizon_is_refused():
    wide = Lens("PINHOLE", (300.0, 300.0, 512.0, 384.0), 1024, 768)
    with pytest.raises(SurveyError, match=r"show the horizon.*smaller tilt"):
        plan_flight(FlightSettings(height_m=39.0, tilt_deg=45.0), wide, SITE, 1)
