"""Fit of a block to the dry ground of an earlier survey: shift, turn and scale with standard deviations."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from survey.adjust.block.on_ground import NAMES, GroundAlignment
from survey.display.quantities import length

_AXES = ("east", "north", "up")
# The ground determines a part of the transformation whose std it lowers to this share.
_DETERMINED_SHARE = 0.7
_MOST_CHANGED = 0.5
# On ground that did not change, tie points scatter by less.
_MOST_SCATTER = 3.0
# In standard deviations of what was said of the reference.
_MOST_OFF = 3.0


@dataclass(frozen=True, kw_only=True)
class GroundFit(GroundAlignment):
    """Alignment of a block to the ground of an earlier survey, beside what positions and file say."""

    reference: str  # File of the earlier survey
    moved: tuple[float, ...]  # Of each of `NAMES`: by how much, from where poses and positions had it
    is_against_positions: bool  # Whether it contradicts positions of a stated accuracy

    @classmethod
    def of_record(cls, record: Mapping[str, Any] | None) -> GroundFit | None:
        """The fit of a stored record."""
        if record is None:
            return None
        values: dict[str, Any] = {name: tuple(v) if isinstance(v, list | tuple) else v for name, v in record.items()}
        return cls(**values)

    @property
    def is_determined_by_ground(self) -> tuple[bool, ...]:
        """Parts of the transformation that the ground determines."""
        without = (math.inf,) * len(self.std) if self.std_without is None else self.std_without
        return tuple(std <= _DETERMINED_SHARE * before for std, before in zip(self.std, without, strict=True))

    @property
    def notes(self) -> tuple[str, ...]:
        """The placement in a sentence."""
        axes = ", ".join(
            f"{length(value)} {axis} (± {length(std)})"
            for value, std, axis in zip(self.moved[:3], self.std[:3], _AXES, strict=True)
        )
        undetermined = [
            name.rsplit("_", 1)[0].replace("_", " about ")
            for name, is_determined in zip(NAMES, self.is_determined_by_ground, strict=True)
            if not is_determined
        ]
        remarks = f"; it does not determine {', '.join(undetermined)}" if undetermined else ""
        found = [
            f"{length(value)} {axis} (± {length(std)})"
            for value, std, prior, axis in zip(self.off_m, self.off_std_m, self.off_prior_m, _AXES, strict=True)
            if std <= _DETERMINED_SHARE * prior
        ]
        if found:
            remarks += f"; all of {self.reference} is off by {', '.join(found)}, as control and positions show"
        return (
            f"placed on {self.num_points} points of the dry ground of {self.reference}, to {length(self.rms_m)} rms: "
            f"moved by {axes}{remarks}",
        )

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about ground that changed, or contradicts the positions."""
        parts = []
        for value, std, prior, axis in zip(self.off_m, self.off_std_m, self.off_prior_m, _AXES, strict=True):
            if abs(value) > _MOST_OFF * prior:
                parts.append(
                    f"{self.reference} lies {length(value)} (± {length(std)}) further {axis} than control and "
                    f"positions place it, and [control] reference_std_m says {length(prior)}: check its datum and "
                    "theirs, or give a larger reference_std_m"
                )
        share = self.num_changed / max(self.num_over, 1)
        if share > _MOST_CHANGED:
            parts.append(
                f"{100.0 * share:.0f} % of the tie points over the ground of {self.reference} do not fit it: it has "
                "changed, or is another place; give polygons of stable ground in [control] stable"
            )
        if self.scatter > _MOST_SCATTER:
            parts.append(
                f"tie points over the ground of {self.reference} scatter about it {self.scatter:.1f} times as much as "
                "its own points: it may be another place or time; look at the bank in the cloud, give positions good "
                "to a few metres, or polygons of stable ground in [control] stable"
            )
        if self.is_against_positions:
            moved = " / ".join(length(value) for value in self.moved[:3])
            parts.append(
                f"{self.reference} places the block {moved} (east / north / up) from where the positions place it, "
                "more than "
                "their stated accuracies allow; the reference is used: check its datum, and those of the positions "
                "and crs"
            )
        return tuple(parts)
