"""The survey that a run folder belongs to."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from survey.errors import SurveyError
from survey.stage_key import content_hash


@dataclass(frozen=True)
class Owner:
    """A survey as a run folder knows it."""

    name: str  # For messages only: it may change
    # name to bytes: cameras give the same names again in every flight, but hardly the same sizes too
    photographs: dict[str, int]
    # name to SHA-256: of what their files hold: photographs that are not compressed are of one size
    contents: dict[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, name: str, images: Mapping[str, Path]) -> Owner:
        """Owner for a survey with these images, name to path."""
        sizes = {image: path.stat().st_size for image, path in images.items()}
        return cls(name, sizes, {image: content_hash(path) for image, path in images.items()})

    @classmethod
    def from_record(cls, record: Mapping) -> Owner | None:
        """Owner from its record; None before a run is claimed, and of a run of a version that kept none."""
        return cls(record["survey"], record["photographs"], record.get("contents", {})) if "survey" in record else None

    def as_record(self) -> dict:
        """Plain values."""
        return {"survey": self.name, "photographs": self.photographs, "contents": self.contents}

    def require_unchanged(self, name: str, path: Path) -> None:
        """Raise SurveyError where the file at a path is not the photograph of this name, by size and content."""
        before, now, content = self.photographs.get(name), path.stat().st_size, self.contents.get(name)
        if before is not None and before != now:
            differs = f"it has {now} bytes, expected {before}"
        elif content is not None and content != content_hash(path):
            differs = "it has the same size and another content"
        else:
            return
        raise SurveyError(
            f"{path} is not the photograph that the run used: {differs}; put the photographs of the run there, name "
            "the folder of the survey with --survey DIR, or process again"
        )

    def require_same(self, other: Owner, run: Path) -> None:
        """Raise SurveyError where a run of this survey is to become one of another.

        Photographs may come, go and change, but half of those of the smaller of the two have to be the same.
        """
        same = self.photographs.items() & other.photographs.items()
        if self.contents:
            same = {(name, size) for name, size in same if self.contents.get(name) == other.contents.get(name)}
        common = len(same)
        if 2 * common < min(len(self.photographs), len(other.photographs)):
            raise SurveyError(
                f"the run folder {run} belongs to another survey, {self.name}, with other photographs ({common} of "
                f"{len(other.photographs)} have the same name, size and content there); name another folder with -o, "
                "or remove that one"
            )
