"""`--true-colour` from end to end: a drawn shore, whose colours without water are known."""

from dataclasses import replace

import numpy as np
import pytest
from drawn_runs import GSD, SMALL, DrawnRun, drawn

from fields.image_store import GAMMA
from survey.errors import SurveyError
from survey.progress import Progress
from survey.run.process import process
from survey.run.stored import StoredBed, load_bed
from survey.simulate.drawn import stage_drawing

# Runs of a drawn survey.
pytestmark = pytest.mark.slow

# Points further from the true bed than this [m] may have the colour of something else.
ON_THE_BED_M = 0.03


def processed(run: DrawnRun, *, true_colour: bool) -> StoredBed:
    with Progress(verbosity=-1):
        assert process(run.folder, field="off", true_colour=true_colour) == 0
    return load_bed(run.run.load_stage("bed"))


def dry_light(run: DrawnRun, points_crs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Linear radiance (N, 3) of the bed in dry air over a pixel about points, and which points lie on it."""
    staged = stage_drawing(replace(run.scene, water=False))
    above = staged.frame.local_from_crs(points_crs) + np.array([0.0, 0.0, 0.15])
    down = np.tile([0.0, 0.0, -1.0], (len(above), 1))
    rng, light, count = np.random.default_rng(0), np.zeros((len(above), 3)), 8
    for _ in range(count):
        aside = np.column_stack([GSD * rng.uniform(-0.5, 0.5, (len(above), 2)), np.zeros(len(above))])
        light += staged.renderer.radiance_of_rays(above + aside, down) / count
    found = staged.renderer.trace_rays(above, down).points[:, 2]
    return light, np.abs(found - above[:, 2] + 0.15) < ON_THE_BED_M


def spread(stored: StoredBed, light: np.ndarray, keep: np.ndarray) -> np.ndarray:
    """Half the distance (3,) between the 16 and 84 % of the logarithm of the colours over the true ones."""
    ratio = np.log(np.maximum((stored.bed.rgb[keep] / 255.0) ** GAMMA, 1e-3) / light[keep])
    return 0.5 * (np.quantile(ratio, 0.84, axis=0) - np.quantile(ratio, 0.16, axis=0))


@pytest.fixture(scope="module")
def shore(tmp_path_factory):
    small = {"size_m": (2.2, 2.2), "image_px": (144, 120), "num_views": 8}
    with pytest.MonkeyPatch.context() as patch:
        # Half of the time of so small a survey.
        patch.setattr("survey.run.products.write_report", lambda *_: {"height_std_m": None})
        yield drawn(tmp_path_factory.mktemp("shore") / "survey", shore=True, **small)


def test_beds_of_one_colour_agree_at_every_depth_without_their_water(shore):
    raw, true = (processed(shore, true_colour=wanted) for wanted in (False, True))
    np.testing.assert_array_equal(true.bed.xyz, raw.bed.xyz)
    light, on_bed = dry_light(shore, raw.points_crs)
    keep = on_bed & raw.bed.wet & (light > 1e-3).all(axis=1)
    assert keep.sum() > 5_000
    before, after = spread(raw, light, keep), spread(true, light, keep)
    # Measured: 0.150, 0.044, 0.056 before, 0.035, 0.033, 0.038 after; the texture within a pixel alone leaves 0.033.
    assert (after < 0.9 * before).all()
    assert after[0] < 0.3 * before[0]
    np.testing.assert_array_equal(true.bed.rgb[~true.bed.wet], raw.bed.rgb[~raw.bed.wet])


def test_given_water_takes_the_place_of_an_estimate(shore):
    toml = shore.folder / "survey.toml"
    text = toml.read_text()
    given = "[water]\nabsorption_per_m = [0.0, 0.0, 0.0]\nveiling_light = [0.0, 0.0, 0.0]"
    toml.write_text(text.replace("[water]", given))
    clear = processed(shore, true_colour=True)
    toml.write_text(text)
    raw = processed(shore, true_colour=False)
    # Clear water takes nothing away: what changes is the sky in the surface, 0.69 of white times 0.02.
    linear = [(stored.bed.rgb[raw.bed.wet] / 255.0) ** GAMMA for stored in (raw, clear)]
    assert np.median(linear[0] - linear[1]) == pytest.approx(0.0139, abs=0.006)


def test_a_dry_survey_has_no_water_to_take_away(tmp_path):
    run = drawn(tmp_path / "dry", num_views=3, water=False, size_m=(1.0, 1.0))
    with pytest.raises(SurveyError, match="takes the water away, but the survey has none; leave the option out"):
        process(run.folder, true_colour=True)
    assert SMALL["depth_m"] == run.scene.depth_m
