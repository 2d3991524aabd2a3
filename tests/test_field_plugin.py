"""Radiance fields of other packages: the example of docs/own-field.md trains by its path and by an entry point."""

import re
from pathlib import Path

import pytest
from painted_survey import painted_survey, run_over

from fields.models import MODELS, maker
from survey.errors import SurveyError
from survey.volume.field import train_field
from survey.volume.options import VolumeOptions

DOCS = Path(__file__).resolve().parents[1] / "docs"
PAGE, OWN = ((DOCS / f"{name}.md").read_text(encoding="utf-8") for name in ("field", "own-field"))


@pytest.fixture
def package(tmp_path, monkeypatch):
    """The example as an installed package: a module, and metadata with its entry point."""
    (code,) = re.findall(r'```python\n(""".*?)```', OWN, re.DOTALL)
    assert len(code.splitlines()) < 60
    (tmp_path / "my_fields.py").write_text(code, encoding="utf-8")
    (metadata,) = re.findall(r'\[project\.entry-points\."(.*?)"\][^\n]*\n(.*?)```', OWN, re.DOTALL)
    about = tmp_path / "my_fields-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: my-fields\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(f"[{metadata[0]}]\n{metadata[1].replace(chr(34), '')}")
    monkeypatch.syspath_prepend(tmp_path)


@pytest.mark.parametrize("name", ["my_fields:VoxelGrid", "voxels"])
def test_the_example_of_the_page_trains_and_is_rendered(package, tmp_path, name):
    run = run_over(painted_survey(tmp_path / "s"), tmp_path / "run")
    options = VolumeOptions(
        model=name, steps=3, rays=32, samples=8, cells=16, held_every=4, image_scale=0.25, appearance=True
    )
    report = train_field(run, tmp_path / "f", options)
    assert report["training"]["steps"] == 3
    assert report["held_out_psnr_db"]
    # Read back from its folder, where training has nothing left to do.
    again = train_field(run, tmp_path / "f", options)["training"]
    assert {**again, "cpu_s": None} == {**report["training"], "cpu_s": None}


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("gaussians", r"there is no model gaussians; expected one of mdw, .*, voxels, or package.module:Class of an"),
        ("my_feelds:VoxelGrid", "cannot be imported from my_feelds:VoxelGrid: No module named 'my_feelds'"),
        ("my_fields:Voxels", "cannot be imported from my_fields:Voxels: module 'my_fields' has no attribute 'Voxels'"),
        (":VoxelGrid", "the model :VoxelGrid cannot be imported"),
    ],
)
def test_a_name_that_stands_for_no_model_is_refused(package, name, said):
    with pytest.raises(SurveyError, match=said):
        VolumeOptions(model=name)


def test_what_makes_no_model_is_refused(package, tmp_path):
    run = run_over(painted_survey(tmp_path / "s"), tmp_path / "run")
    with pytest.raises(SurveyError, match=r"the model json:dumps cannot be made: Object of type Setup is not JSON"):
        train_field(run, tmp_path / "f", VolumeOptions(model="json:dumps", steps=3, cells=16, image_scale=0.25))
    with pytest.raises(SurveyError, match=r"cannot be made: .*builtins:repr is a str, expected a fields\.vol"):
        train_field(run, tmp_path / "g", VolumeOptions(model="builtins:repr", steps=3, cells=16, image_scale=0.25))


def test_the_page_lists_the_models_there_are():
    assert re.findall(r"^\| `(\w+)` \|", PAGE.partition("| `--model` |")[2].partition("\n\n")[0], re.M) == list(MODELS)
    assert all(callable(maker(name)) for name in MODELS)
