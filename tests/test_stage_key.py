"""What the stages of a run depend on: keys, and the settings that are in them."""

import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from small_survey import small_survey

from survey.errors import SurveyError
from survey.folder.survey import load_survey
from survey.plan.choices import USUAL
from survey.plan.plan import make_plan
from survey.progress import opened
from survey.run.job import Job
from survey.stage_key import code_hash, stage_key

ROOT = Path(__file__).resolve().parent.parent


@dataclass(frozen=True)
class Settings:
    hypotheses: int = 64
    step_px: float = 0.5


def test_keys_tell_apart_what_differs_and_only_that(tmp_path):
    image = tmp_path / "a.jpg"
    image.write_bytes(b"pixels")
    different = [
        (),
        (1,),
        (1.0,),
        ("1",),
        (True,),
        (None,),
        ("a", "b"),
        (("a", "b"),),
        ("ab",),
        ({"a": "b"},),
        (Settings(),),
        (Settings(hypotheses=65),),
        ({"hypotheses": 64, "step_px": 0.5},),
        (np.array([1.0, 2.0]),),
        (np.array([1.0, 2.0], dtype=np.float32),),
        (np.array([[1.0, 2.0]]),),
        (image,),
        ([image, image],),
        (tmp_path,),
    ]
    keys = [stage_key(*parts) for parts in different]
    assert len(set(keys)) == len(keys)
    assert keys == [stage_key(*parts) for parts in different]
    assert stage_key({"a": 1, "b": 2}) == stage_key({"b": 2, "a": 1})
    assert stage_key(np.float64(0.1), np.arange(6).reshape(2, 3).T) == stage_key(
        0.1, np.ascontiguousarray(np.arange(6).reshape(2, 3).T)
    )


def test_a_key_changes_with_every_byte_of_a_file_but_not_with_its_place_or_time(tmp_path):
    image, copy = tmp_path / "a.jpg", tmp_path / "copy" / "a.jpg"
    pixels = bytes(2 << 20)
    image.write_bytes(pixels)
    first = stage_key(image)
    copy.parent.mkdir()
    copy.write_bytes(pixels)
    os.utime(copy, ns=(0, 0))
    assert stage_key(copy) == first
    copy.write_bytes(pixels[:-1] + b"1")
    os.utime(copy, ns=(0, 0))
    assert stage_key(copy) != first


def test_a_key_of_a_file_that_is_gone_names_it(tmp_path):
    with pytest.raises(SurveyError, match=r"cannot read .*gone\.jpg"):
        stage_key(tmp_path / "gone.jpg")


@pytest.mark.parametrize("part", [{1, 2}, object(), np.array([None])])
def test_parts_without_a_fixed_form_are_refused(part):
    with pytest.raises(TypeError, match="stage_key got"):
        stage_key(part)


CODE = (
    "import bathynerf, sys; from bathynerf import load_survey; from survey.stage_key import code_hash;"
    "print(code_hash()); print(sys.modules['survey'].__file__)"
)


def test_the_hash_of_the_code_is_that_of_its_files_wherever_they_lie(tmp_path):
    first = code_hash()
    for name in ("refract", "geo", "evaluation", "fields", "survey", "bathynerf"):
        shutil.copytree(ROOT / name, tmp_path / "copy" / name, ignore=shutil.ignore_patterns("__pycache__"))
        # Folders of these names in the working directory are not in the way.
        (tmp_path / name).mkdir()
        (tmp_path / name / "notes.txt").write_text("no package")
    environment = {**os.environ, "PYTHONPATH": str(tmp_path / "copy"), "PYTHONSAFEPATH": "1"}

    def hash_there() -> str:
        command = [sys.executable, "-c", CODE]
        found = subprocess.run(command, capture_output=True, text=True, check=True, cwd=tmp_path, env=environment)
        assert found.stdout.splitlines()[1].startswith(str(tmp_path / "copy"))
        return found.stdout.splitlines()[0]

    assert hash_there() == first
    for old, new in (("PEERS = 12", "PEERS = 13"), ("PEERS = 13", "PEERS = 12")):
        path = tmp_path / "copy" / "fields" / "sweep" / "fusion.py"
        path.write_text(path.read_text().replace(old, new))
        assert (hash_there() == first) is (new == "PEERS = 12")


COLOUR = "absorption_per_m = [0.3, 0.07, 0.05]\nveiling_light = [0.0, 0.1, 0.2]"


@pytest.mark.parametrize(
    ("key", "matters"), [("level_std_m = 0.02", True), ("index_std = 0.001", True), (COLOUR, False)]
)
def test_the_settings_of_the_water_count_for_the_adjustment_and_its_colour_does_not(tmp_path, key, matters):
    def settings(name: str, toml: str | None) -> str:
        folder = small_survey(tmp_path / name)
        text = (folder / "survey.toml").read_text()
        if toml is not None:
            (folder / "survey.toml").write_text(text.replace("[water]\n", f"[water]\n{toml}\n"))
        with opened() as progress:
            survey = load_survey(folder)
            return Job(survey, USUAL, make_plan(survey), progress).hash_of_part("water_settings")

    assert (settings("plain", None) != settings("other", key)) == matters
