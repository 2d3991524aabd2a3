"""Which survey a run folder belongs to: that of its photographs, wherever both folders are moved."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from survey.errors import SurveyError


@dataclass(frozen=True)
class Owner:
    """A survey as a run folder knows it.

    Attributes
    ----------
    name : str
        For messages only: it may change.
    photographs : name to bytes
        Cameras give the same names again in every flight, but hardly the same sizes too.
    """

    name: str
    photographs: dict[str, int]

    @classmethod
    def of(cls, name: str, images: Mapping[str, Path]) -> Owner:
        """The owner that a survey with these images, name to path, is."""
        return cls(name, {image: path.stat().st_size for image, path in images.items()})

    @classmethod
    def from_record(cls, record: Mapping) -> Owner | None:
        """What `as_record` gave; None in a run of a version that kept none."""
        return cls(record["survey"], record["photographs"]) if "photographs" in record else None

    def as_record(self) -> dict:
        """Plain values."""
        return {"survey": self.name, "photographs": self.photographs}

    def require_unchanged(self, name: str, path: Path) -> None:
        """Raise SurveyError where the file at a path is not the photograph of this name, by its size."""
        before, now = self.photographs.get(name), path.stat().st_size
        if before is not None and before != now:
            raise SurveyError(
                f"{path} is not the photograph that the run used: it has {now} bytes, expected {before}; put the "
                "photographs of the run there, name the folder of the survey with --survey DIR, or process again"
            )

    def require_same(self, other: Owner, run: Path) -> None:
        """Raise SurveyError where a run of this survey is to become one of another.

        Photographs may come, go and change, but half of those of the smaller of the two have to be the same.
        """
        common = len(self.photographs.items() & other.photographs.items())
        if 2 * common < min(len(self.photographs), len(other.photographs)):
            raise SurveyError(
                f"the run folder {run} belongs to another survey, {self.name}, with other photographs ({common} of "
                f"{len(other.photographs)} have the same name and size there); name another folder with -o, or remove "
                "that one"
            )
