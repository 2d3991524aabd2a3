"""Owner of a run folder, and publication of its result: cloud, report, settings and plan replaced together.

A result is written into a hidden folder of the run. Renaming the complete folder commits the result, and its files are
then moved to their places; a process that is killed in between leaves the rest of the moving to the next one. So
settings, cloud and report in a run always belong together.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from survey.errors import SurveyError
from survey.files.json_values import read_json_object, write_json
from survey.stage_key import content_hash

NAMES = (
    "settings.toml", "plan.json", "cloud.las", "flight.json", "adjustment.json", "adjustment.npz", "cameras.csv",
    "sparse", "report.json", "report.html", "pictures", "result.json",
)  # fmt: skip
RECORD = "result.json"
_WHOLE = ".result.whole"
_UNFINISHED = ".unfinished.json"


def read_record(run: Path) -> dict:
    """The contents of result.json of a run: ``quality``, ``finished``, ``stages`` (name to folder), and ``others``.

    ``others`` has the stages of the latest result of each other quality, by quality. Empty without a result.
    """
    return read_json_object(run / RECORD)


def begin(run: Path, part: Path, quality: str) -> None:
    """Make an empty folder for a new result of a quality, and note that it is being worked on."""
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir()
    write_json(run / _UNFINISHED, {quality: [], **unfinished(run)})


def note_finished(run: Path, quality: str, stage: str) -> None:
    """Note a finished stage of an unfinished result, so that `prune` keeps its folder for when the work goes on."""
    others = unfinished(run)
    write_json(run / _UNFINISHED, others | {quality: [*others.get(quality, []), stage]})


def unfinished(run: Path) -> dict[str, list[str]]:
    """Finished stages of each result that is not finished, by its quality."""
    return read_json_object(run / _UNFINISHED)


def is_in_place(run: Path) -> bool:
    """Whether no result waits to be moved to its place."""
    return not (run / _WHOLE).exists()


def publish(run: Path, part: Path, *, quality: str, finished: str, stages: dict[str, str]) -> None:
    """Put the new result in the folder ``part`` of a run in the place of the one before.

    ``stages`` are the folders below ``stages/`` that it was made from, by name.
    """
    others = results_of_other_qualities(read_record(run), quality)
    files = [name for name in NAMES if (part / name).exists()] + [RECORD]
    record = {"quality": quality, "finished": finished, "stages": stages, "others": others, "files": files}
    write_json(part / RECORD, record)
    part.rename(run / _WHOLE)
    move_into_place(run)


def results_of_other_qualities(record: Mapping, quality: str) -> dict[str, dict[str, str]]:
    """Stages of the latest result of each quality but one, by quality, by the record of the result before."""
    others = {**record.get("others", {})}
    if record:
        others[record["quality"]] = record["stages"]
    others.pop(quality, None)
    return others


def move_into_place(run: Path) -> None:
    """Move a complete result to its place, replacing the old one; does nothing without one."""
    complete = run / _WHOLE
    # The record is moved last: where it is gone, everything else has been moved.
    if (complete / RECORD).exists():
        new = json.loads((complete / RECORD).read_text(encoding="utf-8"))
        _forget_unfinished(run, new["quality"])
        for name in NAMES:
            if (complete / name).exists() or name not in new["files"]:
                _remove(run / name)
            if (complete / name).exists():
                (complete / name).rename(run / name)
    shutil.rmtree(complete, ignore_errors=True)


def _forget_unfinished(run: Path, quality: str) -> None:
    """Remove the record of an unfinished result of a quality."""
    others = {name: found for name, found in unfinished(run).items() if name != quality}
    if others:
        write_json(run / _UNFINISHED, others)
    else:
        (run / _UNFINISHED).unlink(missing_ok=True)


def prune(run: Path) -> None:
    """Remove finished stages that belong neither to the latest result of a quality nor to one that is unfinished."""
    record = read_record(run)
    kept = set(record.get("stages", {}).values())
    for stages in record.get("others", {}).values():
        kept |= set(stages.values())
    for names in unfinished(run).values():
        kept |= set(names)
    for folder in (run / "stages").iterdir():
        if folder.is_dir() and folder.name[0] != "." and folder.name not in kept:
            shutil.rmtree(folder, ignore_errors=True)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


@dataclass(frozen=True)
class Owner:
    """A survey as a run folder knows it."""

    name: str  # For messages only: it may change
    # name to bytes: cameras give the same names again in every flight, but hardly the same sizes too
    photographs: dict[str, int]
    # name to SHA-256: of what their files hold: photographs that are not compressed are of one size. None of a run of a
    # version that did not keep it.
    contents: dict[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, name: str, images: Mapping[str, Path]) -> Owner:
        """Owner for a survey with these images, name to path."""
        sizes = {image: path.stat().st_size for image, path in images.items()}
        return cls(name, sizes, {image: content_hash(path) for image, path in images.items()})

    @classmethod
    def from_record(cls, record: Mapping) -> Owner | None:
        """Owner from its record; None in a run of a version that kept none."""
        if "photographs" not in record:
            return None
        return cls(record["survey"], record["photographs"], record.get("contents", {}))

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
