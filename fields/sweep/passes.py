"""The passes of the sweep, coarse to fine: what each of them tries."""

from __future__ import annotations

from dataclasses import dataclass, replace

from fields.sweep.climbing import MATCHED_NCC
from fields.sweep.steps import StepSearch

# Rungs of a pass that searches nothing.
REFINING = 3


@dataclass(frozen=True)
class Pass:
    """One ladder over all views.

    Attributes
    ----------
    scale : of the image, 1 is full size
    radius : of the NCC window [px]
    rungs : number of heights tried, odd; None for the first pass, which tries as many as the bound holds
    step_px : parallax between two rungs [px at this scale]
    neighbours : number of views compared with
    fuse : after the pass, average each height with those of the views that agree
    search : after the pass, how heights beyond its ladder are searched; None: not at all
    points_only : whether only what becomes a point takes part, as the heights before tell: other pixels confirm with
        the heights that they have
    """

    scale: float
    radius: int
    rungs: int | None
    step_px: float
    neighbours: int
    fuse: bool
    search: StepSearch | None = None
    points_only: bool = False

    @property
    def refines(self) -> bool:
        """Whether it tries no more than the heights beside the one that is known: windows of any size tell these."""
        return self.rungs is not None and self.rungs <= REFINING


# Windows shrink as the relief becomes known: 5x5 finds the height, 3x3 about the relief resolves it. docs/sweep.md has
# what other passes give. Windows of the pass before hold heights from 5 px around; images without anything in common
# reach the least scores by chance in one of forty pixels: the better half of the neighbours on a ladder of forty.
PASSES = (
    Pass(0.25, 2, None, 0.5, 8, False),
    Pass(0.5, 2, 11, 0.4, 8, False, StepSearch(2, 0.5, 16, 2.0, 5, MATCHED_NCC)),
    Pass(1.0, 2, 7, 0.4, 8, True, StepSearch(1, 0.75, 8, 1.6, 3, 0.68, walls=True)),
    Pass(1.0, 2, 5, 0.25, 8, True),
    Pass(1.0, 1, 3, 0.25, 12, True),
)


def passes_from(share: float) -> tuple[Pass, ...]:
    """The passes with the whole bound searched at a share of the size, 1, 0.5 or (as `PASSES`) at most 0.25.

    Images of few pixels have to be searched at more than a quarter of their size (docs/targets.md).
    """
    if share > PASSES[1].scale:
        return (replace(PASSES[2], rungs=None, step_px=PASSES[0].step_px, search=None), *PASSES[3:])
    if share > PASSES[0].scale:
        return (replace(PASSES[1], rungs=None, step_px=PASSES[0].step_px, search=None), *PASSES[2:])
    return PASSES


def before_solver(passes: tuple[Pass, ...]) -> tuple[Pass, ...]:
    """The same passes for heights that the solver solves again: after the first at full size only points take part.

    Without the solver the heights of points are means over views, which all have to be refined.
    """
    first = next(number for number, p in enumerate(passes) if p.scale == 1.0)
    return (*passes[: first + 1], *(replace(p, points_only=True) for p in passes[first + 1 :]))
