"""Control points in a block of photographs: intersection of the rays of their marks, and outliers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from geo.frames import LocalFrame
from refract import PinholeCamera
from survey.control.points import ControlPoint, Mark
from survey.photos.intersection import equations_of_lines

# A ray further from its point belongs to another one, as a share of the longer side; bent rays, lenses and hands are
# off by far less.
_WRONG_SHARE = 0.01
# Rays that open by less leave the distance of their point to the lens.
_LEAST_ANGLE_DEG = 1.5
# Of a point with more marks, pairs of these alone are tried.
_MOST_TRIED = 30


@dataclass(frozen=True, eq=False)
class BlockControl:
    """Control for a block of photographs."""

    frame: LocalFrame  # That of `ControlPoint.local`
    points: tuple[ControlPoint, ...]  # Control, no check points
    marks: tuple[Mark, ...]
    slack: np.ndarray  # (points,) [m]: by how much straight rays may miss a point: those under water seem to lie higher

    def in_frame(self, frame: LocalFrame) -> BlockControl:
        """The same in another local frame of the same crs."""
        points = tuple(replace(point, local=frame.local_from_crs(np.array(point.crs))) for point in self.points)
        return replace(self, frame=frame, points=points)


@dataclass(frozen=True, eq=False)
class Intersections:
    """Intersections of the rays of marks, by control point."""

    points: tuple[ControlPoint, ...]  # Those with a place
    places: np.ndarray  # (K, 3): of each, in the frame of the block
    ranges: np.ndarray  # (K,): distance of each to its nearest camera, in that frame
    slack: np.ndarray  # (K,) [m]: as that of `BlockControl`
    wrong_marks: tuple[Mark, ...]  # That miss a point whose other marks meet
    inconsistent: tuple[str, ...]  # Names of points whose marks do not meet, and none can be told to be right
    # Names of points with fewer than two marks in the block, or that are seen from one direction
    single: tuple[str, ...]


def intersect_marks(control: BlockControl, views: Mapping[str, PinholeCamera]) -> Intersections:
    """Intersections of the rays of the marks of each point in a block."""
    marks_of: dict[str, list[Mark]] = {point.name: [] for point in control.points}
    for mark in control.marks:
        if mark.point in marks_of and mark.view in views:
            marks_of[mark.point].append(mark)
    points, places, ranges, slack = [], [], [], []
    wrong: list[Mark] = []
    inconsistent: list[str] = []
    single: list[str] = []
    for point, own_slack in zip(control.points, control.slack, strict=True):
        marks = marks_of[point.name]
        if len(marks) < 2:
            single.append(point.name)
            continue
        place, good = _majority_point(marks, views)
        if place is None:
            (inconsistent if (~good).any() else single).append(point.name)
            continue
        points.append(point)
        places.append(place)
        ranges.append(min(np.linalg.norm(views[mark.view].centre - place) for mark in marks))
        slack.append(own_slack)
        wrong += [mark for mark, is_good in zip(marks, good, strict=True) if not is_good]
    return Intersections(
        points=tuple(points),
        places=np.array(places).reshape(-1, 3),
        ranges=np.array(ranges),
        slack=np.array(slack),
        wrong_marks=tuple(wrong),
        inconsistent=tuple(inconsistent),
        single=tuple(single),
    )


def swapped_marks(control: BlockControl) -> BlockControl:
    """The control with x and y of its marks swapped."""
    return replace(control, marks=tuple(replace(mark, pixel=mark.pixel[::-1]) for mark in control.marks))


def _majority_point(marks: list[Mark], views: Mapping[str, PinholeCamera]) -> tuple[np.ndarray | None, np.ndarray]:
    """The point (3,) that most of the rays of some marks intersect, and which do (N,) bool.

    No place where that is not a majority, or all that meet come from one direction.
    """
    origins, rays, wrong = _rays(marks, views)
    best = np.zeros(len(marks), dtype=bool)
    least = np.inf
    for pair in combinations(range(min(len(marks), _MOST_TRIED)), 2):
        place = _nearest_to_rays(origins[list(pair)], rays[list(pair)])
        if place is None:
            continue
        off = _angles_to_rays(place, origins, rays) / wrong
        good = off <= 1.0
        total = float(off[good].sum())
        if (good.sum(), -total) > (best.sum(), -least):
            best, least = good, total
    if best.sum() < 2 or 2 * best.sum() <= len(marks):
        return None, best
    place = _nearest_to_rays(origins[best], rays[best])
    opening = np.degrees(np.arccos(np.clip((rays[best] @ rays[best].T).min(), -1.0, 1.0)))
    if place is None or opening < _LEAST_ANGLE_DEG:
        return None, np.ones(len(marks), dtype=bool)
    return place, best


def _rays(marks: list[Mark], views: Mapping[str, PinholeCamera]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Origins and directions (N, 3) of the rays of marks, and the angle (N,) [rad] that makes one wrong."""
    posed = [views[mark.view] for mark in marks]
    rays = np.array([camera.directions(mark.pixel) for camera, mark in zip(posed, marks, strict=True)])
    wrong = np.array([_WRONG_SHARE * max(camera.width, camera.height) / camera.fx for camera in posed])
    return np.array([camera.centre for camera in posed]), rays, wrong


def _nearest_to_rays(origins: np.ndarray, rays: np.ndarray) -> np.ndarray | None:
    """The point (3,) nearest to all rays, by angle; None where they are parallel."""
    normals, rights = equations_of_lines(origins, rays)
    place = None
    weights = np.ones(len(rays))
    # Distances from a ray count by the angle at which its camera sees them.
    for _ in range(3):
        normal = np.sum(normals * weights[:, None, None], axis=0)
        if np.linalg.cond(normal) > 1e12:
            return None
        place = np.linalg.solve(normal, weights @ rights)
        weights = 1.0 / np.maximum(np.sum((place - origins) ** 2, axis=1), 1e-12)
        weights /= weights.max()
    return place


def _angles_to_rays(place: np.ndarray, origins: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Angles (N,) [rad] between the rays and a place; infinite for what lies behind a camera."""
    to = place - origins
    along = np.sum(to * rays, axis=1)
    across = np.linalg.norm(to - along[:, None] * rays, axis=1)
    return np.where(along > 0.0, np.arctan2(across, along), np.inf)
