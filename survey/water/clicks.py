"""Water level from marks of the waterline in photographs: intersection of their rays.

A place on the waterline is on the surface itself, so that its rays run in air alone and are straight. One photograph
cannot determine its height; so each place has a name, and is marked in two photographs or more.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from geo.crs import height_unit_m
from geo.frames import LocalFrame
from survey.errors import ConfigError, Findings
from survey.files.csv_table import read_table
from survey.photos.cameras import View
from survey.photos.intersection import intersect
from survey.photos.names import ImageNames
from survey.water.level_observation import LevelObservation

# Of a click [px]: the edge of water is rarely sharp.
CLICK_STD_PX = 2.0
# Clicks with residuals beyond this many standard deviations are not of one place.
_MOST_MISS = 5.0


class Click(NamedTuple):
    """A place in a photograph: its pixel (2,) and the standard deviation of that [px]."""

    view: View
    pixel: np.ndarray
    std_px: float


def levels_of_clicks(
    path: Path, views: Sequence[View], frame: LocalFrame
) -> tuple[tuple[LevelObservation, ...], Findings]:
    """Heights of the water at all places that two photographs or more show; a warning is added for others.

    The file has the columns image, x, y, name, and std in pixels if it has it; the centre of the first pixel is at
    0.5, 0.5.
    """
    places, num_without_pose = _clicks_by_place(path, views)
    found, unclear = [], []
    for name, clicks in places.items():
        level = _level_of(clicks, frame)
        if level is None:
            unclear.append(name)
        else:
            found.append(level)
    warnings = []
    if num_without_pose:
        warnings.append(f"{num_without_pose} clicks of {path.name} are in photographs without a pose, and left out")
    if unclear:
        warnings.append(
            f"{len(unclear)} places of {path.name} give no level (first: {unclear[0]}), and are left out: click each "
            "in two photographs or more that see it from different sides, at the same spot"
        )
    if not found:
        raise ConfigError(
            f"{path} has no place that two photographs with poses show, expected image,x,y,name with each name in two "
            "photographs or more; click the same spots of the waterline in several"
        )
    return tuple(found), Findings(warnings=tuple(warnings))


def _clicks_by_place(path: Path, views: Sequence[View]) -> tuple[dict[str, list[Click]], int]:
    """Clicks by the names of their places, and how many are in photographs without a pose."""
    rows = read_table(path, ("image", "x", "y", "name"), optional=("std",), error=ConfigError)
    names, by_name = ImageNames(view.name for view in views), {view.name: view for view in views}
    places: dict[str, list[Click]] = {}
    num_without_pose = 0
    for row in rows:
        view = by_name.get(names.find(row.text("image"), row.where) or "")
        if view is None:
            num_without_pose += 1
            continue
        pixel, std = np.array([row.number("x"), row.number("y")]), row.number("std", default=CLICK_STD_PX)
        if not ((pixel >= 0.0) & (pixel <= (view.camera.width, view.camera.height))).all() or not 0.0 < std <= 100.0:
            raise ConfigError(
                f"{row.where}: x, y, std are {pixel[0]:g}, {pixel[1]:g}, {std:g}, expected a pixel in {view.name} "
                f"({view.camera.width} x {view.camera.height}) and a std above 0 and at most 100; correct it"
            )
        places.setdefault(row.text("name"), []).append(Click(view, pixel, std))
    return places, num_without_pose


def _level_of(clicks: Sequence[Click], frame: LocalFrame) -> LevelObservation | None:
    """Intersection of the rays of clicks, by least squares of pixels; None where they do not meet or fix no height."""
    stds = np.array([std for _, _, std in clicks])
    intersection = intersect(
        [view.camera for view, _, _ in clicks], np.array([pixel for _, pixel, _ in clicks]), stds, None
    )
    if intersection is None or not np.abs(intersection.residuals / stds[:, None]).max() < _MOST_MISS:
        return None
    place = frame.crs_from_local(intersection.place)
    return LevelObservation(
        float(place[2]) * height_unit_m(frame.crs),
        float(np.sqrt(intersection.covariance[2, 2])),
        (float(place[0]), float(place[1])),
        None,
        "clicks",
    )
