"""Priors of the lenses of an adjustment: a data sheet, a calibration, or what survey.toml has."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from refract.lens import MODELS, Lens
from survey.adjust.block.state import BROWN, HELD_SHARE, LENS_NAMES, NUM_LENS, is_held

if TYPE_CHECKING:
    from survey.folder.survey import Survey

# A lens by its data sheet: focal lengths are within 2 % of it, the principal point within 1 % of the longer side. At
# the corner of the image each term of distortion moves a pixel by some of these shares of its distance from the middle
# (docs/adjustment.md).
FOCAL_SHARE, _MIDDLE_SHARE, _RADIAL_SHARES, _DECENTRED_SHARE = 0.02, 0.01, (0.06, 0.04, 0.02), 0.004
# By how much smaller than a data sheet's the errors of the lens of an adjusted block are.
_CALIBRATED = 0.02
# The same of a lens whose distortion survey.toml has, of two photographs: they do not calibrate it.
_GIVEN_LENS = 0.05


def parameters_of(lens: Lens) -> np.ndarray:
    """A lens as parameters (8,) of the adjustment."""
    if is_held(lens):
        # Its tie points are straightened: what is left is its pinhole.
        return np.array([lens.focal[0], lens["cx"], lens["cy"], *np.zeros(NUM_LENS - 3)])
    return np.array([lens.focal[0], *(lens[name] for name in LENS_NAMES[1:])])


def data_sheet(survey: Survey, lens: Lens) -> np.ndarray:
    """The lens before any photograph was taken with it.

    Straight rays take some of the bend at the water into the focal length: of photographs without poses that in EXIF
    counts, not that of structure from motion.
    """
    given = parameters_of(lens)
    cameras = survey.config.cameras
    if survey.observations.ties is None or is_held(lens) or cameras.poses is not None:
        return given
    focal = cameras.focal_px[0] if isinstance(cameras.focal_px, tuple) else cameras.focal_px
    if focal is None:
        in_exif = survey.observations.exif_focals
        focal = next((in_exif[view.name] for view in survey.views if view.lens == lens and view.name in in_exif), None)
    middle = cameras.principal_point_px or (0.5 * lens.width, 0.5 * lens.height)
    names = MODELS[cameras.model][1] if cameras.model in BROWN else ()
    given_by_name = dict(zip([name for name in names if name[0] in "kp"], cameras.distortion or (), strict=False))
    coefficients = [given_by_name.get(name, 0.0) for name in LENS_NAMES[3:]]
    return np.array([given[0] if focal is None else focal, *middle, *coefficients])


def lenses_std(survey: Survey, lenses: tuple[Lens, ...], *, calibrated: bool) -> np.ndarray:
    """Std of the parameters of all lenses (8 L,), by a data sheet, a calibration or the settings."""
    is_given = len(survey.views) == 2 and survey.config.cameras.distortion is not None
    share = _CALIBRATED if calibrated else _GIVEN_LENS if is_given else 1.0
    return np.concatenate([share * _lens_std(lens) for lens in lenses])


def _lens_std(lens: Lens) -> np.ndarray:
    focal, side = lens.focal[0], max(lens.width, lens.height)
    corner = 0.5 * math.hypot(lens.width, lens.height) / focal
    radial = np.array(_RADIAL_SHARES) / corner ** np.array([2, 4, 6])
    decentred = _DECENTRED_SHARE / corner
    middle = _MIDDLE_SHARE * side
    std = np.array([FOCAL_SHARE * focal, middle, middle, *radial, decentred, decentred])
    return HELD_SHARE * std if is_held(lens) else std


def focals_std(lens_of: np.ndarray, focals: np.ndarray, *, calibrated: bool) -> np.ndarray:
    """Std of the focal lengths of photographs (V,): their scatter about that of their lens; held where it has none."""
    if not len(focals):
        return focals
    scatter = np.sqrt(np.bincount(lens_of, focals**2) / np.bincount(lens_of))
    std = np.where(scatter > 0.0, _CALIBRATED * FOCAL_SHARE, 0.0) if calibrated else scatter
    return np.maximum(std, HELD_SHARE * FOCAL_SHARE)[lens_of]
