"""Rows of `check` about observations other than tie points, with source, accuracy and verdicts.

Also tests whether viewing directions can determine a level that is not given.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import StrEnum

import numpy as np

from survey.errors import FILE_NAME
from survey.folder.control import FoundControl, mark_residuals
from survey.folder.found import Found
from survey.folder.survey import Survey
from survey.photos.rotations import enu_from_yaw_pitch_roll
from survey.settings.config import WaterConfig
from survey.water.level import STAFF_STD_M
from survey.water.level_observation import LevelObservation

# Views within this angle of the vertical count as nadir. With nadir views alone the adjustment leaves the level
# uncertain by 0.1 to 3 m, where 0.05 m is needed; from a tenth of oblique views on it becomes observable
# (docs/adjustment.md).
DOWN_DEG, FEWEST_OBLIQUE = 10.0, 0.1
GIVE_LEVEL = (
    f"give the level in [water] in {FILE_NAME} (level_m as read at a staff, or shoreline, gnss_points, gauge or "
    "clicks), or add crossing photographs tilted by 25 to 35 degrees"
)
_NO_CLOUD = f"they hardly ever determine the level, without which there is no cloud; {GIVE_LEVEL}"


def control_rows(control: FoundControl) -> list[tuple[str, str]]:
    """Rows on the files of [control]; none where there are none."""
    rows: list[tuple[str, str]] = []
    if control.merged.points:
        points, marks = control.merged.points, control.merged.marks
        num_check = sum(point.is_check for point in points)
        checks = f", {num_check} of them check points" if num_check else ""
        seen = f"{len(marks)} marks in {len({mark.view for mark in marks})} images"
        rows.append(("control", f"{len(points)} points{checks}, with {seen}; {_stds(control)}"))
    if control.config.reference is not None:
        stable = f", in the polygons of {control.config.stable}" if control.config.stable is not None else ""
        rows.append(("earlier survey", f"{control.config.reference}: the block is placed on its dry ground{stable}"))
    if control.checkpoints:
        rows.append(("check points", f"{len(control.checkpoints)}, which results are compared with"))
    return rows


def mark_rows(survey: Survey) -> list[tuple[str, str]]:
    """Row on the reprojection error of the marks of control points; none without control."""
    control = survey.observations.control
    if control is None:
        return []
    residuals = mark_residuals(control, survey.views, survey.water)
    worst = control.marks[int(np.argmax(np.nan_to_num(residuals, nan=np.inf)))]
    return [
        (
            "marks",
            f"{np.nanmedian(residuals):.1f} px (median) from where poses and lens show their points, at most "
            f"{np.nanmax(residuals):.1f} px ({worst.point} in {worst.view})",
        )
    ]


def _stds(control: FoundControl) -> str:
    """Standard deviations of points and marks, with their source."""
    points = control.merged.points
    of_file = [point.std_m for point in points if point.std_m is not None]
    parts = []
    if of_file:
        east, north, up = np.median(of_file, axis=0)
        parts.append(f"{len(of_file)} good to {east:.3g}, {north:.3g} and {up:.3g} m (their file)")
    if len(of_file) < len(points):
        std_m = control.config.std_m
        message = (
            f"{std_m:g} m" if not isinstance(std_m, tuple) else f"{std_m[0]:g} m across and {std_m[1]:g} m in height"
        )
        parts.append(f"{len(points) - len(of_file)} good to {message} ([control] std_m)")
    return f"{', '.join(parts)}; marks to {control.config.marks_std_px:g} px"


def water_stds(water: WaterConfig, levels: Sequence[LevelObservation], *, is_index_known: bool = True) -> str:
    """Standard deviations of the water parameters with their sources, as text; empty where none is known."""
    known = {"level": water.level_std_m, "index": water.index_std, "slopes": water.slope_std}
    parts = [f"{name} to {std:.3g}{' m' if name == 'level' else ''}" for name, std in known.items() if std is not None]
    by = FILE_NAME
    measured = [each.source for each in levels if each.source != "level_m"]
    if measured and water.level_std_m is not None:
        by = f"{measured[0]}, {len(measured)} measured" + (f", and {FILE_NAME}" if len(parts) > 1 else "")
    if not is_index_known:
        by += "; that of the index is assumed"
    text = f"; known: {', '.join(parts)} ({by})" if parts else ""
    if water.level_m is not None and water.level_std_m is None:
        text += f"; level_std_m is not given, {STAFF_STD_M:g} m as of a staff are assumed: say how well it is known"
    return text


class Verdict(StrEnum):
    """Suitability for measuring the bed."""

    good = "good"
    fair = "fair"
    poor = "poor"


def verdict_by_limits(value: float, good: float, fair: float) -> Verdict:
    """Verdict on a value by its limits: good or fair up to them, or, where good > fair, from them on."""
    sign = 1.0 if good <= fair else -1.0
    if sign * value <= sign * good:
        return Verdict.good
    return Verdict.fair if sign * value <= sign * fair else Verdict.poor


def verdict_text(verdict: Verdict, found: str, advice: str) -> str:
    """The sentence that `check` prints; advice only where there is something to fix."""
    return f"{verdict}: {found}" + ("" if verdict is Verdict.good else f"; {advice}")


def level_warning(found: Found, survey: Survey | None) -> str | None:
    """Warning where an adjustment will hardly determine the level; None where one is given, or it may.

    Where the poses are not known yet (``survey`` None), attitudes are those in XMP.
    """
    water = found.config.water
    is_given = water is None or water.level_m is not None or water.sources.clicks is not None
    if is_given or (survey is not None and survey.provenance.is_level_known):
        return None
    if survey is None:
        motions = (header.motion for header in found.headers.values())
        rotations = [
            enu_from_yaw_pitch_roll(math.radians(yaw), math.radians(pitch + 90.0), math.radians(roll)).T
            for yaw, pitch, roll in (motion.gimbal_deg for motion in motions if motion.gimbal_deg is not None)
        ]
    else:
        rotations = [view.camera.cam_from_local for view in survey.views]
    tilts = tilts_deg(np.array(rotations).reshape(-1, 3, 3))
    if not len(tilts):
        return (
            "the level of the water is not given, and the viewing directions of the photographs are not known yet: "
            f"where nearly all look straight down {_NO_CLOUD}"
        )
    down = int((tilts <= DOWN_DEG).sum())
    if len(tilts) - down >= FEWEST_OBLIQUE * len(tilts):
        return None
    return (
        f"the level of the water is not given, and {down} of {len(tilts)} photographs look straight down (within "
        f"{DOWN_DEG:g} degrees): {_NO_CLOUD}"
    )


def tilts_deg(cam_from_local: np.ndarray) -> np.ndarray:
    """Angles (V,) [deg] between the directions of views and straight down, from rotations (V, 3, 3)."""
    return np.degrees(np.arccos(np.clip(-cam_from_local[:, 2, 2], -1.0, 1.0)))
