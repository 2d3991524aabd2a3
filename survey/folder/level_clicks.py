"""Water level from marks of the waterline in photographs: intersection of their rays.

A place is on the surface itself, where the water ends: its rays run in air alone and are straight. One photograph tells
nothing, for its ray meets a plane of any height; so each place has a name, and is clicked in two photographs or more.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from geo.crs import height_unit_m
from geo.frames import LocalFrame
from survey.errors import ConfigError
from survey.files.csv_table import read_table
from survey.folder.level_observation import LevelObservation
from survey.photos.cameras import View
from survey.photos.names import ImageNames

# Of a click [px]: the edge of water is rarely sharp.
CLICK_STD_PX = 2.0
# A place whose clicks miss it by this many standard deviations is not one place.
_MOST_MISS = 5.0
# Rays that meet at a smaller angle [rad] than this tell no height.
_LEAST_ANGLE = 0.02
_ROUNDS = 10


class Click(NamedTuple):
    """A place in a photograph: its pixel (2,) and the standard deviation of that [px]."""

    view: View
    pixel: np.ndarray
    std_px: float


def levels_of_clicks(
    path: Path, views: Sequence[View], frame: LocalFrame, warnings: list[str]
) -> tuple[LevelObservation, ...]:
    """Heights of the water at all places that two photographs or more show; a warning is added for others.

    Parameters
    ----------
    path : Path
        CSV with the columns image, x, y, name, and std in pixels if it has it; the centre of the first pixel is at
        0.5, 0.5.
    views, frame : of the survey
    warnings : list of sentences

    Raises
    ------
    ConfigError
        If the file is missing or damaged, or no place is left.
    """
    places, strangers = _clicks_by_place(path, views)
    found, unclear = [], []
    for name, clicks in places.items():
        level = _level_of(clicks, frame)
        if level is None:
            unclear.append("".join(letter for letter in name[:40] if letter.isprintable()))
        else:
            found.append(level)
    if strangers:
        warnings.append(f"{strangers} clicks of {path.name} are in photographs without a pose, and left out")
    if unclear:
        warnings.append(
            f"{len(unclear)} places of {path.name} tell no level (first: {unclear[0]}), and are left out: click each "
            "in two photographs or more that see it from different sides, at the same spot"
        )
    if not found:
        raise ConfigError(
            f"{path} has no place that two photographs with poses show, expected image,x,y,name with each name in two "
            "photographs or more; click the same spots of the waterline in several"
        )
    return tuple(found)


def _clicks_by_place(path: Path, views: Sequence[View]) -> tuple[dict[str, list[Click]], int]:
    """Clicks by the names of their places, and how many are in photographs without a pose."""
    rows = read_table(path, ("image", "x", "y", "name"), optional=("std",), error=ConfigError)
    names, by_name = ImageNames(view.name for view in views), {view.name: view for view in views}
    places: dict[str, list[Click]] = {}
    strangers = 0
    for row in rows:
        view = by_name.get(names.find(row.text("image"), row.where) or "")
        if view is None:
            strangers += 1
            continue
        pixel, std = np.array([row.number("x"), row.number("y")]), row.number("std", default=CLICK_STD_PX)
        if not ((pixel >= 0.0) & (pixel <= (view.camera.width, view.camera.height))).all() or not 0.0 < std <= 100.0:
            raise ConfigError(
                f"{row.where}: x, y, std are {pixel[0]:g}, {pixel[1]:g}, {std:g}, expected a pixel in {view.name} "
                f"({view.camera.width} x {view.camera.height}) and a std above 0 and at most 100; correct it"
            )
        places.setdefault(row.text("name"), []).append(Click(view, pixel, std))
    return places, strangers


def _level_of(clicks: Sequence[Click], frame: LocalFrame) -> LevelObservation | None:
    """Where the rays of clicks meet, by least squares of pixels; None where they do not, or tell no height."""
    rays = np.array([view.camera.directions(pixel) for view, pixel, _ in clicks])
    centres = np.array([view.camera.centre for view, _, _ in clicks])
    cosines = np.clip(rays @ rays.T, -1.0, 1.0)
    if not np.isfinite(rays).all() or np.arccos(cosines.min()) < _LEAST_ANGLE:
        return None
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    point = np.linalg.solve(across.sum(axis=0), np.einsum("nij,nj->i", across, centres))
    std = np.repeat([std for _, _, std in clicks], 2)
    for _ in range(_ROUNDS):
        miss, slope = _misses(clicks, point)
        if not np.isfinite(miss).all() or not np.isfinite(slope).all():
            return None
        step = np.linalg.lstsq(slope / std[:, None], -miss / std, rcond=None)[0]
        point = point + step
        if np.abs(step).max() < 1e-6:
            break
    miss, slope = _misses(clicks, point)
    if not np.abs(miss / std).max() < _MOST_MISS:
        return None
    covariance = np.linalg.inv((slope / std[:, None]).T @ (slope / std[:, None]))
    place = frame.crs_from_local(point)
    return LevelObservation(
        float(place[2]) * height_unit_m(frame.crs),
        float(np.sqrt(covariance[2, 2])),
        (float(place[0]), float(place[1])),
        None,
        "clicks",
    )


def _misses(clicks: Sequence[Click], point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """By how much a point (3,), local, is seen beside its clicks (2 N,) [px], and the derivative (2 N, 3)."""
    miss, slope = [], []
    for view, pixel, _ in clicks:
        step = 1e-6 * np.linalg.norm(view.camera.centre - point)
        moved = view.camera.project(point + step * np.vstack([np.zeros(3), np.eye(3), -np.eye(3)]), None)
        miss.append(moved[0] - pixel)
        slope.append((moved[1:4] - moved[4:]).T / (2.0 * step))
    return np.concatenate(miss), np.concatenate(slope)
