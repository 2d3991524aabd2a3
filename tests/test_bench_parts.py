"""Parts of benchmarks: what they draw, measure and write."""

import re
from dataclasses import replace
from importlib import import_module

import bench_drawn
import bench_picture_bound
import bench_random
import bench_solver
import condition_scenes
import numpy as np
import pytest
import tables
from method_cases import drawn_names
from method_records import METHODS, Cost, Errors, Record, read_results
from PIL import Image

from survey.simulate.drawn import DrawnScene, stage_drawing


@pytest.fixture(scope="module")
def still():
    scene = stage_drawing(DrawnScene.tiny(image_px=(40, 30), focal_px=70.0, objects=False))
    return replace(scene, sensor=replace(scene.sensor, samples=1))


@pytest.mark.parametrize(
    ("name", "value"), [("foam", 0.2), ("people", 40.0), ("ripples", 0.1), ("focal_drift", 0.01), ("shadow", 0.5)]
)
def test_photographs_differ_from_each_other_and_the_truth_does_not(still, name, value):
    # The same camera twice: what is left between both is what moved.
    twice = replace(still, cameras=(still.cameras[0],) * 3)
    changed = getattr(condition_scenes, name)(twice, value)
    assert changed.renderer is twice.renderer
    first, later = (changed.photograph(index).astype(float) for index in (0, 2))
    calm = twice.photograph(0).astype(float)
    if name == "shadow":
        # It goes with the camera, and two photographs of one camera are the same.
        np.testing.assert_array_equal(first, later)
        assert (first < calm - 5.0).any(axis=2).sum() in range(1, calm[..., 0].size)
    else:
        assert np.abs(first - later).max() > 5.0


def test_the_median_of_a_burst_is_nearer_to_still_water_than_its_photographs(still):
    place = replace(still, cameras=still.cameras[:2])
    burst, calm = condition_scenes.bursts(place, 5.0), place.photograph(1).astype(float)
    assert [len(each.cameras) for each in (burst, condition_scenes.medians(place, 5.0))] == [10, 2]
    off = [np.abs(burst.photograph(k) - calm).mean() for k in range(5, 10)]
    assert np.abs(condition_scenes.medians(place, 5.0).photograph(1) - calm).mean() < min(off)


def test_foam_covers_what_it_is_asked_to(still):
    eye = condition_scenes.foam(still, 0.2).of_photograph(still, 1).radiance_of
    x, y = (v.ravel() for v in np.meshgrid(np.linspace(-5.0, 5.0, 90), np.linspace(-5.0, 5.0, 90)))
    down = np.tile([0.0, 0.0, -1.0], (len(x), 1))
    above = np.column_stack([x, y, np.full(len(x), 5.0)])
    covered = (eye(above, down, 0) != still.renderer.radiance_of_rays(above, down)).any(axis=1)
    # Flecks of a patch overlap.
    assert 0.08 < covered.mean() < 0.22


def test_rows_of_a_zone_are_read_at_once(still):
    camera = replace(still.cameras[0], motion=np.array([0.01, 0.0, 0.0]))
    scene = replace(still, cameras=(camera,))
    at = []
    scene = replace(scene, radiance_of=lambda origin, direction, seed: at.append(origin) or np.zeros_like(direction))
    condition_scenes.zones(scene, 3.0).photograph(0)
    # 30 rows in three zones; their middles are 10 rows apart.
    late = np.unique(np.round((np.concatenate(at)[:, 0] - camera.centre[0]) / 0.01, 6))
    np.testing.assert_allclose(late, np.array([5.0, 15.0, 25.0]) - camera.cy)


def test_brown_water_takes_the_contrast_of_deep_ground(still):
    clear, brown = (scene.photograph(0).astype(float) for scene in (still, condition_scenes.brown(still, 2.0)))
    assert brown.std(axis=(0, 1)).max() < 0.5 * clear.std(axis=(0, 1)).max()


def test_a_seed_is_always_the_same_survey_and_another_seed_another():
    drawn = [str(bench_random.RandomSurvey.of(seed)) for seed in range(40)]
    assert drawn == [str(bench_random.RandomSurvey.of(seed)) for seed in range(40)]
    assert len(set(drawn)) == 40
    assert {word for word in bench_random.CHANGES for text in drawn if f"then {word}" in text} == set(
        bench_random.CHANGES
    )


def test_relief_goes_on_below_that_of_other_drawn_beds():
    random = bench_random.RandomSurvey(replace(DrawnScene.tiny(), cell_m=0.0125), 2.0, 0.0, None, 0.0)
    plain = stage_drawing(random.scene).renderer.ground.bed
    added = random._staged().renderer.ground.bed.heights - plain.heights
    # Spacings of 10, 5, 2.5 and 1.25 cm, each by a tenth of it.
    assert added.std() == pytest.approx(0.1 * np.hypot(np.hypot(0.1, 0.05), np.hypot(0.025, 0.0125)), rel=0.3)


def test_what_the_plain_gauss_newton_leaves_out_is_there():
    names = re.findall(r'patch\(\s*"([^"]+)"', bench_solver.PLAIN)
    assert len(names) == 2
    for name in names:
        module, _, function = name.rpartition(".")
        assert callable(getattr(import_module(module), function))


