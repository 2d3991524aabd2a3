"""Surveys with known truth: a bed, water and a flight become photographs, and what is true stands beside them."""

from survey.simulate.scene import Scene
from survey.simulate.writing import write_survey

__all__ = ["Scene", "write_survey"]
