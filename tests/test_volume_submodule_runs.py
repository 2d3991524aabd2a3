"""`bathynerf field --submodules`: a field for each cell; it goes on cell by cell, and is rendered from its folder."""

import gc
import re
import shutil
import weakref
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import bathynerf
from level_field import NAME
from painted_survey import painted_survey, run_over
from PIL import Image

from bathynerf import Field
from fields.volume.submodules import Grid, match_submodule
from geo import read_cloud
from survey.errors import SurveyError
from survey.export.loaded import LoadedRun
from survey.files.json_values import read_json_object
from survey.volume.field import train_field
from survey.volume.options import VolumeOptions
from survey.volume.scene import BedBox
from survey.volume.submodules import StoredVolume, SubmoduleViews

PAPERS = Path(__file__).resolve().parent.parent / "docs" / "papers.md"
OPTIONS = VolumeOptions(
    model=NAME, steps=2, rays=32, samples=8, cells=16, image_scale=0.5, held_every=4, submodules="2x1", drop="network"
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A run ``run`` with submodules ``f``, and the photographs' own cameras rendered in ``f/views``."""
    folder = tmp_path_factory.mktemp("submodules")
    run = run_over(painted_survey(folder / "s"), folder / "run")
    train_field(run, folder / "f", replace(OPTIONS, cameras=folder / "s" / "cameras.csv"))
    return folder


def ground_of(folder) -> BedBox:
    with LoadedRun(folder / "run") as run:
        return BedBox.of_run(run, run.flight, OPTIONS)


def test_each_cell_has_a_field_of_its_own_and_the_points_on_its_ground(folder):
    report, ground = read_json_object(folder / "f" / "report.json"), ground_of(folder)
    assert set(report["submodules"]) == {"0_0", "1_0"}
    assert report["held_out_psnr_db"].keys() == {"0000.png"}
    assert report["dropped"] == {"0000.png": {}}
    assert "held out" in Field(folder / "f")._repr_html_()
    with LoadedRun(folder / "run") as run:
        points = run.flight.frame.local_from_crs(read_cloud(folder / "f" / "cloud.las").points)
    owner = Grid(ground.box, (2, 1)).owner(points)
    found = [report["submodules"][name]["points"] for name in ("0_0", "1_0")]
    assert np.bincount(owner).tolist() == found
    assert report["points"] == sum(found) > 100
    for name in ("0_0", "1_0"):
        assert report["submodules"][name]["box_m"][0] == pytest.approx(0.625 * ground.box.size[0])


def test_it_goes_on_with_the_cell_that_is_missing(folder):
    shutil.copytree(folder / "f", folder / "again")
    kept, missing = (folder / "again" / "submodules" / name / "state.pt" for name in ("0_0", "1_0"))
    missing.unlink()
    # Training would not lead to this number.
    state = torch.load(kept, weights_only=True)
    mark = next(iter(state["renderer"].values())).view(-1)
    mark[0] += 1e-6
    torch.save(state, kept)
    report = train_field(folder / "run", folder / "again", OPTIONS)
    after = torch.load(kept, weights_only=True)
    torch.testing.assert_close(after["renderer"], state["renderer"], rtol=0.0, atol=0.0)
    before, after = (torch.load(f / "submodules" / "1_0" / "state.pt", weights_only=True)["renderer"]
                     for f in (folder / "f", folder / "again"))  # fmt: skip
    torch.testing.assert_close(before, after, rtol=0.0, atol=0.0)
    assert report["points"] == read_json_object(folder / "f" / "report.json")["points"]


@pytest.mark.parametrize("drop", ["geometry", "none"])
def test_views_are_rendered_from_the_folder(folder, drop):
    with LoadedRun(folder / "run") as run:
        stored, view = StoredVolume.of_run(folder / "f", run), run.flight.views[1]
    seen = replace(stored, drop=drop).load("torch")(view.camera, False)
    with Image.open(folder / "f" / "views" / "0001.png") as picture:
        before = np.asarray(picture)
    both = seen.seen & (before[..., 3] > 0)
    assert both.mean() > 0.3
    # Either submodule is seen, so that none is dropped.
    assert np.abs(seen.rgb.astype(int) - before[..., :3])[both].max() <= 1
    assert not np.array_equal(stored.load("torch")(view.camera, True).rgb, seen.rgb)


def test_all_submodules_get_the_look_of_the_one_in_the_middle(folder, monkeypatch):
    loaded, in_memory, load = [], [], SubmoduleViews.load

    def counted(self, number):
        found = load(self, number)
        loaded.append(weakref.ref(found.renderer))
        return found

    def give(*of):
        gc.collect()
        in_memory.append(sum(each() is not None for each in loaded))
        return match_submodule(*of, steps=2)

    monkeypatch.setattr(SubmoduleViews, "load", counted)
    monkeypatch.setattr("fields.volume.submodules.match_submodule", give)
    options = replace(OPTIONS, model="vm", appearance=True, shell=True, drop="geometry", submodules="3x1", steps=1)
    train_field(folder / "run", folder / "looks", options)
    assert in_memory == [2, 2]
    looks = read_json_object(folder / "looks" / "submodules" / "looks.json")
    assert looks.keys() == {"0_0", "1_0", "2_0"}
    own = torch.load(folder / "looks" / "submodules" / "1_0" / "state.pt", weights_only=True)["renderer"]
    assert looks["1_0"] == pytest.approx(own["appearance.weight"][0].tolist())
    assert looks["0_0"] != looks["2_0"]
    assert "background.network.0.weight" in own


def test_views_of_many_submodules_hold_two_in_memory(folder, monkeypatch):
    options = replace(OPTIONS, submodules="3x1", drop="none", steps=1)
    train_field(folder / "run", folder / "three", options)
    alive, most, load = [], [], SubmoduleViews.load

    def counted(self, number):
        found = load(self, number)
        alive.append(weakref.ref(found.renderer))
        gc.collect()
        most.append(sum(each() is not None for each in alive))
        return found

    monkeypatch.setattr(SubmoduleViews, "load", counted)
    with LoadedRun(folder / "run") as run:
        stored, view = StoredVolume.of_run(folder / "three", run), run.flight.views[1]
        view_of = replace(stored, drop="none").load("torch")
        for _ in range(2):
            view_of(view.camera, False)
    assert len(most) == 6
    assert max(most) == 2


def test_cells_without_a_bed_are_named_and_left_out(folder, monkeypatch):
    real = BedBox.within
    first = lambda self, box, cells: None if box.low[0] == self.box.low[0] else real(self, box, cells)  # noqa: E731
    monkeypatch.setattr(BedBox, "within", first)
    report = train_field(folder / "run", folder / "half", replace(OPTIONS, drop="geometry"))
    assert report["left_out"] == {"0_0": "the run has no bed there"}
    assert report["submodules"].keys() == {"1_0"}
    assert [each.name for each in (folder / "half" / "submodules").iterdir()] == ["1_0"]
    monkeypatch.setattr(BedBox, "within", lambda self, box, cells: None)
    with pytest.raises(SurveyError, match="none of 2 submodules has enough photographs; ask for fewer --submodules"):
        train_field(folder / "run", folder / "nothing", OPTIONS)


def test_one_that_is_begun_or_half_trained_is_said_to_be(folder, tmp_path):
    shutil.copytree(folder / "f", tmp_path / "f")
    first, second = (tmp_path / "f" / "submodules" / name / "state.pt" for name in ("0_0", "1_0"))
    first.unlink()
    torch.save(torch.load(second, weights_only=True) | {"step": 1}, second)
    with LoadedRun(folder / "run") as run:
        stored, said = StoredVolume.of_run(tmp_path / "f", run), []
        stored.load("torch", said.append)
        assert len(said) == 2
        assert said[0].startswith("1 of 2 cells of ")
        assert said[1].endswith("1_0 has done 1 of 2 steps so far")
        second.unlink()
        with pytest.raises(SurveyError, match=r"nothing of the field in .* is trained yet"):
            stored.load("torch")
        whole = []
        StoredVolume.of_run(folder / "f", run).load("torch", whole.append)
        assert whole == []


def test_cells_too_small_for_the_photographs_are_refused_before_any_folder(folder):
    with pytest.raises(SurveyError, match=r"999x999 makes cells of .* m; ask for .* at most, or give smaller --cells"):
        train_field(folder / "run", folder / "tiny", replace(OPTIONS, submodules="999x999"))
    assert not (folder / "tiny" / "submodules").exists()


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"submodules": "2x0"}, "submodules is 2x0, expected a number, or 3x2"),
        ({"submodules": "two"}, "submodules is two, expected a number"),
        ({"drop": "all"}, 'drop is "all", expected geometry, network or none'),
    ],
)
def test_options_without_sense_are_refused(wrong, said):
    with pytest.raises(SurveyError, match=said):
        VolumeOptions(**wrong)


