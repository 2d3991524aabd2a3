"""The verdict on a run: requirements on a cloud, and whether they are met."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Gate:
    """One condition.

    Attributes
    ----------
    name : str
        The requirement, in a few words.
    value, limit : float or None
        In `unit`; None where there was nothing to measure.
    unit : str
        "%" or "mm".
    passed : bool
    sentence : str
        Finding and requirement, as text.
    """

    name: str
    value: float | None
    limit: float
    unit: str
    passed: bool
    sentence: str


@dataclass(frozen=True)
class Verdict:
    """All gates of a run."""

    gates: tuple[Gate, ...]

    @property
    def passed(self) -> bool:
        """Whether every gate is met."""
        return all(gate.passed for gate in self.gates)
