"""A small survey with known truth, drawn without further input: for the demo and the tests.

python -m survey.simulate.drawn FOLDER [--tiny] [KEY=VALUE ...], with the keys of `DrawnScene`
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

from survey.progress import Progress
from survey.simulate.drawn.ground import stage_drawing
from survey.simulate.drawn.settings import DrawnScene
from survey.simulate.output.writing import write_survey

__all__ = ["DrawnScene", "draw_survey", "stage_drawing"]


def draw_survey(folder: Path, scene: DrawnScene, *, again: bool = False, progress: Progress | None = None) -> None:
    """Draw a survey into a folder; see `survey.simulate.output.writing.write_survey`."""
    write_survey(folder, dataclasses.asdict(scene), lambda: stage_drawing(scene), again=again, progress=progress)
