"""Lines of the plan about parts that a scene does not need; docs/plan.md has what each saves and costs."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fields.skips import Skips
from refract import FlatWater, PinholeCamera
from refract.distortion import kinds_of
from survey.folder.survey import Survey
from survey.plan.area import beyond_bounds

FULL = "--plan full"


@dataclass(frozen=True)
class Decision:
    """Decision of the plan: subject, choice and reason."""

    name: str
    choice: str
    reason: str


def refraction(survey: Survey, skips: Skips) -> Decision:
    """Decision on refraction."""
    straight = survey.water is None or survey.water.n_water == 1.0
    if straight and not skips.air:
        return Decision("refraction", "on", f"{FULL}: with an index of 1")
    if survey.water is None:
        return Decision("refraction", "off", "a dry survey, without [water]")
    water, given = survey.require_water()
    if straight:
        return Decision("refraction", "off", "the index of the water is 1, as if it were air")
    slope = math.hypot(water.slope_x, water.slope_y)
    tilt = f", sloped by {slope:.4f}" if slope > 1e-6 else ""
    aside = sum(_sees_beside_water(view.camera, water) for view in survey.views)
    horizon = f"; {aside} of {len(survey.views)} views look past the water to the horizon" if aside else ""
    return Decision("refraction", "on", f"water of index {water.n_water:.4f} at {given.level_m:g} m{tilt}{horizon}")


def _sees_beside_water(camera: PinholeCamera, water: FlatWater) -> bool:
    return bool((camera.directions(camera.outline()) @ np.array(water.up) >= 0.0).any())


def lens_terms(survey: Survey, skips: Skips) -> Decision:
    """Decision on the lens terms of the kernels."""
    if not skips.lens:
        return Decision("terms of the lens", "all", f"{FULL}: every model of distortion, and a rolling shutter")
    cameras = [view.camera for view in survey.views]
    found = sorted(kinds_of(camera.distortion for camera in cameras))
    found += ["rolling shutter"] * any(camera.motion is not None for camera in cameras)
    reason = "no camera has others" if found else "no camera has distortion or a rolling shutter"
    return Decision("terms of the lens", ", ".join(found) if found else "none", reason)


def pixels(survey: Survey, skips: Skips) -> Decision:
    """Decision on the pixels that get a height."""
    if not skips.area:
        return Decision("pixels", "all", f"{FULL}: also those that cannot see the area")
    if survey.bounds is None:
        return Decision("pixels", "all", "there are no [area] bounds")
    return Decision(
        "pixels", "those that may see the area", f"the cloud ends {beyond_bounds(survey):.2f} m beyond [area] bounds"
    )


def finer_passes(field: str, skips: Skips, *, aimed: bool) -> Decision:
    """Decision on the pixels that are refined at full size."""
    if aimed:
        return Decision("finer passes", "all pixels", "later rounds go on from the heights of earlier ones")
    if field != "solver":
        return Decision("finer passes", "all pixels", "heights of points are means over views: all of them are refined")
    if not skips.points:
        return Decision("finer passes", "all pixels", f"{FULL}: not only those that become points")
    reason = "the solver solves these again; the others confirm them with the heights that they have"
    return Decision("finer passes", "pixels that become points", reason)


def first_heights(skips: Skips) -> Decision:
    """Decision on the height hypotheses of the first pass."""
    if not skips.heights:
        return Decision("first heights", "the whole range", f"{FULL}: not only where thumbnails find the bed")
    return Decision("first heights", "those of thumbnails", "a sweep of eight small photographs finds where the bed is")
