"""Photographs, lenses and tie points as a COLMAP model in the local frame.

Models are text, and binary beside it where names have spaces, at which readers of the text cut them.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from geo.files import write_text
from refract.lens import MODELS
from survey.photos.cameras import View
from survey.photos.poses import TiePoints
from survey.progress import current

_GREY = "128 128 128"
FILES = ("cameras.txt", "images.txt", "points3D.txt")
_BINARY = ("cameras.bin", "images.bin", "points3D.bin", "rigs.bin", "frames.bin")


def write_model(folder: Path, views: Sequence[View], *, head: str, points: str, ties: TiePoints | None = None) -> None:
    """Write a model in the local frame into a folder that exists.

    COLMAP prefers binary files to text, so that those of an earlier model are removed. BROWN_AFFINE, which is none of
    its camera models, is written as text alone. ``head`` are the comment lines of cameras.txt, ``points`` is
    points3D.txt, or its comment lines before ``ties``, which have the places that straight rays give them.
    """
    number_of = {lens: number for number, lens in enumerate(dict.fromkeys(view.lens for view in views), start=1)}
    cameras, images = head, ""
    for lens, number in number_of.items():
        params = " ".join(repr(float(p)) for p in lens.params)
        cameras += f"{number} {lens.model} {lens.width} {lens.height} {params}\n"
    lines, seen = ("", [""] * len(views)) if ties is None else _point_lines(views, ties)
    for number, view in enumerate(views, start=1):
        x, y, z, w = Rotation.from_matrix(view.camera.cam_from_local).as_quat()
        shift = -view.camera.cam_from_local @ view.camera.centre
        numbers = " ".join(repr(float(v)) for v in (w, x, y, z, *shift))
        images += f"{number} {numbers} {number_of[view.lens]} {view.name}\n{seen[number - 1]}\n"
    for name, text in zip(FILES, (cameras, images, points + lines), strict=True):
        write_text(folder / name, text)
    for name in _BINARY:
        (folder / name).unlink(missing_ok=True)
    is_cut = any(len(view.name.split()) != 1 for view in views)
    if is_cut and all(MODELS[lens.model][0] is not None for lens in number_of):
        _write_binary(folder, views)


def _write_binary(folder: Path, views: Sequence[View]) -> None:
    """The model of the text with whole names, by pycolmap."""
    try:
        import pycolmap
    except ModuleNotFoundError:
        current().warn(
            f"{folder}: without pycolmap the model is text alone, in which other programs cut names at spaces"
        )
        return
    model = pycolmap.Reconstruction(folder)
    for number, view in enumerate(views, start=1):
        model.images[number].name = view.name
    model.write_binary(folder)


def _point_lines(views: Sequence[View], ties: TiePoints) -> tuple[str, list[str]]:
    """A line of each point, with place, a colour that is not known, error [px] and track; and one of each photograph.

    That has x, y and the number of the point of all observations in it, in their order.
    """
    residual, place = np.empty(len(ties.view)), np.empty(len(ties.view), dtype=np.int64)
    seen = []
    for number, view in enumerate(views):
        observed = np.flatnonzero(ties.view == number)
        pixel, point = ties.pixel[observed], ties.point[observed]
        misfit = view.camera.project(ties.start[point], None) - pixel
        residual[observed], place[observed] = np.linalg.norm(misfit, axis=1), np.arange(len(observed))
        seen.append(" ".join(f"{x:.3f} {y:.3f} {at + 1}" for (x, y), at in zip(pixel, point, strict=True)))
    first = np.searchsorted(ties.point, np.arange(len(ties) + 1))
    lines = []
    for number, (x, y, z) in enumerate(ties.start):
        rows = slice(first[number], first[number + 1])
        track = " ".join(f"{view + 1} {at}" for view, at in zip(ties.view[rows], place[rows], strict=True))
        lines.append(f"{number + 1} {x:.4f} {y:.4f} {z:.4f} {_GREY} {residual[rows].mean():.3f} {track}\n")
    return "".join(lines), seen
