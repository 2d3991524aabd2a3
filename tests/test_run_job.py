"""What the stages of a run depend on."""

from __future__ import annotations

import pytest
from small_survey import small_survey

from survey.folder.survey import load_survey
from survey.plan.choices import Choices
from survey.progress import opened
from survey.run.job import Job

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
            return Job(load_survey(folder), Choices(), progress).hash_of_part("water_settings")

    assert (settings("plain", None) != settings("other", key)) == matters
