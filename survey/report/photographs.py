"""What of each photograph was left out of matching: white pixels, and what no other photograph shows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from survey.display.quantities import share
from survey.display.words import named
from survey.photos.saturation import MOSTLY_WHITE
from survey.report.blocks import Block, Rows, Table

# Worth a row in the page; all are in report.json.
_NOTABLE_WHITE, _NOTABLE_OUTLYING, _MOST_ROWS = 0.02, 0.15, 20


@dataclass(frozen=True)
class PhotographFigures:
    """One photograph.

    Attributes
    ----------
    name : str
    saturated : [-]
        Share of its pixels that are white or beside white: left out.
    outlying : [-] or None
        Of the points of the bed in it, those where it shows what no other photograph does, so that its weight is less
        than half there; None where the solver did not run, or it shows no point.
    """

    name: str
    saturated: float
    outlying: float | None


def photographs_of(saturated: Mapping[str, float], sightings: Mapping[str, list[int]]) -> tuple[PhotographFigures, ...]:
    """The photographs, by what the stages of sweep and solver counted by their names."""
    found = []
    for name, white in saturated.items():
        seen, outlying = sightings.get(name, (0, 0))
        found.append(PhotographFigures(name, white, outlying / seen if seen else None))
    return tuple(found)


def doubts(photographs: tuple[PhotographFigures, ...]) -> list[str]:
    """A warning that names the photographs that show little of the bed."""
    white = [each.name for each in photographs if each.saturated > MOSTLY_WHITE]
    return named(
        white, "photograph", "more than half white by glint of the sun or exposure, with little of the bed left"
    )


def summary(photographs: tuple[PhotographFigures, ...]) -> list[str]:
    """A sentence for the log; none where nothing is left out."""
    if not photographs:
        return []
    white = float(np.mean([each.saturated for each in photographs]))
    known = [each.outlying for each in photographs if each.outlying is not None]
    unlike = (
        f"; {share(float(np.mean(known)))} of the points in a photograph look unlike in all others and count less there"
        if known
        else ""
    )
    return [f"left out as white: {share(white)} of the pixels{unlike}"]


def table(photographs: tuple[PhotographFigures, ...]) -> list[Block]:
    """Means over the photographs, and those that lose most; nothing where none was looked at."""
    if not photographs:
        return []
    white = float(np.mean([each.saturated for each in photographs]))
    rows = [("white, in the mean of all photographs", share(white))]
    known = [each.outlying for each in photographs if each.outlying is not None]
    if known:
        rows.append(("unlike all others, in the mean", share(float(np.mean(known)))))
    worst = sorted(photographs, key=lambda each: -each.saturated - (each.outlying or 0.0))
    notable = [each for each in worst if each.saturated > _NOTABLE_WHITE or (each.outlying or 0.0) > _NOTABLE_OUTLYING][
        :_MOST_ROWS
    ]
    cells = [(each.name, share(each.saturated), share(each.outlying)) for each in notable]
    titles = ("photograph", "white, of its pixels", "unlike all others, of the points in it")
    return [Rows(rows), *([Table(titles, cells)] if cells else [])]
