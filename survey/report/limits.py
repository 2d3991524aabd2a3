"""What was seen of the water, what not and why; what the cloud is good for, in plain words."""

from __future__ import annotations

import numpy as np

from survey.display.quantities import area, length, share, volume
from survey.report.blocks import Block, Rows, Sentences
from survey.report.figures import ReportFigures

# 95 % of normal errors are within so many standard deviations.
_SIGMAS_95 = 1.96
# Smaller things than so many ground sampling distances are smoothed away by the windows that are matched.
_SMALLEST_GSD = 5.0


def seen(figures: ReportFigures) -> list[Block]:
    """What was seen of the water, what not, and why; nothing for a dry survey."""
    found = figures.coverage
    if found is None:
        return []
    whole = found.wet_m2 + found.two_views_m2 + found.one_view_m2
    if not whole:
        return []
    std = "" if found.water_std_m3 is None else f" ± {volume(found.water_std_m3)} (one sigma)"
    rows = [
        ("bed found", _part(found.wet_m2, whole)),
        ("water over it", f"{volume(found.water_m3)}{std}"),
        (
            "no bed, two photographs or more",
            f"{_part(found.two_views_m2, whole)}: turbid or too deep, glint, moving plants, or a bed without texture",
        ),
        ("no bed, one photograph only", f"{_part(found.one_view_m2, whole)}: nothing crosses its rays"),
    ]
    white = [each.saturated for each in figures.photographs]
    if white:
        rows.append(("white by glint or exposure", f"{share(float(np.mean(white)))} of the pixels of all photographs"))
    if figures.left_out:
        rows.append(("photographs without a pose", f"{len(figures.left_out)}: what they alone show is missing"))
    return [Rows(rows)]


def _part(value_m2: float, whole_m2: float) -> str:
    return f"{area(value_m2)}, {share(value_m2 / whole_m2 if whole_m2 else None)} of the water that was looked at"


def limits(figures: ReportFigures) -> list[Block]:
    """What the cloud is good for and what not, in sentences with this run's figures."""
    said, std = [], figures.height_std
    if std is not None:
        told = f"A typical height is within {length(_SIGMAS_95 * std.whole)} of the truth in 95 of 100 cases"
        if std.shared:
            told += f"; of that, {length(_SIGMAS_95 * std.shared)} shift all heights together, and no mean removes it"
        said.append(f"{told}, if level, index and positions are as good as was stated.")
    said.append(
        f"Things smaller than about {length(_SMALLEST_GSD * figures.plan.gsd_m)} are smoothed away or missing; what "
        "stands on a wall or under an overhang may be missing too."
    )
    if figures.water is not None:
        said.append(
            "The water was taken as at rest: waves add noise, and where they do not average out, a bias. What moves, "
            "as plants and fish, is wrong or missing."
        )
        said.append(
            "The top of plants counts as bed where they hide it. No statement is made on the ground below them, nor on "
            "what lies where no bed was found."
        )
        said.append("Not a nautical survey: search for obstructions and full coverage were not tested.")
    if figures.checkpoints is None and figures.comparison is None:
        said.append("Nothing independent was measured with it: no check points, no reference.")
    return [Sentences(said)]
