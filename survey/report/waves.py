"""The waves of a survey in its report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from survey.display.blocks import Block, Rows
from survey.display.quantities import length


@dataclass(frozen=True)
class SeaFigures:
    """The waves by the surfaces of all photographs, as `fields.waves.surfaces.Sea`."""

    significant_height_m: float
    slope_rms: float
    peak_length_m: float
    axis_deg: float


@dataclass(frozen=True)
class WaveFigures:
    """What moved the photographs against each other, and the waves that were found and taken away."""

    moved_px: float  # Standard deviation of the shifts of photographs by waves
    sea: SeaFigures | None  # None where the water was taken as still

    @staticmethod
    def of(values: Mapping) -> WaveFigures:
        """Of the file of the solver."""
        return WaveFigures(values["moved_px"], None if values["sea"] is None else SeaFigures(**values["sea"]))


def rows(found: WaveFigures | None) -> list[Block]:
    """The waves in words; nothing where the water was still."""
    if found is None or found.sea is None:
        return []
    sea = found.sea
    return [
        Rows(
            [
                ("photographs shifted by", f"{found.moved_px:.2f} px (one sigma), before a surface was found for each"),
                ("significant wave height", length(sea.significant_height_m)),
                ("slope, root mean square", f"{sea.slope_rms:.3f}"),
                ("wavelength at the peak", length(sea.peak_length_m)),
                ("along", f"{sea.axis_deg:.0f}° and {sea.axis_deg + 180.0:.0f}° from north, clockwise"),
            ]
        )
    ]
