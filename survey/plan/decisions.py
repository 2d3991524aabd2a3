"""Decisions of the plan: whether poses are adjusted before the sweep, and which parts a scene does not need."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from refract.distortion import kinds_of
from survey.errors import SurveyError
from survey.folder.pose_priors import BY_FILE
from survey.folder.survey import Survey
from survey.plan.area import beyond_bounds
from survey.words import Poses

# Pose errors that add less than this are negligible against the noise of matching, about a third of a pixel. Simulated
# surveys with exact poses have 0.001 to 0.08, with errors of 1 cm and 0.01 degrees 0.14 to 0.23 (docs/adjustment.md).
MOST_MISFIT_PX = 0.1
# The check of poses needs at least this many views.
_FEWEST_VIEWS = 12
_UNSTATED = "poses from a file without position_std_m count as exact"


@dataclass(frozen=True)
class Decision:
    """Decision of the plan: subject, choice and reason."""

    name: str
    choice: str
    reason: str


def refraction(survey: Survey) -> Decision:
    """Decision on refraction."""
    if survey.water is None:
        return Decision("refraction", "off", "a dry survey, without [water]")
    water, given = survey.require_water()
    if water.n_water == 1.0:
        return Decision("refraction", "off", "the index of the water is 1, as if it were air")
    slope = math.hypot(water.slope_x, water.slope_y)
    tilt = f", sloped by {slope:.4f}" if slope > 1e-6 else ""
    outlines = [view.camera.directions(view.camera.outline()) for view in survey.views]
    num_to_horizon = sum(bool((rays @ np.array(water.up) >= 0.0).any()) for rays in outlines)
    horizon = (
        f"; {num_to_horizon} of {len(survey.views)} views look past the water to the horizon" if num_to_horizon else ""
    )
    return Decision("refraction", "on", f"water of index {water.n_water:.4f} at {given.level_m:g} m{tilt}{horizon}")


def lens_terms(survey: Survey) -> Decision:
    """Decision on the lens terms of the kernels."""
    cameras = [view.camera for view in survey.views]
    found = sorted(kinds_of(camera.distortion for camera in cameras))
    found += ["rolling shutter"] * any(camera.motion is not None for camera in cameras)
    reason = "no camera has others" if found else "no camera has distortion or a rolling shutter"
    return Decision("terms of the lens", ", ".join(found) if found else "none", reason)


def pixels(survey: Survey) -> Decision:
    """Decision on the pixels that get a height."""
    if survey.bounds is None:
        return Decision("pixels", "all", "there are no [area] bounds")
    return Decision(
        "pixels", "those that may see the area", f"the cloud ends {beyond_bounds(survey):.2f} m beyond [area] bounds"
    )


def finer_passes(field: str) -> Decision:
    """Decision on the pixels that are refined at full size."""
    if field != "solver":
        return Decision("finer passes", "all pixels", "heights of points are means over views: all of them are refined")
    reason = "the solver solves these again; the others confirm them with the heights that they have"
    return Decision("finer passes", "pixels that become points", reason)


def require_placeable(reference: str | None, asked: str) -> None:
    """Raise SurveyError where an earlier survey is to place a block whose poses are to be kept."""
    if reference is not None and asked == Poses.fixed:
        raise SurveyError(
            f"[control] reference = {reference!r} places the block by an adjustment, and --poses fixed leaves it out; "
            "leave out --poses fixed, or reference"
        )


def pose_choice(survey: Survey, asked: str, *, free_water: bool) -> tuple[str, str]:
    """Choice ("refine", "fixed", or "check" first) and its reason, for the plan."""
    if survey.provenance.is_adjusted:
        return "refine", "adjusted with lens and water; see adjustment.json"
    if free_water and asked == Poses.fixed:
        raise SurveyError("--calibrate-water estimates the water together with the poses; leave out --poses fixed")
    if asked == Poses.fixed and not survey.provenance.is_level_known:
        raise SurveyError(
            "[water] has no level, and --poses fixed leaves out the adjustment that would estimate it; give level_m, "
            "or leave out --poses fixed"
        )
    require_placeable(survey.config.control.reference, asked)
    if asked != Poses.auto:
        return asked, "set by --poses"
    reason = _reason_to_refine(survey, free_water=free_water)
    return _choice_by_check(survey) if reason is None else ("refine", reason)


def _reason_to_refine(survey: Survey, *, free_water: bool) -> str | None:
    """What a survey has, or asks to estimate, that takes an adjustment; None where a check is to decide."""
    given, cameras, water = survey.observations, survey.config.cameras, survey.config.water
    if given.ties is not None:
        return "structure from motion ignores refraction: poses, lens and water are adjusted with bent rays"
    if given.control is not None:
        return "there are control points to adjust to"
    if given.ground is not None:
        return "there is an earlier survey to place the block on"
    sources = {prior.source for prior in given.priors.values()}
    if "survey.toml" in sources:
        return "adjusted within the accuracy that survey.toml states for them"
    if cameras.rolling_shutter_std_s is not None:
        return "rolling_shutter_std_s asks to estimate the readout time of the shutter"
    if water is not None and water.rate.level_rate_std_m_per_h is not None:
        return "level_rate_std_m_per_h asks to estimate the rate of the level"
    if BY_FILE in sources:
        return "adjusted within the accuracy that the poses file states for the positions"
    if free_water:
        return "--calibrate-water estimates the water together with poses and lens"
    tool = survey.provenance.tool
    if tool is not None and survey.water is not None:
        # Poses that were adjusted without refraction cannot be used to test the water.
        return f"{tool} ignored refraction: poses, lens and water are adjusted with bent rays"
    return None


def _choice_by_check(survey: Survey) -> tuple[str, str]:
    """Choice by the misfit between photographs under the given poses, and its reason."""
    provenance, num = survey.provenance, len(survey.views)
    if num < _FEWEST_VIEWS:
        return "fixed", f"{_UNSTATED}; a check needs at least {_FEWEST_VIEWS} views, and there are {num}"
    if provenance.pose_misfit_px is None:
        return "check", f"{_UNSTATED}, unless photographs contradict them"
    if provenance.pose_misfit_px < 0.0:
        return "fixed", f"{_UNSTATED}; too few matches to check them"
    message = f"reprojection misfit {provenance.pose_misfit_px:.2f} px with the given poses"
    if provenance.contradiction is not None:
        return "refine", f"{message}, and {provenance.contradiction}: water, poses and lens are adjusted"
    if provenance.pose_misfit_px > MOST_MISFIT_PX:
        return "refine", f"{message}, more than {MOST_MISFIT_PX:g}: poses, lens and water are adjusted"
    return "fixed", f"{message}, at most {MOST_MISFIT_PX:g}: they need no adjustment"
