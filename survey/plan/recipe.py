"""The numeric settings of each quality."""

from __future__ import annotations

from dataclasses import dataclass

from survey.plan.choices import Quality

# In place of a quality where `survey.plan.aim` makes the recipe.
AIMED = "aimed"


@dataclass(frozen=True)
class Recipe:
    """Numeric settings of a quality.

    Attributes
    ----------
    megapixels : [Mpx]
        Largest image to process; larger ones are halved until they fit.
    times_seen : (int, int)
        How often every place is to be seen by views with a height map of their own: by steep ones, and by oblique ones
        from each quarter. Three confirm each other; docs/sweep.md has the gain from more.
    field : "solver" or "off"
        What refines the heights of the sweep.
    rays_per_cell : float
        Rays that the slab learns from, per cell of one ground sampling distance.
    """

    megapixels: float
    times_seen: tuple[int, int]
    field: str
    rays_per_cell: float = 15.0


RECIPES = {
    Quality.draft.value: Recipe(megapixels=2.0, times_seen=(4, 1), field="off"),
    Quality.standard.value: Recipe(megapixels=6.0, times_seen=(4, 4), field="solver"),
    # More than any place is seen: every view is matched.
    Quality.fine.value: Recipe(megapixels=100.0, times_seen=(1000, 1000), field="solver"),
}
