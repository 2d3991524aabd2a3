"""Refining: which pixels take the height of the field."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from plane_field import plane_sources
from plane_survey import TILTED, PlaneBed, ring

from fields.device import choose_device
from fields.slab.novel_view import refine
from fields.slab.rays import slab_of
from fields.slab.tensor_field import FieldSettings, TensorField
from fields.water_column import WaterColumn

BED = PlaneBed(TILTED, -2.0, 0.1)
GSD = 0.03


@pytest.fixture(scope="module")
def cameras():
    return ring(4)


def test_the_field_leaves_pixels_alone_that_it_was_not_asked_for_or_that_lie_elsewhere(cameras):
    sources = plane_sources(BED, cameras)
    slab = slab_of(sources, GSD, None)
    field = TensorField(slab, FieldSettings(), choose_device("torch"), WaterColumn())
    mast = sources.maps[0].height.copy()
    mast[20:30, 40:50] += 0.5
    height_map = replace(sources.maps[0], height=mast)
    keep = np.zeros(mast.shape, dtype=bool)
    keep[10:40, 30:60] = True
    height, moved = refine(field, cameras[0], height_map, sources.images[0], sources.water, keep)
    changed = height != mast
    assert not changed[~keep].any()
    assert not changed[20:30, 40:50].any()
    assert moved == keep.sum() - 100
    assert np.abs(height - mast)[keep].max() < 3e-3
    nothing, none = refine(field, cameras[0], height_map, sources.images[0], sources.water, np.zeros_like(keep))
    assert none == 0
    np.testing.assert_array_equal(nothing, mast)


def test_the_field_moves_no_pixel_by_more_than_half_the_slab(cameras):
    sources = plane_sources(BED, cameras)
    field = TensorField(slab_of(sources, GSD, None), FieldSettings(), choose_device("torch"), WaterColumn())
    with torch.no_grad():
        field.density.coarse.bias.fill_(np.arctanh(0.7))  # the bed 0.7 halves above its proxy
    for share, moves in ((0.2, True), (-0.2, True), (-0.4, False)):
        lowered = replace(sources.maps[1], height=sources.maps[1].height + np.float32(share * field.slab.half))
        keep = np.zeros(lowered.height.shape, dtype=bool)
        keep[5:-5, 5:-5] = True
        height, moved = refine(field, cameras[1], lowered, sources.images[1], sources.water, keep)
        assert moved == (keep.sum() if moves else 0)
        np.testing.assert_array_equal(height != lowered.height, keep & moves)
