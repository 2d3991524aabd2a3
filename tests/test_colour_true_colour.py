"""The water taken away from colours, and its absorption told by views along ways of different length."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from plane_field import ABSORPTION, plane_sources
from plane_survey import PlaneBed, look, ring

from fields.colour.true_colour import estimate_absorption, true_colours
from fields.image_store import GAMMA
from fields.sweep.bed import BedPoints
from fields.sweep.maps import Sources
from fields.water_column import WaterColumn
from refract import FlatWater, fresnel_coefficients

WATER = FlatWater((0.0, 0.0, 0.0), n_water=1.34)
GIVEN = {"absorption": (0.3, 0.1, 0.05), "veil": (0.02, 0.1, 0.15)}


def points(rgb, depth, incidence) -> BedPoints:
    """Points with what decides on their colours; dry above the water."""
    depth = np.array(depth, dtype=np.float32)
    zeros = np.zeros(len(depth))
    angle = np.array(incidence, dtype=np.float32)
    return BedPoints(np.zeros((len(depth), 3)), np.array(rgb, np.uint8), zeros, zeros, depth, angle, depth > 0.0)


def photographed(bed: np.ndarray, depth: float, incidence: float, column: WaterColumn) -> np.ndarray:
    """What a photograph stores of a bed of linear radiance (3,), by the formulas."""
    inside = np.arcsin(np.sin(incidence) / WATER.n_water)
    way = depth + depth / np.cos(inside)
    mirrored = float(fresnel_coefficients(np.cos(incidence), n_from=1.0, n_to=WATER.n_water).reflectance)
    kept = np.exp(-np.array(GIVEN["absorption"]) * way)
    below = kept * bed + (1.0 - kept) * np.array(GIVEN["veil"])
    seen = (1.0 - mirrored) * below + mirrored * column.sky.detach().numpy()
    return np.round(255.0 * seen ** (1.0 / GAMMA))


def test_the_colour_of_a_bed_comes_back_from_any_depth_and_side():
    column, bed = WaterColumn(**GIVEN), np.array([0.5, 0.4, 0.3])
    sides = [(0.3, 0.0), (2.0, 0.2), (4.0, 0.7)]
    seen = points([photographed(bed, *side, column) for side in sides], *zip(*sides, strict=True))
    found, too_bright = true_colours(seen, WATER, column)
    # A grey level of red at 4 m stands for exp(0.3 * 8.2 / 2.2) = 3.1 of the bed's; half of one was rounded away.
    np.testing.assert_allclose(found, np.tile(255.0 * bed ** (1.0 / GAMMA), (3, 1)), atol=2.1)
    assert too_bright == 0.0


def test_dry_points_keep_their_colour_and_what_is_too_bright_is_counted():
    seen = points([[200, 150, 100], [250, 250, 250], [1, 1, 1]], [-0.5, 3.0, 3.0], [0.1, 0.1, 0.1])
    found, too_bright = true_colours(seen, WATER, WaterColumn(**GIVEN))
    np.testing.assert_array_equal(found[0], [200, 150, 100])
    np.testing.assert_array_equal(found[1], [255, 255, 255])
    np.testing.assert_array_equal(found[2], [0, 0, 0])
    assert too_bright == pytest.approx(1.0 / 3.0)


def test_what_is_given_of_a_column_is_not_learned_and_counts_the_way_down_too():
    column, learned = WaterColumn(**GIVEN), WaterColumn()
    assert [name for name, _ in column.named_parameters()] == ["raw_sky"]
    for name, value in GIVEN.items():
        assert column.given()[name] == pytest.approx(value)
    assert learned.given() == {}
    depth, length = torch.tensor([2.0]), torch.tensor([2.5])
    assert column.path_length(depth, length).item() == 4.5
    assert learned.path_length(depth, length).item() == 2.5


def mirroring(sources: Sources) -> Sources:
    """The photographs with the sky in the surface, as a column begins with it."""
    sky, up = WaterColumn().sky.detach().numpy(), np.array(WATER.up)
    for camera, image in zip(sources.cameras, sources.images, strict=True):
        fall = -(camera.paths(camera.pixel_centres(), WATER).air_direction @ up)
        r = fresnel_coefficients(fall, n_from=1.0, n_to=WATER.n_water).reflectance[..., None]
        seen = (1.0 - r) * (image / 255.0) ** GAMMA + r * sky
        image[:] = np.round(255.0 * seen ** (1.0 / GAMMA))
    return sources


def test_absorption_is_told_by_slant_views():
    sources = mirroring(plane_sources(PlaneBed(WATER, -2.0, 0.2), ring(6, radius=5.0)))
    # Rounding to grey levels and the contrast that patches lose at their borders, over ways from 3.6 to 4.6 m.
    np.testing.assert_allclose(estimate_absorption(sources), ABSORPTION, atol=0.015)


def test_a_dry_survey_has_no_absorption():
    sources = replace(plane_sources(PlaneBed(WATER, -2.0), ring(6, radius=5.0)), water=None)
    with pytest.raises(ValueError, match="the survey is dry"):
        estimate_absorption(sources)


def test_absorption_is_not_told_by_views_that_look_down_nor_by_a_single_one():
    bed = PlaneBed(WATER, -2.0)
    down = [look((0.1 * i, 0.1 * i, 10.0), (0.1 * i, 0.1 * i, -2.0)) for i in range(1, 4)]
    with pytest.raises(ValueError, match=r"too similar to estimate absorption: its error is \d"):
        estimate_absorption(plane_sources(bed, down))
    with pytest.raises(ValueError, match="too little of the bed under water is seen by several views"):
        estimate_absorption(plane_sources(bed, down[:1]))