def test_the_command_of_the_tidal_flat_runs(folder):
    """That of docs/papers.md, with a smaller model, fewer cells and fewer photographs."""
    (command,) = re.findall(r"^\| tidal flat \| `bathynerf (field RUN .*?)`", PAPERS.read_text(encoding="utf-8"), re.M)
    (folder / "one.csv").write_text("\n".join((folder / "s" / "cameras.csv").read_text().splitlines()[:2]) + "\n")
    given = {"RUN": folder / "run", "DIR": folder / "c", "poses.csv": folder / "one.csv"}
    given |= {"3x2": "2x1", "8": 4, "nerf": "vm"}
    small = ("--steps", 1, "--rays", 32, "--samples", 4, "--cells", 16, "--image-scale", 0.25)
    found = bathynerf(*(given.get(word, word) for word in command.split()), *small)
    assert found.exit_code == 0, found.stderr
    assert "submodules" in found.stdout
    report = read_json_object(folder / "c" / "report.json")
    assert report["dropped"].keys() == report["held_out_psnr_db"].keys() == {"0000.png"}
    with Image.open(folder / "c" / "views" / "0000.png") as picture:
        # The shell shows what lies beyond the bed.
        assert (np.asarray(picture)[..., 3] == 255).all()
    assert (folder / "c" / "views" / "0000_distance.tif").is_file()
