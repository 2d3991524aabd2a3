"""Photographs of a run: who took them, when, with which cameras, and the share of each left out of matching."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import numpy as np

from fields.sweep.photo_consistency import Consistency
from survey.display.blocks import Block, Folded, Rows, Table, Text
from survey.display.quantities import named, share
from survey.photos.exif import Exif
from survey.photos.texture import MOSTLY_WHITE
from survey.settings.config import ReportConfig

# A photograph with a correct pose correlates with the others on the bed (0.7 to 0.9 in simulated surveys), one with a
# wrong pose does not (0.03). With fewer points of the bed than this in a frame nothing can be said.
_LEAST_OF_MEDIAN, _FEWEST_POINTS = 0.25, 100
# A photograph with less than this share of the median contrast is blurred.
_BLURRED = 0.3
# Tables of more photographs open on a click.
_FEW = 40
# A share is said that is not 0.0 %; a photograph is listed of which more than _LISTED is left out, or all.
_LEAST_SAID, _LISTED, _WHOLE = 0.0005, 0.05, "yes"
# Cameras with this many serial numbers or fewer are listed by them.
_FEW_SERIALS = 4


@dataclass(frozen=True)
class PhotographFigures:
    name: str
    saturated: float  # [-]: share of its pixels that are white or beside white: left out
    # [-] or None: share of its points of the bed at which it contradicts the others, so that its weight is below half;
    # None where the solver did not run, or it shows no point
    outlying: float | None
    useless: str = ""  # Why the photograph contributes nothing to the cloud; empty where it does


def photographs_of(
    saturated: Mapping[str, float], sightings: Mapping[str, list[int]], consistency: Mapping[str, Consistency]
) -> tuple[PhotographFigures, ...]:
    """Figures of the photographs, from the counts of sweep and solver by their names."""
    useless, counts = _useless(consistency), {name: sightings.get(name, (0, 0)) for name in saturated}
    return tuple(
        PhotographFigures(name, white, counts[name][1] / counts[name][0] if counts[name][0] else None,
                          useless.get(name, ""))
        for name, white in saturated.items()
    )  # fmt: skip


def _useless(consistency: Mapping[str, Consistency]) -> dict[str, str]:
    """Reasons why photographs contribute nothing to the cloud, by their names."""
    known = [(each.correlation, each.contrast) for each in consistency.values() if each.correlation is not None]
    if not known:
        return {}
    usual, contrast = np.median(known, axis=0)
    reasons = {}
    for name, each in consistency.items():
        if each.num_points == 0:
            reasons[name] = "its frame holds none of the bed: pose wrong, or outside"
        elif each.num_points >= _FEWEST_POINTS and (each.correlation or 0.0) < _LEAST_OF_MEDIAN * usual:
            blurred = each.contrast < _BLURRED * contrast
            reasons[name] = "blurred, or without texture" if blurred else "shows something else there: pose wrong"
    return reasons


def photograph_warnings(photographs: tuple[PhotographFigures, ...]) -> list[str]:
    """Warnings that name the photographs that show little of the bed, or nothing."""
    white = [each.name for each in photographs if each.saturated > MOSTLY_WHITE]
    useless = [f"{each.name} ({each.useless})" for each in photographs if each.useless]
    glint = "more than half white by glint of the sun or exposure, with little of the bed left"
    return [*named(white, "photograph", glint), *named(useless, "photograph", "with nothing for the cloud")]


def left_out_shares(photographs: tuple[PhotographFigures, ...]) -> list[tuple[str, str]]:
    """What is left out of the photographs, in their mean, as labels and shares; without what is 0.0 %."""
    white = [each.saturated for each in photographs]
    unlike = [each.outlying for each in photographs if each.outlying is not None]
    means = {
        "left out as white, of the pixels": float(np.mean(white)) if white else 0.0,
        "differing from all others, of the points in a photograph": float(np.mean(unlike)) if unlike else 0.0,
    }
    return [(label, share(mean)) for label, mean in means.items() if mean >= _LEAST_SAID]


def table(photographs: tuple[PhotographFigures, ...], left_out: Sequence[str] = ()) -> list[Block]:
    """Means over the photographs, and each of which something is left out; nothing where there are none."""
    num = len(photographs) + len(left_out)
    if not num:
        return []
    rows = [
        (each.name, _use(each), share(each.saturated), share(each.outlying))
        for each in photographs
        if _use(each) != _WHOLE or max(each.saturated, each.outlying or 0.0) > _LISTED
    ]
    rows += [(name, "left out: no pose", "", "") for name in left_out]
    titles = ("photograph", "used", "white, of its pixels", "differing from all others, of the points in it")
    means: list[Block] = [Rows(shares)] if (shares := left_out_shares(photographs)) else []
    message = f"All {num} photographs, {len(left_out)} of them left out"
    if not rows:
        return [*means, Text(f"{message}; at most {share(_LISTED)} of each.")]
    message += f"; listed are those with more than {share(_LISTED)} left out"
    return [*means, Folded(message, Table(titles, sorted(rows), num_texts=2), len(rows) <= _FEW)]


def _use(each: PhotographFigures) -> str:
    if each.useless:
        return f"nothing of it: {each.useless}"
    return "little of it: more than half white" if each.saturated > MOSTLY_WHITE else _WHOLE


def taken_of(config: ReportConfig, headers: Mapping[str, Exif], now: datetime) -> dict[str, Any]:
    """Operator, time and cameras of a survey by the headers of its files; times are ISO 8601, None where unknown."""
    utc = [header.taken for header in headers.values() if header.taken is not None]
    own = [header.clock for header in headers.values() if header.clock is not None]
    times, clock = (utc, "UTC") if utc else (own, "camera")
    first, last = (
        moment(times).replace(tzinfo=None).isoformat(timespec="seconds") if times else None for moment in (min, max)
    )
    serials: dict[str, set[str]] = {}
    for header in headers.values():
        serials.setdefault(header.camera, set()).update({header.serial} - {""})
    return {
        "project": config.project,
        "operator": config.operator,
        "processed": now.isoformat(timespec="minutes"),
        "first": first,
        "last": last,
        "clock": clock if times else None,
        "cameras": [
            {"name": name, "serials": sorted(serials[name]), "num": num}
            for name, num in Counter(header.camera for header in headers.values()).most_common()
        ],
    }


def flight_time(taken: dict[str, Any]) -> str | None:
    """Date and time of the flight as text; None where no photograph has one."""
    if taken["first"] is None:
        return None
    whose = "UTC" if taken["clock"] == "UTC" else "by the clock of the camera"
    (day, start), (other_day, end) = (taken[moment][:16].split("T") for moment in ("first", "last"))
    if day != other_day:
        return f"{day} {start} to {other_day} {end} {whose}"
    return f"{day} {start} {whose}" if start == end else f"{day} {start} to {end} {whose}"


def taken_rows(taken: dict[str, Any] | None) -> list[tuple[str, str]]:
    """Rows under the title of the page on authors, times and cameras."""
    if taken is None:
        return []
    rows = [("project", taken["project"]), ("operator", taken["operator"]), ("flown", flight_time(taken))]
    rows.append(("processed", taken["processed"].replace("T", " ")))
    for camera in taken["cameras"]:
        num, known = camera["num"], camera["serials"]
        serials = ", ".join(known) if len(known) <= _FEW_SERIALS else f"{len(known)} of them"
        serial = f", serial number {serials}" if serials else ""
        name = camera["name"] or "without a name in EXIF"
        rows.append(("camera", f"{name}{serial}: {num} photograph{'' if num == 1 else 's'}"))
    return [(label, text) for label, text in rows if text]
