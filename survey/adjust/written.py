"""The adjusted cameras as files, that other programs read and that can be given back as [cameras] poses."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from geo.crs import is_geographic
from geo.files import write_whole
from refract.lens import Lens
from survey.folder.shutter import rows_between
from survey.folder.survey import Survey, View
from survey.photos.cameras import CAM_FROM_OPK_CAM

# Decimals of coordinates in metres and in degrees: to a tenth of a micrometre, so that nothing is lost.
_DECIMALS_M, _DECIMALS_DEG = 7, 12
CAMERAS = "cameras.csv"
MODEL = ("sparse/cameras.txt", "sparse/images.txt", "sparse/points3D.txt")


def write_cameras(folder: Path, survey: Survey) -> None:
    """Write cameras.csv (positions in crs; omega, phi, kappa) and a COLMAP model (topocentric) into a folder.

    The model says in its first lines how survey.toml gives it back. Where shutters roll, cameras.csv has further
    columns, how far each camera flew from the first row to the last [m], true east, north and up.
    """
    lenses = tuple(dict.fromkeys(view.lens for view in survey.views))
    (folder / "sparse").mkdir(exist_ok=True)
    texts = {
        CAMERAS: _opk(survey),
        MODEL[0]: _given_back(survey) + "".join(_lens_line(i, lens) for i, lens in enumerate(lenses, start=1)),
        MODEL[1]: "".join(_pose_lines(survey, lenses)),
        MODEL[2]: "# the points of the adjustment are in adjustment.npz\n",
    }
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


def _lens_line(number: int, lens: Lens) -> str:
    return f"{number} {lens.model} {lens.width} {lens.height} {' '.join(repr(float(p)) for p in lens.params)}\n"


def _pose_lines(survey: Survey, lenses: tuple[Lens, ...]) -> list[str]:
    """Two lines for each photograph; the second, its points, is empty."""
    lines = []
    for number, view in enumerate(survey.views, start=1):
        x, y, z, w = Rotation.from_matrix(view.camera.cam_from_local).as_quat()
        shift = -view.camera.cam_from_local @ view.camera.centre
        numbers = " ".join(repr(float(v)) for v in (w, x, y, z, *shift))
        lines.append(f"{number} {numbers} {lenses.index(view.lens) + 1} {view.name}\n\n")
    return lines
