"""Cases of a parametrized test that the slow run has beside those of the default run."""

import pytest


def slow(*values):
    """A set of parameters for the slow run alone."""
    return pytest.param(*values, marks=pytest.mark.slow)
