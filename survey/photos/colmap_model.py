"""Photographs, lenses and tie points as a COLMAP model in the local frame.

Models are written as text, and also in binary where names have spaces, since readers of the text split names there.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from geo.files import write_whole
from refract.lens import MODELS, Lens
from survey.photos.cameras import View
from survey.photos.poses import TiePoints

_GREY = "128 128 128"
FILES = ("cameras.txt", "images.txt", "points3D.txt")


def _binary(name: str) -> str:
    return name.replace(".txt", ".bin")


def has_spaces(views: Sequence[View]) -> bool:
    """Whether a photograph has a space in its name, at which other readers of the text cut it."""
    return any(len(view.name.split()) != 1 for view in views)


def write_model(folder: Path, views: Sequence[View], *, head: str, points: str, ties: TiePoints | None = None) -> None:
    """Write a model in the local frame into a folder that exists: text, and binary too where a name has a space.

    COLMAP prefers binary files to text, so that those of an earlier model are removed. BROWN_AFFINE, which is none of
    its camera models, is written as text alone. ``head`` are the comment lines of cameras.txt, ``points`` is
    points3D.txt, or its comment lines before ``ties``, which have the places that straight rays give them.
    """
    texts = _texts(views, head, points, ties)
    files = {name: text.encode() for name, text in texts.items()}
    if has_spaces(views) and all(MODELS[view.lens.model][0] is not None for view in views):
        for name, packed in zip(FILES, (_cameras_bin, _images_bin, _points_bin), strict=True):
            files[_binary(name)] = packed(texts[name].split("\n")[:-1])
    for name, content in files.items():
        with write_whole(folder / name) as stream:
            stream.write(content)
    for name in map(_binary, FILES):
        if name not in files:
            (folder / name).unlink(missing_ok=True)


def _texts(views: Sequence[View], head: str, points: str, ties: TiePoints | None) -> dict[str, str]:
    lenses = tuple(dict.fromkeys(view.lens for view in views))
    cameras = head + "".join(_lens_line(number, lens) for number, lens in enumerate(lenses, start=1))
    seen = [""] * len(views)
    if ties is not None:
        points, seen = points + _point_lines(views, ties), _observation_lines(len(views), ties)
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


def _observation_lines(num_views: int, ties: TiePoints) -> list[str]:
    """Lines of each photograph: x, y and the number of the point of all observations in it, in their order."""
    return [
        " ".join(
            f"{x:.3f} {y:.3f} {point + 1}" for (x, y), point in zip(ties.pixel[rows], ties.point[rows], strict=True)
        )
        for rows in (np.flatnonzero(ties.view == number) for number in range(num_views))
    ]


def _point_lines(views: Sequence[View], ties: TiePoints) -> str:
    """Number, place, a colour that is not known, error [px] and track of each point."""
    residual, place = np.empty(len(ties.view)), np.empty(len(ties.view), dtype=np.int64)
    for number, view in enumerate(views):
        observed = np.flatnonzero(ties.view == number)
        misfit = view.camera.project(ties.start[ties.point[observed]], None) - ties.pixel[observed]
        residual[observed], place[observed] = np.linalg.norm(misfit, axis=1), np.arange(len(observed))
    first = np.searchsorted(ties.point, np.arange(len(ties) + 1))
    lines = []
    for number, (x, y, z) in enumerate(ties.start):
        rows = slice(first[number], first[number + 1])
        track = " ".join(f"{view + 1} {at}" for view, at in zip(ties.view[rows], place[rows], strict=True))
        lines.append(f"{number + 1} {x:.4f} {y:.4f} {z:.4f} {_GREY} {residual[rows].mean():.3f} {track}\n")
    return "".join(lines)


def _cameras_bin(lines: Sequence[str]) -> bytes:
    rows = [line.split() for line in lines if not line.startswith("#")]
    packed = [struct.pack("<Q", len(rows))]
    for number, model, width, height, *params in rows:
        packed.append(struct.pack("<IiQQ", int(number), MODELS[model][0], int(width), int(height)))
        packed.append(struct.pack(f"<{len(params)}d", *map(float, params)))
    return b"".join(packed)


def _images_bin(lines: Sequence[str]) -> bytes:
    packed = [struct.pack("<Q", len(lines) // 2)]
    for line, points in zip(lines[::2], lines[1::2], strict=True):
        number, *pose, camera, name = line.split(" ", 9)
        seen = points.split()
        packed.append(struct.pack("<I7dI", int(number), *map(float, pose), int(camera)) + name.encode() + b"\0")
        packed.append(struct.pack("<Q", len(seen) // 3))
        for x, y, point in zip(seen[::3], seen[1::3], seen[2::3], strict=True):
            packed.append(struct.pack("<ddQ", float(x), float(y), int(point)))
    return b"".join(packed)


def _points_bin(lines: Sequence[str]) -> bytes:
    rows = [line.split() for line in lines if not line.startswith("#")]
    packed = [struct.pack("<Q", len(rows))]
    for number, x, y, z, r, g, b, error, *track in rows:
        place, colour = map(float, (x, y, z)), map(int, (r, g, b))
        packed.append(struct.pack("<Q3d3BdQ", int(number), *place, *colour, float(error), len(track) // 2))
        packed.append(struct.pack(f"<{len(track)}I", *map(int, track)))
    return b"".join(packed)
