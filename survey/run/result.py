"""The result of a run: cloud, report, settings and plan, which take the place of an earlier result all together.

A result is written into a hidden folder of the run. When it is whole the folder is renamed, which decides that it
counts, and its files are moved to their places; a process that is killed in between leaves the rest of the moving to
the next one. So settings, cloud and report in a run always belong together.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

NAMES = ("settings.toml", "plan.json", "cloud.las", "report.json", "report.html", "pictures", "result.json")
_RECORD = "result.json"
_WHOLE = ".result.whole"
_UNFINISHED = ".unfinished"


def read_record(run: Path) -> dict:
    """What result.json of a run says: ``quality``, ``finished``, ``stages`` (name to folder), and ``others``.

    ``others`` has the stages of the latest result of each other quality, by quality. Empty without a result.
    """
    try:
        record = json.loads((run / _RECORD).read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError, ValueError):
        return {}
    return record if isinstance(record, dict) else {}


def begin(run: Path, part: Path) -> None:
    """Make an empty folder for a new result, and note that one is being worked on."""
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir()
    (run / _UNFINISHED).touch()


def is_unfinished(run: Path) -> bool:
    """Whether a later `process` began and has not come to its end: the result is that of the one before."""
    return (run / _UNFINISHED).exists()


def is_settled(run: Path) -> bool:
    """Whether no result waits to be moved to its place."""
    return not (run / _WHOLE).exists()


def publish(run: Path, part: Path, *, quality: str, finished: str, stages: dict[str, str]) -> None:
    """Put a new result in the place of the one before.

    Parameters
    ----------
    run, part : Path
        The run, and the folder in it that holds the new result.
    quality, finished : str
        What the result was made with, and when.
    stages : dict
        Folder below ``stages/`` of each stage that it was made from.
    """
    before = read_record(run)
    others = {**before.get("others", {})}
    if before:
        others[before["quality"]] = before["stages"]
    others.pop(quality, None)
    files = [name for name in NAMES if (part / name).exists()] + [_RECORD]
    record = {"quality": quality, "finished": finished, "stages": stages, "others": others, "files": files}
    (part / _RECORD).write_text(json.dumps(record, indent=2), encoding="utf-8")
    part.rename(run / _WHOLE)
    settle(run)
    (run / _UNFINISHED).unlink(missing_ok=True)


def settle(run: Path) -> None:
    """Move a whole result to its place; what the new one has not, the old one loses. Does nothing without one."""
    whole = run / _WHOLE
    # The record is moved last: where it is gone, everything else has been moved.
    if (whole / _RECORD).exists():
        new = json.loads((whole / _RECORD).read_text(encoding="utf-8"))["files"]
        for name in NAMES:
            if (whole / name).exists() or name not in new:
                _remove(run / name)
            if (whole / name).exists():
                (whole / name).rename(run / name)
    shutil.rmtree(whole, ignore_errors=True)


def prune(run: Path) -> None:
    """Remove finished stages that belong to the latest result of no quality."""
    record = read_record(run)
    kept = set(record.get("stages", {}).values())
    for stages in record.get("others", {}).values():
        kept |= set(stages.values())
    for folder in (run / "stages").iterdir():
        if folder.is_dir() and folder.name[0] != "." and folder.name not in kept:
            shutil.rmtree(folder, ignore_errors=True)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
