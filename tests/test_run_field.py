"""The field of a run: trained in a layer about displaced heights, stored, and rendered."""

import numpy as np
import pytest
import torch
from plane_field import field_over, level_layer, plane_sources
from plane_survey import TILTED, PlaneBed, ring

from fields.models import IN_LAYER
from fields.sweep.maps import Sources
from survey.errors import SurveyError
from survey.run.stored import FIELD_SETTINGS, FIELD_STATE
from survey.run.trained_field import (
    SAMPLES,
    RestoredField,
    VolumeRecipe,
    fit,
    layer_about,
    load_layer_field,
    save_layer_field,
    steps_for,
)

BED, DRY = PlaneBed(TILTED, -2.0, 0.1), PlaneBed(None, -2.0, 0.1)
GSD = 0.03


def errors_mm(sources: Sources, field: RestoredField, bed: PlaneBed = BED) -> np.ndarray:
    """Of the field's heights at all pixels but the outermost, against the true bed."""
    found = []
    for camera in sources.cameras:
        height = field.view(camera, dry=False).bed_height
        found.append((height - bed.true_height(camera))[5:-5, 5:-5].ravel())
    return 1e3 * np.concatenate(found)


def untrained(sources: Sources) -> RestoredField:
    return field_over(layer_about(sources, GSD, None)[0], sources.water)


def recipe(model: str, steps: int) -> VolumeRecipe:
    return VolumeRecipe(model, 1, steps, seed=0, samples=SAMPLES)


@pytest.mark.slow
def test_training_brings_a_displaced_bed_back_in_both_stages():
    sources = plane_sources(BED, ring(6), shift=0.015)
    layer, photographs = layer_about(sources, GSD, None)
    assert np.median(errors_mm(sources, untrained(sources))) == pytest.approx(15.0, abs=0.5)
    shares: list[float] = []
    steps, rays = steps_for(30.0, int(layer.known.sum()))
    field, figures = fit(
        layer, photographs, recipe("mdw", steps), rays, "cpu", lambda share, errors: shares.append(share)
    )
    after = errors_mm(sources, field)
    # Half a cell off at the start.
    assert abs(np.median(after)) < 2.0
    assert after.std() < 4.0
    # Bed at rest at first; then the weighting network takes over.
    assert figures.changed_at[0] == pytest.approx(0.3 * steps, abs=1)
    assert figures.changed_at[0] < figures.changed_at[1] < steps - 50
    assert figures.psnr_db > 45.0  # of photographs rounded to 8 bits: 58 dB at best
    assert len(shares) == steps


@pytest.mark.parametrize(("model", "bed"), [*((name, BED) for name in IN_LAYER), ("mdw", DRY)])
def test_every_model_of_layers_learns_colours_first_and_then_moves_the_bed(model, bed):
    sources = plane_sources(bed, ring(3))
    layer, photographs = layer_about(sources, GSD, None)
    start = field_over(layer, sources.water, model=model)
    field, figures = fit(layer, photographs, recipe(model, 12), 256, "torch")
    assert (field.renderer.column is None) == (bed is DRY)
    assert figures.changed_at == (3,)
    # Medians of the true heights, bilinear over tilted cells.
    assert np.abs(errors_mm(sources, start, bed)).max() < 3.0
    before, after = (each.renderer.model.state_dict() for each in (start, field))
    for name in ("log_width", "regression.coarse.bias", "colour.last.bias"):
        assert not torch.equal(before[name], after[name])


def test_of_photographs_count_the_pixels_whose_height_lies_in_the_layer():
    sources = plane_sources(BED, ring(3))
    sources.maps[1].height[10:20, 30:50] += 0.5
    sources.maps[1].agreeing[30:, :] = 0
    _, photographs = layer_about(sources, GSD, None)
    used = np.zeros(sources.maps[1].height.shape, dtype=bool)
    used.flat[photographs.pixels[1]] = True
    assert not used[10:20, 30:50].any()
    assert not used[30:].any()
    assert used[:10].all()
    area = (-0.2, -0.2, 0.2, 0.2)
    layer, cropped = layer_about(sources, GSD, area)
    assert (layer.size[:2] < 0.4 + 4.0 * GSD).all()
    assert 0 < len(cropped.pixels[0]) < len(photographs.pixels[0])
    with pytest.raises(SurveyError, match="no confirmed height lies inside the area"):
        layer_about(sources, GSD, (50.0, 50.0, 51.0, 51.0))


@pytest.mark.parametrize(
    ("known", "per_cell", "expected"),
    [(1000, 30.0, (300, 2048)), (40_000, 30.0, (300, 4000)), (400_000, 30.0, (733, 16384)), (2e6, 30.0, (916, 65536))],
)
def test_steps_draw_the_rays_that_each_cell_is_promised(known, per_cell, expected):
    steps, rays = steps_for(per_cell, int(known))
    assert (steps, rays) == expected
    assert steps * rays >= per_cell * known


GIVEN = {"absorption": (0.3, 0.1, 0.05), "veil": (0.0, 0.1, 0.2)}


@pytest.mark.parametrize(("bed", "given"), [(BED, {}), (DRY, {}), (BED, GIVEN)], ids=["wet", "dry", "given"])
def test_a_field_comes_back_bit_for_bit(tmp_path, bed, given):
    field = field_over(level_layer(-2.0, slope_x=0.1), bed.water, **given)
    field.renderer.model.regression.switch_to_fine()
    with torch.no_grad():
        for parameter in field.renderer.parameters():
            parameter.add_(0.1 * torch.randn(parameter.shape))
    save_layer_field(tmp_path, field)
    back = load_layer_field(tmp_path, bed.water, "torch")
    assert sorted(path.name for path in tmp_path.iterdir()) == [FIELD_SETTINGS, FIELD_STATE]
    assert (back.renderer.column is None) == (bed is DRY)
    for dry in (False, True):
        one, other = (each.view(ring(1)[1], dry) for each in (field, back))
        np.testing.assert_array_equal(one.rgb, other.rgb)
        np.testing.assert_array_equal(one.bed_height, other.bed_height)


def flipped(data: bytes) -> bytes:
    middle = len(data) // 2
    return data[:middle] + bytes(b ^ 0xFF for b in data[middle : middle + 16]) + data[middle + 16 :]


@pytest.mark.parametrize("name", [FIELD_SETTINGS, FIELD_STATE])
@pytest.mark.parametrize(
    "damage", [lambda data: data[: len(data) // 2], lambda data: b"", lambda data: b"not a field at all", flipped, None]
)
def test_a_damaged_or_missing_file_is_named(tmp_path, name, damage):
    save_layer_field(tmp_path, field_over(level_layer(-2.0), TILTED))
    path = tmp_path / name
    if damage is None:
        path.unlink()
    else:
        path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(SurveyError, match=name) as info:
        load_layer_field(tmp_path, TILTED, "torch")
    assert "\n" not in str(info.value)
