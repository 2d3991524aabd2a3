"""Cameras as the text of a COLMAP model, which many programs read."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from refract.lens import Lens
from survey.photos.cameras import View
from survey.photos.tie_points import TiePoints

_GREY = "128 128 128"
FILES = ("cameras.txt", "images.txt", "points3D.txt")


def name_with_space(views: Sequence[View]) -> str | None:
    """The first name of a photograph that has a space, at which other readers of the text cut it; None without one."""
    return next((view.name for view in views if len(view.name.split()) != 1), None)


def model_texts(views: Sequence[View], *, head: str, points: str, ties: TiePoints | None = None) -> dict[str, str]:
    """The files of a model in the local frame, by name.

    Parameters
    ----------
    views : sequence of View
    head : str
        Comment lines at the beginning of cameras.txt.
    points : str
        points3D.txt, or only its comment lines where there are ties.
    ties : TiePoints, optional
        Points for points3D.txt, in the places that straight rays give them, with their tracks.
    """
    lenses = tuple(dict.fromkeys(view.lens for view in views))
    cameras = head + "".join(_lens_line(number, lens) for number, lens in enumerate(lenses, start=1))
    seen = [""] * len(views)
    if ties is not None:
        points, seen = points + _point_lines(views, ties), _seen_lines(len(views), ties)
    return dict(zip(FILES, (cameras, "".join(_pose_lines(views, lenses, seen)), points), strict=True))


def _lens_line(number: int, lens: Lens) -> str:
    return f"{number} {lens.model} {lens.width} {lens.height} {' '.join(repr(float(p)) for p in lens.params)}\n"


def _pose_lines(views: Sequence[View], lenses: tuple[Lens, ...], seen: Sequence[str]) -> list[str]:
    """Two lines for each photograph; the second has its points."""
    lines = []
    for number, view in enumerate(views, start=1):
        x, y, z, w = Rotation.from_matrix(view.camera.cam_from_local).as_quat()
        shift = -view.camera.cam_from_local @ view.camera.centre
        numbers = " ".join(repr(float(v)) for v in (w, x, y, z, *shift))
        lines.append(f"{number} {numbers} {lenses.index(view.lens) + 1} {view.name}\n{seen[number - 1]}\n")
    return lines


def _seen_lines(num_views: int, ties: TiePoints) -> list[str]:
    """For each photograph x, y and the number of the point of all observations in it, in their order."""
    return [
        " ".join(
            f"{x:.3f} {y:.3f} {point + 1}" for (x, y), point in zip(ties.pixel[mine], ties.point[mine], strict=True)
        )
        for mine in (np.flatnonzero(ties.view == number) for number in range(num_views))
    ]


def _point_lines(views: Sequence[View], ties: TiePoints) -> str:
    """Number, place, a colour that is not known, error [px] and track of each point."""
    miss, place = np.empty(len(ties.view)), np.empty(len(ties.view), dtype=np.int64)
    for number, view in enumerate(views):
        mine = np.flatnonzero(ties.view == number)
        away = view.camera.project(ties.start[ties.point[mine]], None) - ties.pixel[mine]
        miss[mine], place[mine] = np.linalg.norm(away, axis=1), np.arange(len(mine))
    first = np.searchsorted(ties.point, np.arange(len(ties) + 1))
    lines = []
    for number, (x, y, z) in enumerate(ties.start):
        rows = slice(first[number], first[number + 1])
        track = " ".join(f"{view + 1} {at}" for view, at in zip(ties.view[rows], place[rows], strict=True))
        lines.append(f"{number + 1} {x:.4f} {y:.4f} {z:.4f} {_GREY} {miss[rows].mean():.3f} {track}\n")
    return "".join(lines)
