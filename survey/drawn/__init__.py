"""A small survey with known truth, drawn by an exact renderer: for the demo and the tests.

python -m survey.drawn FOLDER [--tiny] [--shore] [--dry]
"""

from survey.drawn.drawing import Drawing
from survey.drawn.folder import draw_survey
from survey.drawn.scene import DrawnScene

__all__ = ["Drawing", "DrawnScene", "draw_survey"]
