"""`bathynerf check`: findings, assumptions, warnings, and the plan with its cost."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from geo.crs import height_unit_m
from survey.display.quantities import length
from survey.errors import FILE_NAME, SurveyError
from survey.folder.control import FoundControl, mark_residuals
from survey.folder.found import Found, find_survey
from survey.folder.observations import shutter_text
from survey.folder.pose_priors import accuracy_of_gps, accuracy_of_priors, common_up_std_of_exif
from survey.folder.sfm_views import placing_control, require_solvable
from survey.folder.survey import Survey, load_survey
from survey.machine import memory_shortage
from survey.photos.exif import position_sources
from survey.photos.poses import enu_from_yaw_pitch_roll
from survey.plan.area import require_seen
from survey.plan.choices import USUAL, Choices
from survey.plan.plan import Decision, Plan, device_decision, make_plan, require_placeable
from survey.plan.tiling import plan_run, require_dask
from survey.plan.workload import Workload, room_warnings, workload_of_images
from survey.settings.config import SurveyConfig, WaterConfig
from survey.sfm.gps import WELL_KNOWN_M
from survey.water.level import STAFF_STD_M
from survey.water.level_observation import LevelObservation
from survey.words import RUN_FOLDER, Device

# Views within this angle of the vertical count as nadir. With nadir views alone the adjustment leaves the level
# uncertain by 0.1 to 3 m, where 0.05 m is needed; from a tenth of oblique views on it becomes observable
# (docs/adjustment.md).
DOWN_DEG, FEWEST_OBLIQUE = 10.0, 0.1
GIVE_LEVEL = (
    f"give the level in [water] in {FILE_NAME} (level_m as read at a staff, or shoreline, gnss_points, gauge or "
    "clicks), or add crossing photographs tilted by 25 to 35 degrees"
)
_NO_CLOUD = f"they hardly ever determine the level, without which there is no cloud; {GIVE_LEVEL}"


@dataclass(frozen=True)
class CheckSection:
    """Section of the output: a title, labelled sentences (a label may be empty), and their numbers for JSON."""

    title: str
    rows: tuple[tuple[str, str], ...]
    numbers: Mapping[str, Any] | None = None


@dataclass(frozen=True)
class Checked:
    """A survey whose files pass all checks."""

    found: Found
    survey: Survey | None  # None where structure from motion has to find the poses first
    warnings: tuple[str, ...]  # sentences
    # a sentence, or None: why the photographs will hardly determine the level of the water, where none is given
    level_warning: str | None = None

    @property
    def ordered_warnings(self) -> tuple[str, ...]:
        """All warnings; first those about a run that would end without a cloud."""
        fatal = (text for text in (memory_shortage(), self.level_warning) if text is not None)
        return (*fatal, *self.warnings)


def require_processable(folder: Path, chosen: Choices = USUAL, config: SurveyConfig | None = None) -> Checked:
    """Test a survey, by its settings or `config`, and the options of its run, before any computation."""
    if chosen.device == Device.cuda:
        device_decision(chosen.device)
    require_dask(chosen)
    found = find_survey(Path(folder), config=config)
    if found.config.water is None and (chosen.true_colour or chosen.calibrate_water):
        option = "--true-colour takes the water away" if chosen.true_colour else "--calibrate-water estimates the water"
        raise SurveyError(f"{option}, but the survey has none; leave the option out, or give [water]")
    require_placeable(found.config.control.reference, chosen.poses)
    if found.poses_path is None:
        warnings = (*found.findings.warnings, *require_solvable(found))
        return Checked(found, None, warnings, level_warning(found, None))
    survey = load_survey(folder, found=found)
    require_seen(survey)
    return Checked(found, survey, survey.findings.warnings, level_warning(found, survey))


def check_survey(
    folder: Path,
    *,
    chosen: Choices = USUAL,
    checked: Checked | None = None,
    aim: Decision | None = None,
    chooses_workers: bool = False,
) -> list[CheckSection]:
    """Check a survey and describe what `process` would do; nothing is computed and nothing written.

    ``checked`` is that of `require_processable`, if it was called already; others as those of `plan_run`.
    """
    checked = require_processable(folder, chosen) if checked is None else checked
    if checked.survey is None:
        return _without_poses(checked, chosen)
    survey = checked.survey
    workload: Workload | str
    try:
        plan, workload, of_tiles = plan_run(survey, chosen, aim=aim, chooses_workers=chooses_workers)
        warnings = (*checked.ordered_warnings, *of_tiles, *room_warnings(workload, folder / RUN_FOLDER))
    except SurveyError as error:
        if survey.provenance.reprojection is None:
            raise
        # The tie points are still reported, though the survey cannot be processed.
        plan, workload = make_plan(survey, chosen), f"process refuses this survey: {error}"
        warnings = (*checked.ordered_warnings, workload)
    rows = _rows_of_survey(checked.found, survey, plan)
    return _sections(rows, plan.decisions, workload, survey.findings.assumptions, warnings, plan.as_dict())


def _sections(
    rows, decisions: tuple[Decision, ...], workload: Workload | str, assumptions, warnings, plan: dict | None = None
) -> list[CheckSection]:
    decided = (*((d.name, f"{d.choice}: {d.reason}") for d in decisions), ("workload", str(workload)))
    numbers = {**(plan or {}), "workload": workload if isinstance(workload, Workload) else None}
    sections = [CheckSection("Found", tuple(rows)), CheckSection("Plan", decided, numbers)]
    sections += [CheckSection("Assumed", tuple(("", text) for text in assumptions))] if assumptions else []
    sections += [CheckSection("Warnings", tuple(("", text) for text in warnings))] if warnings else []
    return sections


def _rows_of_survey(found: Found, survey: Survey, plan: Plan) -> list[tuple[str, str]]:
    centres = np.array([view.camera.centre for view in survey.views])
    heights = survey.frame.crs_from_local(centres)[:, 2]
    off_nadir = np.degrees([np.arccos(np.clip(-view.camera.cam_from_local[2, 2], -1.0, 1.0)) for view in survey.views])
    shutter = shutter_text(survey.config.cameras, survey.observations.velocities, survey.views, survey.water)
    lenses = Counter((v.lens.model, v.lens.width, v.lens.height, v.lens.focal[0]) for v in survey.views)
    rows = [
        ("survey", f"{survey.name} in {survey.folder}"),
        ("crs", f"{survey.config.crs} ({survey.frame.crs.name})"),
        ("images", f"{len(survey.views)} with a pose, of {len(found.images)} in {found.config.images.dir}"),
        *(
            ("camera", f"{model}, {width} x {height} px, focal length {focal:.1f} px, {count} images")
            for (model, width, height, focal), count in lenses.items()
        ),
        ("poses", f"{survey.config.cameras.poses}, heights {heights.min():.2f} to {heights.max():.2f}"),
        (
            "views",
            f"{_range(off_nadir)} degrees off nadir, one covers {plan.footprint_m[0]:.1f} x "
            f"{plan.footprint_m[1]:.1f} m",
        ),
        ("pixels", f"{length(plan.gsd_m)} on the ground at the size that is worked on, median"),
        ("local frame", f"topocentric at {', '.join(f'{v:.10g}' for v in survey.frame.origin)}"),
        ("water", _water(survey)),
        ("accuracy", accuracy_of_priors(survey.observations.priors)),
        *([] if shutter is None else [("shutter", shutter)]),
        *(() if survey.provenance.reprojection is None else (("tie points", str(survey.provenance.reprojection)),)),
        *control_rows(found.control),
        *mark_rows(survey),
    ]
    if survey.bounds is not None:
        e0, n0, e1, n1 = survey.bounds
        rows.append(("area", f"{e0:.10g} to {e1:.10g} east, {n0:.10g} to {n1:.10g} north"))
    return rows


def _water(survey: Survey) -> str:
    if survey.water is None:
        return "none: a dry survey" if survey.config.dry else "none was given"
    plane, water = survey.require_water()
    east, north = water.known_level_at
    centres = np.array([view.camera.centre for view in survey.views])
    return (
        f"level {water.level_m:g} m at {east:.10g}, {north:.10g}, slope "
        f"{water.slope_east:g} east and {water.slope_north:g} north, index {water.refractive_index:g}; cameras "
        f"{_range(-plane.depth(centres))} m over it"
        f"{water_stds(water, survey.observations.levels, is_index_known=survey.provenance.is_index_known)}"
    )


def _without_poses(checked: Checked, chosen: Choices) -> list[CheckSection]:
    """The sections of a survey that needs structure from motion first."""
    found, by_control = checked.found, placing_control(checked.found)
    if by_control is not None:
        by = f"the marks of {len(by_control.points)} control points, as too few images have a GPS position"
    else:
        like = "heights in crs" if found.config.cameras.gps_height == "crs" else "ellipsoidal heights"
        by = f"GPS positions, heights taken as {like}"
    sfm = Decision("structure from motion", "on", f"there is no poses file; georeferenced by {by}")
    later = Decision("refraction and the rest", "later", "decided once the poses are known")
    decisions = (sfm, device_decision(chosen.device), later)
    sizes = [header.size_px for header in found.headers.values()]
    workload = workload_of_images(sizes, chosen)
    warnings = (*checked.ordered_warnings, *room_warnings(workload, found.folder / RUN_FOLDER))
    return _sections(_rows_without_poses(found), decisions, workload, found.findings.assumptions, warnings)


def _rows_without_poses(found: Found) -> list[tuple[str, str]]:
    """Rows on a survey whose poses are not known yet."""
    places = [header.lat_lon_height for header in found.headers.values() if header.lat_lon_height is not None]
    num_of_size = Counter(header.size_px for header in found.headers.values())
    heights = np.array([height for _, _, height in places])
    on_places = f", heights {_range(heights)} m" if places else ""
    # Of heights in EXIF, where the level of the water places the block.
    std, water = common_up_std_of_exif(found.config.cameras, found.headers, found.datum), found.config.water
    shared_error: list[tuple[str, str]] = []
    if std and not found.config.control.files and water is not None and water.level_m is not None:
        is_stated = found.config.cameras.position_std_m is not None
        unless = "" if is_stated else f", unless positions prove good to {WELL_KNOWN_M:g} m and agree with it"
        shared_error = [
            ("heights", f"may be {std:g} m off, the same for all: the level of the water places the block{unless}")
        ]
    return [
        ("survey", f"{found.name} in {found.folder}"),
        ("crs", f"{found.config.crs} ({found.crs.name})"),
        (
            "images",
            ", ".join(f"{n} of {w} x {h} px" for (w, h), n in num_of_size.items()) + f" in {found.config.images.dir}",
        ),
        (
            "positions",
            f"{len(places)} of {len(found.headers)} images have one in {position_sources(found.headers)}{on_places}",
        ),
        ("poses", "none"),
        ("accuracy", accuracy_of_gps(found.config.cameras, found.headers, found.datum)),
        *shared_error,
        ("water", _water_below(found, heights)),
        *control_rows(found.control),
    ]


def _water_below(found: Found, heights: np.ndarray) -> str:
    """Row on the water under cameras at heights (K,), in crs, of GPS positions."""
    water = found.config.water
    if water is None:
        return "none: a dry survey" if found.config.dry else "none was given"
    if water.level_m is None and water.clicks is not None:
        return f"its level by the clicks in {water.clicks}, once the poses are known"
    if water.level_m is None:
        return "of unknown level: the adjustment finds it, where oblique photographs or a dry shore determine it"
    level = water.level_m / height_unit_m(found.crs)
    over = (
        f"; by {position_sources(found.headers)} the cameras are {_range(heights - level)} m over it"
        if len(heights)
        else ""
    )
    return f"level {water.level_m:g} m{over}{water_stds(water, found.levels)}"


def _range(values: np.ndarray) -> str:
    return f"{np.nanmin(values):.1f} to {np.nanmax(values):.1f}" if np.isfinite(values).any() else "unknown"


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
    is_given = water is None or water.level_m is not None or water.clicks is not None
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
