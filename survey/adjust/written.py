"""The adjusted cameras as files, that other programs read and that can be given back as [cameras] poses."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from geo.crs import is_geographic
from geo.files import write_whole
from survey.folder.shutter import rows_between
from survey.folder.survey import Survey, View
from survey.photos.cameras import CAM_FROM_OPK_CAM
from survey.photos.colmap_text import FILES, model_texts

# Decimals of coordinates in metres and in degrees: to a tenth of a micrometre, so that nothing is lost.
_DECIMALS_M, _DECIMALS_DEG = 7, 12
CAMERAS = "cameras.csv"
MODEL = tuple(f"sparse/{name}" for name in FILES)


def write_cameras(folder: Path, survey: Survey) -> None:
    """Write cameras.csv (positions in crs; omega, phi, kappa) and a COLMAP model (topocentric) into a folder.

    The model says in its first lines how survey.toml gives it back. Where shutters roll, cameras.csv has further
    columns, how far each camera flew from the first row to the last [m], true east, north and up.
    """
    (folder / "sparse").mkdir(exist_ok=True)
    points = "# the points of the adjustment are in adjustment.npz\n"
    model = model_texts(survey.views, head=_given_back(survey), points=points)
    texts = {CAMERAS: _opk(survey)} | {f"sparse/{name}": text for name, text in model.items()}
    for name, text in texts.items():
        with write_whole(folder / name) as stream:
            stream.write(text.encode())


def _given_back(survey: Survey) -> str:
    origin = ", ".join(repr(float(v)) for v in survey.frame.origin)
    shutter = ""
    if any(view.camera.motion is not None for view in survey.views):
        shutter = f", rolling_shutter_s = {survey.config.cameras.rolling_shutter_s!r}"
    return f'# In survey.toml: [cameras] poses = "sparse"{shutter} and [local] origin = [{origin}]\n'


def _opk(survey: Survey) -> str:
    centres = survey.frame.crs_from_local(np.array([view.camera.centre for view in survey.views]))
    decimals = _DECIMALS_DEG if is_geographic(survey.frame.crs) else _DECIMALS_M
    places = (decimals, decimals, _DECIMALS_M)
    rolls = any(view.camera.motion is not None for view in survey.views)
    lines = ["image,easting,northing,height,omega,phi,kappa" + (",flown_east,flown_north,flown_up" if rolls else "")]
    for view, centre, axes in zip(survey.views, centres, survey.frame.local_from_grid(centres), strict=True):
        r = axes.T @ view.camera.cam_from_local.T @ CAM_FROM_OPK_CAM
        angles = (math.atan2(-r[1, 2], r[2, 2]), math.asin(r[0, 2]), math.atan2(-r[0, 1], r[0, 0]))
        numbers = [f"{v:.{digits}f}" for v, digits in zip(centre, places, strict=True)]
        numbers += [f"{math.degrees(v):.10f}" for v in angles]
        numbers += [f"{v:.{_DECIMALS_M}f}" for v in _flown(view)] if rolls else []
        lines.append(",".join([view.name, *numbers]))
    return "\n".join([*lines, ""])


def _flown(view: View) -> np.ndarray:
    """From the first row of a photograph to the last (3,) [m], local."""
    motion = view.camera.motion
    return np.zeros(3) if motion is None else motion * rows_between(view.lens.height)
