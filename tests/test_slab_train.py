"""Training inside the bound: which rays are drawn, that a displaced bed comes back, and what refuses to train."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from plane_field import level_slab, plane_sources
from plane_survey import TILTED, PlaneBed, ring

from fields.device import choose_device
from fields.slab import train as training
from fields.slab.refine import refine
from fields.slab.tensor_field import FieldSettings, TensorField
from fields.slab.train import Schedule, draw_rays, slab_of, train
from fields.sweep.sources import Sources
from fields.training import set_rates
from fields.water_column import WaterColumn

BED = PlaneBed(TILTED, -2.0, 0.1)
GSD = 0.03
# On CUDA two trainings differ by the order in which Dr.Jit adds up gradients: a step of float32 in height is 0.24 um.
# Another seed moves them by millimetres.
ORDER_OF_SUMS_MM = {"llvm": 0.0, "torch": 0.0, "cuda": 0.01}


@pytest.fixture(scope="module")
def cameras():
    return ring(4)


def quietly(share: float) -> None:
    """Progress that nobody looks at."""


@pytest.fixture
def short(monkeypatch):
    """Trainings of 40 steps of 512 rays."""
    monkeypatch.setattr(training, "MIN_STEPS", 40)
    monkeypatch.setattr(training, "SMALL_BATCH", 512)


def errors_mm(sources: Sources, field: TensorField) -> np.ndarray:
    """Of the field's heights at all pixels but the outermost, against the true bed."""
    found = []
    for camera, depth_map, image in zip(sources.cameras, sources.maps, sources.images, strict=True):
        every = np.ones(depth_map.height.shape, dtype=bool)
        height, _ = refine(field, camera, depth_map, image, sources.water, every)
        found.append((height - BED.true_height(camera))[5:-5, 5:-5].ravel())
    return 1e3 * np.concatenate(found)


def test_training_brings_a_displaced_bed_back_in_both_stages():
    sources = plane_sources(BED, ring(6), shift=0.015)
    slab = slab_of(sources, GSD, None)
    device = choose_device("cpu")
    untrained = TensorField(slab, FieldSettings(), device, WaterColumn())
    assert np.median(errors_mm(sources, untrained)) == pytest.approx(15.0, abs=0.5)
    shares = []
    field, figures = train(sources, slab, FieldSettings(), Schedule(30.0), device, shares.append)
    after = errors_mm(sources, field)
    # Half a cell off at the start; measured 0.4 mm and 2.2 mm.
    assert abs(np.median(after)) < 2.0
    assert after.std() < 4.0
    assert figures.switched_at is not None
    assert figures.switched_at < figures.steps - 50
    assert field.density.is_fine
    assert not torch.equal(field.density.fine.weight, field.density.coarse.weight)
    assert figures.psnr_db > 45.0  # of photographs rounded to 8 bits: 58 dB at best
    assert 0.2 * GSD < figures.width_m < GSD
    assert figures.parameters == sum(p.numel() for p in field.parameters())
    assert len(shares) == figures.steps
    assert shares[-1] == 1.0


def test_the_same_seed_trains_the_same_bed(cameras, device, short):
    sources = plane_sources(BED, cameras, noise=0.005)
    slab = slab_of(sources, GSD, None)
    one, other = (
        errors_mm(sources, train(sources, slab, FieldSettings(), Schedule(1.0), device, quietly)[0]) for _ in range(2)
    )
    assert np.abs(one - other).max() <= ORDER_OF_SUMS_MM[device.name]
    assert np.ptp(one) > 1.0


