"""A small run as the viewer has it."""

from __future__ import annotations

from pathlib import Path

from small_bed import plane_bed
from small_survey import small_survey

from survey.folder.survey import load_survey
from survey.run.flight import Flight
from survey.viewer.shown import Shown
from survey.viewer.tree import build_tree


def shown_of(folder: Path, num: int = 300) -> Shown:
    """The plane of `small_bed` over the small survey, ready to be shown."""
    survey = load_survey(small_survey(folder))
    bed = plane_bed(survey, num=num)
    columns = {"height": bed.xyz[:, 2], "std": bed.std, "depth": bed.depth}
    flight = Flight(survey.frame, survey.water, survey.views, None)
    return Shown(folder, "small", build_tree(bed.xyz), bed.rgb, columns, flight, True, 0.1)