def test_noise_has_its_square_and_a_level_picture_is_stored_as_it_is(tmp_path, rng):
    path = tmp_path / "level.jpg"
    Image.new("RGB", (203, 155), (128, 128, 128)).save(path, quality=95, subsampling=0)
    noise, jpeg, both = bench_picture_bound.squared_errors(path, 2.0, rng)
    # Rounding adds a twelfth; the standard deviation of a mean of 90,000 squares is half a percent.
    assert noise == pytest.approx(4.0 + 1.0 / 12.0, rel=0.03)
    assert jpeg == 0.0
    # Quantization takes a part of the noise away with the finest detail, and adds its own.
    assert 0.5 < both < 8.0


def test_a_coarser_table_costs_more(tmp_path, rng):
    texture = rng.integers(60, 200, (80, 80, 3)).astype(np.uint8)
    errors = []
    for quality in (95, 60):
        path = tmp_path / f"{quality}.jpg"
        Image.fromarray(texture).save(path, quality=quality, subsampling=0)
        errors.append(bench_picture_bound.squared_errors(path, 0.0, rng)[1])
    assert 0.0 < 2.0 * errors[0] < errors[1]


def _record(method: str, quality: str, processor_s: float, error_m: float, case: str = "drawn_2_oblique_20") -> Record:
    shares = {"0.05": 0.9, "0.1": 0.95, "0.2": 0.99}
    errors = Errors(1000, 0.0, error_m, 2.0 * error_m, shares, 0.95, 0.001, 0.002)
    return Record(case, method, quality, "given", "cpu", 0, (Cost(1.5 * processor_s, processor_s, 10**9),), errors)


def test_the_surveys_of_all_parts_can_be_drawn():
    words = [word for part in bench_drawn.PARTS.values() for word in part.drawn]
    assert drawn_names(words) == words
    assert {word.split(",")[0] for word in words} == set(bench_drawn.MARKERS)
    assert set(bench_drawn.COLOURS) == set(METHODS)


def test_a_table_has_a_row_for_each_record_and_the_picture_is_drawn(tmp_path):
    records = (
        _record("full", "draft", 20.0, 0.005),
        _record("full", "standard", 40.0, 0.004),
        _record("straight", "draft", 30.0, 0.4),
        _record("full", "draft", 60.0, 0.01, "drawn_8_nadir_130"),
    )
    lines = bench_drawn.table(records)
    assert len(lines) == 2 + len(records)
    assert len({line.count("|") for line in lines}) == 1
    assert [line.endswith("| * |") for line in lines[2:]] == [True, True, False, True]
    # The stds of a cloud over straight rays are those of its apparent depths: they say nothing of its errors.
    assert "95 %" in lines[2]
    assert "95 %" not in lines[4]
    bench_drawn.draw(tmp_path / "front.png", records)
    assert (tmp_path / "front.png").read_bytes().startswith(b"\x89PNG")


def test_the_legend_has_what_was_measured_alone():
    labels = [label for label, *_ in bench_drawn.legend_of([_record("full", "draft", 20.0, 0.005)])]
    assert labels == ["whole chain", "2 m deep", "20 photographs", "hollow: draft", "filled: standard"]


def test_the_published_results_can_be_read():
    assert read_results(bench_drawn.PUBLISHED).records


def test_pages_have_the_tables_of_the_results():
    for (page, name), lines in tables.tables().items():
        begin, end = tables.marks(name)
        text = page.read_text(encoding="utf-8")
        assert text[text.index(begin) + len(begin) : text.index(end)].strip().split("\n") == lines, (page, name)


def test_a_table_stands_between_its_marks_and_the_rest_of_the_page_stays(tmp_path):
    (begin, end), page = tables.marks("drawn"), tmp_path / "page.md"
    page.write_text(f"before\n{begin}\nold table\n{end}\nafter\n")
    tables.publish(page, "drawn", ["| new |"])
    assert page.read_text() == f"before\n{begin}\n\n| new |\n\n{end}\nafter\n"
    with pytest.raises(SystemExit, match="has no lines"):
        tables.publish(page, "other", [])


def test_a_shutter_is_said_with_what_it_does_to_heights():
    rolling = {"check_up_m": [0.03, -0.03], "readout_s": 0.0021, "std_s": 0.0012}
    said = " ".join(tables.shutter_rows({"global": {"check_up_m": [0.04, 0.04]}, "rolling": rolling}))
    assert "answers 2.1 ms ± 1.2 ms" in said
    assert "an rms of 40 mm with a global shutter and 30 mm with that" in said


def test_a_target_with_wrong_coordinates_does_not_count():
    sound = {"off_m": [0.01, 0.0, -0.02], "std_m": [0.02, 0.02, 0.02], "marks": 3}
    wrong = {"off_m": [0.8, -2.0, -5.0], "std_m": [0.02, 0.02, 0.2], "marks": 2}
    lines = tables.target_rows({"targets": {"a": sound, "b": wrong}, "warnings": []})
    assert "| wrong coordinates |" in lines[3]
    assert "Heights of 1 of 1 sound targets" in " ".join(lines)