def test_colours_learn_first_and_the_bed_stays_where_it_is(cameras, device, short, monkeypatch):
    monkeypatch.setattr(training, "COLOUR_FIRST", 0.999)
    sources = plane_sources(BED, cameras)
    slab = slab_of(sources, GSD, None)
    start = TensorField(slab, FieldSettings(), device, WaterColumn())
    field, figures = train(sources, slab, FieldSettings(), Schedule(1.0), device, quietly)
    assert not field.density.coarse.weight.any()
    assert field.log_width == start.log_width
    assert field.colour.last.bias.std() > 0.0
    assert figures.psnr_db > 15.0
    assert figures.switched_at is None
    assert np.abs(errors_mm(sources, field)).max() < 3.0  # medians of the true heights, bilinear over tilted cells


def test_learning_rates_hold_the_bed_first_and_fall_to_a_twentieth(cameras, short, monkeypatch):
    rates: dict[str, list[float]] = {name: [] for name in ("factors", "density", "heads", "width")}

    def note(optimiser, share, *, held=()):
        set_rates(optimiser, share, held=held)
        for group in optimiser.param_groups:
            rates[group["name"]].append(group["lr"] / group["top"])

    monkeypatch.setattr(training, "set_rates", note)
    sources = plane_sources(BED, cameras)
    slab = slab_of(sources, GSD, None)
    train(sources, slab, FieldSettings(), Schedule(1.0), choose_device("torch"), quietly)
    fall = np.maximum(0.0, (np.arange(40) / 40 - 0.3) / 0.7)
    for name in ("factors", "heads"):
        np.testing.assert_allclose(rates[name], 0.05**fall)
    for name in ("density", "width"):
        assert not np.any(rates[name][:12])
        np.testing.assert_allclose(rates[name][12:], 0.05 ** fall[12:])


@pytest.mark.parametrize(
    ("known", "per_cell", "expected"),
    [(1000, 30.0, (300, 2048)), (40_000, 30.0, (300, 4000)), (400_000, 30.0, (733, 16384)), (2e6, 30.0, (916, 65536))],
)
def test_steps_draw_the_rays_that_each_cell_is_promised(known, per_cell, expected):
    steps, batch = training._steps(per_cell, known)
    assert (steps, batch) == expected
    assert steps * batch >= per_cell * known


def test_a_dry_survey_trains_without_a_water_column(short):
    dry = PlaneBed(None, -2.0, 0.1)
    sources = plane_sources(dry, ring(3))
    field, figures = train(
        sources, slab_of(sources, GSD, None), FieldSettings(), Schedule(1.0), choose_device("cpu"), quietly
    )
    assert field.column is None
    assert figures.steps == 40


def test_the_slab_spans_the_heights_inside_the_area_with_room_for_their_noise(cameras):
    sources = plane_sources(BED, cameras, noise=0.01)
    slab = slab_of(sources, GSD, (-0.3, -0.2, 0.3, 0.4))
    assert slab.cell == GSD
    assert slab.half == pytest.approx(2.0 * GSD)  # a spread of 5 mm asks for 1.5 cm
    np.testing.assert_allclose(slab.low, [-0.33, -0.23], atol=GSD)
    np.testing.assert_allclose(slab.size[:2], [0.66, 0.66], atol=2.5 * GSD)
    rows, columns = np.nonzero(slab.known)
    x, y = slab.low[0] + GSD * (columns + 0.5), slab.low[1] + GSD * (rows + 0.5)
    truth = -TILTED.depth(np.stack([x, y, BED.level + BED.slope * x], axis=-1))
    # Medians of heights that err by 1 cm each: better than one of them, and none off by more than five deviations.
    errors = slab.proxy[rows, columns] - truth
    assert errors.std() < 0.01
    assert np.abs(errors).max() < 0.05
    wide = [replace(m, spread=np.full_like(m.spread, 0.03)) for m in sources.maps]
    assert slab_of(replace(sources, maps=wide), GSD, None).half == pytest.approx(0.09)


