"""The reference of a run's report: mesh or cloud, and visible points."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Truth:
    """A known surface; the reconstruction never reads it.

    Attributes
    ----------
    reference, visible : Path or None
        True surface, and the points of it that cameras see.
    """

    reference: Path | None = None
    visible: Path | None = None
