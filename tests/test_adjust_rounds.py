"""The rounds of an adjustment: what is used and what the solution says belong together."""

from __future__ import annotations

from survey.adjust import rounds
from survey.adjust.refine import adjust_survey
from tests.block_survey import survey_of
from tests.drawn_block import draw_block


def test_residuals_are_of_what_is_used_where_rounds_end_before_nothing_changes(monkeypatch):
    monkeypatch.setattr(rounds, "_ROUNDS", 1)
    block = draw_block(3, num_points=150, num_views=18, dry_share=0.3, wrong=0.03)
    found = adjust_survey(survey_of(block), use_windows=False)
    assert len(found.residual_px) == len(found.residual_view) == sum(found.num_observations.values())
    assert len(found.points) == found.num_points == found.residual_point.max() + 1