def test_rays_are_drawn_from_trusted_pixels_inside_the_image_evenly_over_the_views(cameras, rng):
    sources = plane_sources(BED, cameras[:3])
    slab = slab_of(sources, GSD, None)
    rows, columns = sources.maps[0].height.shape
    maps, images = [], []
    for number, m in enumerate(sources.maps):
        agreeing = np.zeros((rows + 8, columns + 4), dtype=np.uint8)  # padded to a larger image
        agreeing[number * rows // 4 :] = 3
        padded = {
            name: np.pad(getattr(m, name), ((0, 8), (0, 4)), mode="edge")
            for name in ("height", "score", "curvature", "spread")
        }
        maps.append(replace(m, agreeing=agreeing, **padded))
        image = np.zeros((rows, columns, 3), dtype=np.uint8)
        image[number * rows // 4 :] = 85 * (number + 1)
        images.append(image)
    rays = draw_rays(replace(sources, maps=maps, images=images), slab, 9000, rng)
    view = torch.round(3.0 * rays.rgb[:, 0])
    assert (view > 0).all()  # a pixel above the trusted rows would be black
    counts = np.array([int((view == v).sum()) for v in (1, 2, 3)])
    np.testing.assert_allclose(counts / 9000, np.array([4, 3, 2]) / 9, atol=0.02)
    assert abs(len(rays) - 9000) < 200


def test_rays_whose_own_height_leaves_the_slab_are_left_out(cameras, rng):
    sources = plane_sources(BED, cameras)
    slab = slab_of(sources, GSD, None)
    for share, kept in ((0.6, True), (0.8, False)):
        maps = [replace(m, height=m.height + np.float32(share * slab.half)) for m in sources.maps]
        some = replace(sources, maps=[maps[0], *sources.maps[1:]])
        drawn = draw_rays(some, slab, 4000, rng)
        of_first = 4000 // len(cameras)
        assert len(drawn) == pytest.approx(4000 if kept else 4000 - of_first, abs=20)


def test_the_field_leaves_pixels_alone_that_it_was_not_asked_for_or_that_lie_elsewhere(cameras):
    sources = plane_sources(BED, cameras)
    slab = slab_of(sources, GSD, None)
    field = TensorField(slab, FieldSettings(), choose_device("torch"), WaterColumn())
    mast = sources.maps[0].height.copy()
    mast[20:30, 40:50] += 0.5
    depth_map = replace(sources.maps[0], height=mast)
    keep = np.zeros(mast.shape, dtype=bool)
    keep[10:40, 30:60] = True
    height, moved = refine(field, cameras[0], depth_map, sources.images[0], sources.water, keep)
    changed = height != mast
    assert not changed[~keep].any()
    assert not changed[20:30, 40:50].any()
    assert moved == keep.sum() - 100
    assert np.abs(height - mast)[keep].max() < 3e-3
    nothing, none = refine(field, cameras[0], depth_map, sources.images[0], sources.water, np.zeros_like(keep))
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


def test_without_a_confirmed_height_there_is_no_slab(cameras):
    sources = plane_sources(BED, cameras)
    alone = [replace(m, agreeing=np.zeros_like(m.agreeing)) for m in sources.maps]
    with pytest.raises(ValueError, match="no confirmed height lies inside the area"):
        slab_of(replace(sources, maps=alone), GSD, None)
    with pytest.raises(ValueError, match="no confirmed height lies inside the area"):
        slab_of(sources, GSD, (50.0, 50.0, 60.0, 60.0))


def test_without_a_ray_in_the_slab_nothing_is_trained(cameras, rng):
    sources = plane_sources(BED, cameras)
    elsewhere = level_slab(-3.0, half=0.05)
    with pytest.raises(ValueError, match="no pixel with a confirmed height looks into the slab"):
        train(sources, elsewhere, FieldSettings(), Schedule(0.1), choose_device("torch"), quietly)
    alone = [replace(m, agreeing=np.zeros_like(m.agreeing)) for m in sources.maps]
    with pytest.raises(ValueError, match="no pixel with a confirmed height looks into the slab"):
        draw_rays(replace(sources, maps=alone), elsewhere, 100, rng)
