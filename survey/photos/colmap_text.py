"""Cameras as the text of a COLMAP model, which many programs read."""

from __future__ import annotations

from collections.abc import Sequence

from scipy.spatial.transform import Rotation

from refract.lens import Lens
from survey.photos.cameras import View

FILES = ("cameras.txt", "images.txt", "points3D.txt")


def model_texts(views: Sequence[View], *, head: str, points: str) -> dict[str, str]:
    """The files of a model in the local frame, by name.

    Parameters
    ----------
    views : sequence of View
    head : str
        Comment lines at the beginning of cameras.txt.
    points : str
        points3D.txt.
    """
    lenses = tuple(dict.fromkeys(view.lens for view in views))
    cameras = head + "".join(_lens_line(number, lens) for number, lens in enumerate(lenses, start=1))
    return dict(zip(FILES, (cameras, "".join(_pose_lines(views, lenses)), points), strict=True))


def _lens_line(number: int, lens: Lens) -> str:
    return f"{number} {lens.model} {lens.width} {lens.height} {' '.join(repr(float(p)) for p in lens.params)}\n"


def _pose_lines(views: Sequence[View], lenses: tuple[Lens, ...]) -> list[str]:
    """Two lines for each photograph; the second, its points, is empty."""
    lines = []
    for number, view in enumerate(views, start=1):
        x, y, z, w = Rotation.from_matrix(view.camera.cam_from_local).as_quat()
        shift = -view.camera.cam_from_local @ view.camera.centre
        numbers = " ".join(repr(float(v)) for v in (w, x, y, z, *shift))
        lines.append(f"{number} {numbers} {lenses.index(view.lens) + 1} {view.name}\n\n")
    return lines
