"""Photographs that show a point of the bed: rays, windows about it, and its attributes as text."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from geo.crs import is_geographic
from refract import FlatWater
from survey.display.quantities import MINUS, length, number
from survey.photos.cameras import View
from survey.photos.images import load_image
from survey.photos.opening import damage_named, open_image
from survey.viewer.shown import SCALES, Shown
from survey.viewer.tree import CloudTree, is_blocked

# Longer side of a photograph that stands in its camera [px].
THUMBNAIL_PX = 160
# Side of a window of a photograph, how much it is enlarged, and windows beside each other.
WINDOW_PX, ENLARGED, _BESIDE = 48, 3, 3
# Bytes of decoded photographs that are kept for the next click.
_MOST_BYTES = 500_000_000
_LINE, _CROSS = 16, 6
# Points so near to a ray block it, and those so near to its point do not, in ground sampling distances: a ray 35
# degrees off nadir leaves a bed of that slope within them.
_BLOCKS_GSD, _FREE_GSD = 1.0, 6.0
_INK, _PAPER, _MARK = (34, 48, 60), (255, 255, 255), (255, 230, 0)


@dataclass(frozen=True)
class Sighting:
    """Sighting of a point in a photograph whose frame holds it; see `unhidden` for what occludes it."""

    view: View
    pixel: np.ndarray  # (2,) [px]
    # camera, crossing, point (3,) [m], local: corners of the ray; the crossing of the water is the point itself where
    # the ray is straight
    camera: np.ndarray
    crossing: np.ndarray
    point: np.ndarray
    incidence: float  # [rad]: between the ray in air and the vertical

    @property
    def is_bent(self) -> bool:
        """Whether the ray goes through water."""
        return bool((self.crossing != self.point).any())


def sightings_of(views: Sequence[View], point: np.ndarray, water: FlatWater | None) -> list[Sighting]:
    """The photographs whose frames hold a point (3,) [m], local, as seen through the water; the steepest first."""
    found = [sighting for view in views if (sighting := _sighting(view, point, water)) is not None]
    return sorted(found, key=lambda sighting: sighting.incidence)


def unhidden(seen: Sequence[Sighting], tree: CloudTree, gsd_m: float) -> list[Sighting]:
    """The sightings whose rays no point of the cloud blocks, in the water and in the air.

    Within some ground sampling distances of the point the bed that it lies on is not told from what blocks it.
    """
    width, free = _BLOCKS_GSD * gsd_m, _FREE_GSD * gsd_m

    def is_free(sighting: Sighting) -> bool:
        legs = [(sighting.point, sighting.crossing, free), (sighting.crossing, sighting.camera, 0.0)]
        if not sighting.is_bent:
            legs = [(sighting.point, sighting.camera, free)]
        return not any(is_blocked(tree, start, end, width_m=width, free_m=gap) for start, end, gap in legs)

    return [sighting for sighting in seen if is_free(sighting)]


def _sighting(view: View, point: np.ndarray, water: FlatWater | None) -> Sighting | None:
    camera = view.camera
    pixel = camera.project(point, water)
    if not camera.sees(pixel):
        return None
    path = camera.paths(pixel, water)
    # A dry point lies before the place where its ray would meet the water.
    is_bent = bool(path.wet) and float(path.air_length) < float(np.linalg.norm(point - path.origin))
    incidence = float(np.arccos(np.clip(-path.air_direction[2], -1.0, 1.0)))
    return Sighting(view, pixel, path.origin, path.crossing if is_bent else point, point, incidence)


def thumbnail(view: View, longer_px: int = THUMBNAIL_PX) -> np.ndarray:
    """A photograph (height, width, 3) uint8 whose longer side has about so many pixels."""
    scale = min(longer_px / max(view.camera.width, view.camera.height), 1.0)
    size = max(round(view.camera.width * scale), 1), max(round(view.camera.height * scale), 1)
    with open_image(view.path) as image:
        if image.format == "JPEG":
            with damage_named(f"{view.path} is damaged or cut off"):
                # A JPEG gives an eighth of its size without the work for the rest.
                image.draft("RGB", size)
                return np.asarray(image.convert("RGB").resize(size))
    return load_image(view, scale=scale)


class Photographs:
    """Photographs at full size, the last ones that were asked for kept in memory."""

    def __init__(self, views: Sequence[View]):
        pixels = max((view.camera.width * view.camera.height for view in views), default=1)
        by_name = {view.name: view for view in views}
        self._load: Callable[[str], np.ndarray] = lru_cache(max(_MOST_BYTES // (3 * pixels), 2))(
            lambda name: load_image(by_name[name])
        )

    def window(self, sighting: Sighting, side_px: int = WINDOW_PX) -> np.ndarray:
        """The photograph (side, side, 3) uint8 about the place where it shows the point, its middle on the point."""
        # OpenCV counts from the centre of the first pixel.
        u, v = (sighting.pixel - 0.5).astype(np.float64)
        return cv2.getRectSubPix(self._load(sighting.view.name), (side_px, side_px), (float(u), float(v)))


def mosaic(windows: Sequence[np.ndarray], names: Sequence[str]) -> np.ndarray:
    """Windows (side, side, 3) of one size, enlarged, under their names and with a mark in the middle."""
    side = windows[0].shape[0] * ENLARGED
    rows = math.ceil(len(windows) / _BESIDE)
    sheet = np.full((rows * (side + _LINE), min(len(windows), _BESIDE) * side, 3), _PAPER, dtype=np.uint8)
    for place, (window, name) in enumerate(zip(windows, names, strict=True)):
        top, left = (place // _BESIDE) * (side + _LINE), (place % _BESIDE) * side
        large = cv2.resize(window, (side, side), interpolation=cv2.INTER_NEAREST)
        middle = side // 2
        for gap in (-1, 1):
            start, end = middle + gap * _CROSS, middle + 3 * gap * _CROSS
            cv2.line(large, (start, middle), (end, middle), _MARK, 1)
            cv2.line(large, (middle, start), (middle, end), _MARK, 1)
        sheet[top + _LINE : top + _LINE + side, left : left + side - 2] = large[:, :-2]
        cv2.putText(sheet, name[-20:], (left + 2, top + 12), cv2.FONT_HERSHEY_SIMPLEX, 0.38, _INK, 1, cv2.LINE_AA)
    return sheet


def facts_of(
    shown: Shown, row: int, seen: Sequence[Sighting] | None = None, num_hidden: int = 0
) -> list[tuple[str, str]]:
    """A point of the cloud, as labels and texts; with the photographs that show it, and how many it is hidden from."""
    frame = shown.new_frame()
    east, north, height = frame.crs_from_local(shown.tree.points[row][None])[0]
    names, digits = (("longitude", "latitude"), 8) if is_geographic(frame.crs) else (("easting", "northing"), 3)
    rows = [(names[0], number(east, digits)), (names[1], number(north, digits)), ("height", number(height, 3))]
    for kind, scale in SCALES.items():
        if kind != "height" and kind in shown.columns:
            value = float(shown.columns[kind][row])
            rows.append((scale.label, number(value, 0) if kind == "num_views" else length(value)))
    if seen is not None and not seen:
        rows.append(("shown by", "no photograph"))
    elif seen:
        low, high = (math.degrees(seen[place].incidence) for place in (0, -1))
        rows.append(("shown by", f"{len(seen)} photographs, {low:.0f} to {high:.0f}° off nadir"))
    if num_hidden:
        rows.append(("hidden from", f"{num_hidden} more, by nearer points"))
    return rows


def way_between(start: np.ndarray, end: np.ndarray) -> list[tuple[str, str]]:
    """Distances between two points (3,) [m], local, as labels and texts."""
    away = end - start
    fall = float(away[2])
    return [
        ("distance", length(float(np.linalg.norm(away)))),
        ("in plan", length(float(np.linalg.norm(away[:2])))),
        ("height", ("+" if fall > 0.0 else "") + length(fall).replace("-", MINUS)),
    ]


def markdown(rows: Sequence[tuple[str, str]]) -> str:
    """Labels and texts as a table for the panel."""
    return "\n".join(["| | |", "|---|---|", *(f"| {label} | {text} |" for label, text in rows)])
