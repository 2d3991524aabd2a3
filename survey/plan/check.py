"""`bathynerf check`: findings, assumptions, warnings, and the plan with its cost."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from geo.crs import height_unit_m
from survey.display.quantities import length
from survey.errors import SurveyError
from survey.folder.found import Found, find_survey
from survey.folder.motion import shutter_text
from survey.folder.pose_priors import accuracy_of_gps, accuracy_of_priors, common_up_std_of_exif
from survey.folder.sfm_views import placing_control, require_solvable
from survey.folder.survey import Survey, load_survey
from survey.photos.exif import position_sources
from survey.plan.area import require_seen
from survey.plan.check_inputs import control_rows, level_warning, mark_rows, water_stds
from survey.plan.choices import USUAL, Choices
from survey.plan.plan import Decision, Plan, device_decision, make_plan, require_placeable
from survey.plan.tile_choice import plan_run, require_dask
from survey.plan.workload import Workload, room_warnings, workload_of_images
from survey.settings.config import SurveyConfig
from survey.sfm.datum import WELL_KNOWN_M
from survey.sfm.settings import mapper_of
from survey.words import RUN_FOLDER, Device


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
        """All warnings; first the one about a run that would end without a cloud."""
        return self.warnings if self.level_warning is None else (self.level_warning, *self.warnings)


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
    mapper = Decision("mapper", *mapper_of(len(found.headers), found.config.cameras.mapper))
    later = Decision("refraction and the rest", "later", "decided once the poses are known")
    decisions = (sfm, mapper, device_decision(chosen.device), later)
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
    if water.level_m is None and water.sources.clicks is not None:
        return f"its level by the clicks in {water.sources.clicks}, once the poses are known"
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
