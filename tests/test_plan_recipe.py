"""How often every place is to be seen by views with a height map."""

from __future__ import annotations

import pytest

from survey.plan.recipe import RECIPES, required_views


@pytest.mark.parametrize(
    ("white", "expected"),
    [
        ((), (4, 1)),
        # A few white pixels ask for no more; half of all for twice as many.
        ((0.0, 0.1), (4, 1)),
        ((0.4, 0.6), (8, 2)),
        ((1.0, 1.0), (40, 10)),
    ],
)
def test_photographs_that_are_partly_white_ask_for_as_many_more(white, expected):
    assert required_views(white, RECIPES["draft"].times_seen) == expected
