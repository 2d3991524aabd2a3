"""A level that changes after a run: by little, the points are moved, by more the bed is searched again."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from drawn_runs import drawn, process_quietly

from survey.adjust.result.adjustment import read_adjustment
from survey.compare.comparison import CompareOptions, compare_surfaces
from survey.folder.survey import load_survey
from survey.run.folder import RunDir
from survey.run.products import TOLERANCES_M
from survey.run.stages import MOST_RAISED_M
from survey.run.stored import StoredBed, load_bed

LEVEL = re.compile(r"level_m = ([\d.]+)")
# Of what a search under the new level finds otherwise; measured 1 to 6 % of how far points move.
SHARE = 0.09


def with_level(folder: Path, raised_m: float) -> Path:
    """The survey with another level."""
    path = folder / "survey.toml"
    text = path.read_text(encoding="utf-8")
    path.write_text(LEVEL.sub(lambda found: f"level_m = {float(found[1]) + raised_m:.4f}", text, count=1), "utf-8")
    return folder


def bed_and_searches(folder: Path, **options) -> tuple[StoredBed, dict[str, str]]:
    """The bed of the latest run of a survey, and the folders of its stages by name."""
    process_quietly(folder, **options)
    run = RunDir(folder / "bathynerf")
    return load_bed(run.load_stage("bed")), run.result()["stages"]


@pytest.fixture(scope="module")
def first(tmp_path_factory) -> Path:
    """A survey that has been processed."""
    folder = tmp_path_factory.mktemp("level") / "survey"
    drawn(folder)
    process_quietly(folder)
    return folder


def test_an_adjusted_survey_keeps_its_windows_and_is_not_searched_again(tmp_path):
    folder = tmp_path / "survey"
    drawn(folder)
    settings = folder / "survey.toml"
    text = settings.read_text(encoding="utf-8").replace("[cameras]", "[cameras]\nposition_std_m = [0.02, 0.02, 0.02]")
    settings.write_text(text, "utf-8")
    before, stages = bed_and_searches(folder)
    run = RunDir(folder / "bathynerf")
    cloud, level = run.cloud_path.read_bytes(), read_adjustment(run.path).parameter("level_m")
    windows = (run.load_stage("adjust") / "windows0.npz").read_bytes()
    # The second one begins with the first run, too.
    for raised in (0.02, 0.04):
        moved, kept = bed_and_searches(with_level(folder, 0.02))
        assert {name for name in kept if stages.get(name) != kept[name]} == {"adjust", "adjust_before", "bed"}
        assert kept["adjust_before"] == stages["adjust"]
        assert (run.load_stage("adjust") / "windows0.npz").read_bytes() == windows
        found = read_adjustment(run.path).parameter("level_m")
        assert found.given == pytest.approx(level.given + raised)
        assert found.value - level.value == pytest.approx(raised * (found.std / level.given_std) ** 2, rel=0.2)
    assert (np.abs(moved.points_crs - before.points_crs).max(axis=1) > 1e-4).mean() > 0.9
    process_quietly(with_level(folder, -0.04))
    assert run.cloud_path.read_bytes() == cloud


def test_by_little_the_points_are_moved_and_compared_anew_and_by_more_the_bed_is_searched_again(first, tmp_path):
    before, stages = bed_and_searches(first)
    cloud = RunDir(first / "bathynerf").cloud_path.read_bytes()
    folder = with_level(shutil.copytree(first, tmp_path / "survey"), MOST_RAISED_M)
    truth = folder / "truth" / "reference.ply"
    moved, kept = bed_and_searches(folder, reference=truth)
    assert {name for name in stages if stages[name] != kept[name]} == {"bed"}
    run = RunDir(folder / "bathynerf")
    options = CompareOptions(tolerances_m=TOLERANCES_M, bounds=load_survey(folder).bounds)
    compared = json.loads(run.report_json_path.read_text(encoding="utf-8"))["comparison"]
    distances = compare_surfaces(run.cloud_path, truth, options).figures.distances
    assert compared["mean_m"] == pytest.approx(distances.mean_m)

    beyond = 1.01
    searched, other = bed_and_searches(with_level(folder, (beyond - 1.0) * MOST_RAISED_M))
    assert not (set(stages.values()) | set(kept.values())) & set(other.values())
    middle = [float(np.median(found.points_crs[:, 2])) for found in (before, moved, searched)]
    # Straight down the bed sinks by (n - 1) of what the water rises.
    assert middle[2] - middle[0] == pytest.approx(-0.333 * beyond * MOST_RAISED_M, rel=0.5)
    assert abs(beyond * (middle[1] - middle[0]) - (middle[2] - middle[0])) < SHARE * abs(middle[2] - middle[0])
    np.testing.assert_allclose(np.median(moved.bed.depth), np.median(searched.bed.depth), atol=2e-3)
    assert (moved.bed.std >= before.bed.std).all()
    assert np.median(moved.bed.std) > np.median(before.bed.std)

    process_quietly(with_level(folder, -beyond * MOST_RAISED_M))
    assert run.cloud_path.read_bytes() == cloud
