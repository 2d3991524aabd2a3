"""Parts of the sweep and the solver that are left out where a scene does not need them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Skips:
    """Simplifications of the computation, on by default; docs/plan.md has the time and the error of each."""

    air: bool = True  # No refraction where there is no water, or its index is one
    lens: bool = True  # No terms of distortion, of a rolling shutter and of a tide that no camera has
    area: bool = True  # No heights of pixels that cannot see the area
    heights: bool = True  # No heights beyond those that thumbnails find
    points: bool = True  # No refining of heights that do not become points


SKIPS, NOTHING = Skips(), Skips(air=False, lens=False, area=False, heights=False, points=False)
