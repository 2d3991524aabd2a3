"""Coarse-to-fine passes of the sweep: scale, window, hypotheses and neighbours of each."""

from __future__ import annotations

from dataclasses import dataclass, replace

# A score below this is meaningless: no window was complete (-1), or the windows have no texture (0, but for rounding).
MATCHED_NCC = 0.05
REFINING = 3  # Hypotheses of a pass that searches nothing


@dataclass(frozen=True)
class DiscontinuitySearch:
    """Search at height discontinuities after a pass."""

    radius: int  # of the NCC window [px]
    spacing_px: float  # parallax between two hypotheses [px at the scale of the pass]
    # side of the tiles that share their hypotheses [px]: small ones share little, large ones hold heights that few of
    # their pixels need
    tile_px: int
    # searched are pixels around which heights differ by more than this parallax [px at the scale of the pass]
    reach_px: float
    around_px: int  # heights this far around a pixel bound its hypotheses [px at the scale of the pass]
    # median score of a view in the pass from which it is searched: windows of this size resolve heights
    least_score: float
    walls: bool = False  # whether vertical walls are tried, beside level ground
    neighbours: int = 6  # how many of the views of the pass heights are compared with, of those that match best


# Approximate share of the samples of a full pass in one that takes points alone, with the halos of their tiles: a
# seventh of data/river, a fifth of data/wreck_water, half of data/quick, whose 21 photographs see little ground.
POINTS_SHARE = 0.25


@dataclass(frozen=True)
class Pass:
    """Settings of a pass over all views, with hypotheses about the heights of the pass before."""

    scale: float  # of the image, 1 is full size
    radius: int  # of the NCC window [px]
    # number of heights tried, odd; None for the first pass, which tries as many as the bound holds
    hypotheses: int | None
    spacing_px: float  # parallax between two hypotheses [px at this scale]
    neighbours: int  # number of views compared with
    fuse: bool  # after the pass, average each height with those of the views that agree
    # after the pass, how heights beyond its hypotheses are searched; None: not at all
    discontinuities: DiscontinuitySearch | None = None
    # whether only pixels predicted to become points take part: others confirm with the heights that they have
    points_only: bool = False
    # whether only pixels take part whose heights of the pass before lie in the area, not all that see it at some height
    # of the bound
    in_area: bool = False

    @property
    def refines(self) -> bool:
        """Whether the pass only refines: it tries the known height and its two neighbours."""
        return self.hypotheses is not None and self.hypotheses <= REFINING


# Windows shrink as the relief becomes known: 5x5 finds the height, 3x3 about the relief resolves it. docs/sweep.md has
# what other passes give. Windows of the pass before hold heights from 5 px around; images without anything in common
# reach the least scores by chance in one of forty pixels: the better half of the neighbours among forty hypotheses.
PASSES = (
    Pass(0.25, 2, None, 0.5, 8, False),
    Pass(0.5, 2, 11, 0.4, 8, False, DiscontinuitySearch(2, 0.5, 16, 2.0, 5, MATCHED_NCC)),
    Pass(1.0, 2, 7, 0.4, 8, True, DiscontinuitySearch(1, 0.75, 8, 1.6, 3, 0.68, walls=True)),
    Pass(1.0, 2, 5, 0.25, 8, True),
    Pass(1.0, 1, 3, 0.25, 12, True),
)


def before_solver(passes: tuple[Pass, ...]) -> tuple[Pass, ...]:
    """The same passes for heights that the solver solves again: after the first at full size only points take part.

    Without the solver the heights of points are means over views, which all have to be refined.
    """
    first = next(number for number, pass_ in enumerate(passes) if pass_.scale == 1.0)
    return (*passes[: first + 1], *(replace(pass_, points_only=True) for pass_ in passes[first + 1 :]))


def in_area(passes: tuple[Pass, ...]) -> tuple[Pass, ...]:
    """The same passes for a tile: the first looks for its heights, the others follow what the one before found."""
    return (passes[0], *(replace(pass_, in_area=True) for pass_ in passes[1:]))
