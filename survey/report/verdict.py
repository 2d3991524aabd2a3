"""The verdict on a run: requirements on a cloud, whether they are met; warning for a bed that is dry all over."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from survey.display.quantities import height

if TYPE_CHECKING:
    from fields.sweep.bed import BedPoints
    from survey.folder.survey import Survey


@dataclass(frozen=True)
class Gate:
    """Quality gate: a condition with its value and limit."""

    name: str  # The requirement, in a few words
    # value, limit: In `unit`; None where there was nothing to measure
    value: float | None
    limit: float
    unit: str  # "%" or "mm"
    passed: bool
    sentence: str  # Finding and requirement, as text


@dataclass(frozen=True)
class Verdict:
    """All gates of a run."""

    gates: tuple[Gate, ...]

    @property
    def passed(self) -> bool:
        """Whether every gate is met."""
        return all(gate.passed for gate in self.gates)


def dry_doubts(survey: Survey, bed: BedPoints) -> list[str]:
    """A warning that says how far the bed lies over the water; none where a point is wet, or there is no water."""
    if survey.water is None or not len(bed) or bed.wet.any():
        return []
    above = height(-float(bed.depth.max()))
    return [
        f"all of the bed lies above the water, whose level is {height(survey.require_water()[1].known_level_m)}: the "
        f"lowest point by {above}; if the ground was under water, level_m of survey.toml is wrong, or in another "
        "vertical datum than the poses"
    ]
