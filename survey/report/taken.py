"""Who surveyed, when, and with which cameras: the head of a report."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime

from survey.photos.exif import Exif
from survey.report.blocks import Block, Rows
from survey.settings.config import ReportConfig

# Cameras with this many serial numbers or fewer are listed by them.
_FEW = 4


@dataclass(frozen=True)
class CameraFigures:
    """Figures of a kind of camera."""

    name: str  # Maker and model; empty where EXIF has none
    serials: tuple[str, ...]
    num: int  # Its photographs


@dataclass(frozen=True)
class TakenFigures:
    """Operator, time and cameras of a survey."""

    project: str | None
    operator: str | None
    processed: str  # When the report was written, ISO 8601
    # first, last: When photographs were taken, ISO 8601; None where none has a time
    first: str | None
    last: str | None
    clock: str | None  # "UTC", "camera" or None: whose time that is
    cameras: tuple[CameraFigures, ...]


def taken_of(said: ReportConfig, heads: Mapping[str, Exif], now: datetime) -> TakenFigures:
    """The figures of photographs by the heads of their files."""
    utc = [head.taken for head in heads.values() if head.taken is not None]
    own = [head.clock for head in heads.values() if head.clock is not None]
    times, clock = (utc, "UTC") if utc else (own, "camera")
    count = Counter(head.camera for head in heads.values())
    cameras = tuple(
        CameraFigures(name, tuple(sorted({h.serial for h in heads.values() if h.camera == name and h.serial})), num)
        for name, num in count.most_common()
    )
    first, last = (min(times), max(times)) if times else (None, None)
    return TakenFigures(
        said.project,
        said.operator,
        now.isoformat(timespec="minutes"),
        None if first is None else first.replace(tzinfo=None).isoformat(timespec="seconds"),
        None if last is None else last.replace(tzinfo=None).isoformat(timespec="seconds"),
        clock if times else None,
        cameras,
    )


def flown(found: TakenFigures) -> str | None:
    """Time of the flight in words; None where no photograph has one."""
    if found.first is None or found.last is None:
        return None
    whose = "UTC" if found.clock == "UTC" else "by the clock of the camera"
    (day, start), (other_day, end) = found.first.split("T"), found.last.split("T")
    start, end = start[:5], end[:5]
    if day != other_day:
        return f"{day} {start} to {other_day} {end} {whose}"
    return f"{day} {start} {whose}" if start == end else f"{day} {start} to {end} {whose}"


def head_lines(found: TakenFigures | None) -> list[str]:
    """Lines under the title of the page."""
    if found is None:
        return []
    when = flown(found)
    dates = [*([] if when is None else [f"flown {when}"]), f"processed {found.processed[:10]}"]
    work = [text for text in (found.project, found.operator) if text]
    return [*([" · ".join(work)] if work else []), " · ".join(dates)]


def table(found: TakenFigures | None) -> list[Block]:
    """Who, when and with what."""
    if found is None:
        return []
    rows = [("project", found.project), ("operator", found.operator), ("flown", flown(found))]
    rows.append(("processed", found.processed.replace("T", " ")))
    rows += [("camera", _words(camera)) for camera in found.cameras]
    return [Rows([(label, text) for label, text in rows if text])]


def _words(camera: CameraFigures) -> str:
    name = camera.name or "without a name in EXIF"
    serials = ", ".join(camera.serials) if len(camera.serials) <= _FEW else f"{len(camera.serials)} of them"
    number = f", serial number {serials}" if serials else ""
    return f"{name}{number}: {camera.num} photograph{'' if camera.num == 1 else 's'}"
