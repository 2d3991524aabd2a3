"""Absolute orientation of a block by control points alone: the similarity that most of them agree on.

The rays of the marks of a point intersect at its place in the block. They are straight here and the water is not: a
block is bent by a per cent of its range, and points under water seem to lie higher. So only gross errors count; the
adjustment finds the small ones.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from math import comb

import numpy as np

from geo.frames import LocalFrame, Similarity, fit_similarity, robust_similarity
from refract import PinholeCamera
from survey.control.points import ControlPoint, Mark
from survey.display.quantities import listed
from survey.errors import ControlError
from survey.photos.cameras import equations_of_lines
from survey.sfm.gps_fit import PositionLine

MIN_POINTS = 3
# A block may miss its control by this share of the distance to the cameras, and this many standard deviations of it.
_BENT_SHARE, _MOST_STD = 0.02, 3.0
# Of more sets of three points, so many are drawn.
_MOST_TRIPLES = 600
# Points closer to one line than this share of its length, or so many standard deviations of their mean, leave the tilt
# open.
_LINE_SHARE, _LINE_STD = 0.05, 3.0
# A ray further from its point belongs to another one, as a share of the longer side; bent rays, lenses and hands are
# off by far less.
_WRONG_SHARE = 0.01
# Rays that open by less leave the distance of their point to the lens.
_LEAST_ANGLE_DEG = 1.5
# Of a point with more marks, pairs of these alone are tried.
_MOST_TRIED = 30


@dataclass(frozen=True, eq=False)
class BlockControl:
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

    @property
    def local(self) -> np.ndarray:
        """Coordinates (K, 3) [m] of the points."""
        return np.array([point.local for point in self.points])

    @property
    def std(self) -> np.ndarray:
        """Standard deviations (K, 3) [m] of the coordinates."""
        return np.array([point.std for point in self.points])

    def names(self, chosen: np.ndarray) -> list[str]:
        """Names of points (K,) bool."""
        return [point.name for point, is_chosen in zip(self.points, chosen, strict=True) if is_chosen]

    def limits(self, scale: float) -> np.ndarray:
        """Tolerances (K, 3) [m] of a block at its points: it is bent, the more the wider it is for its range."""
        wide = np.mean(np.sum((self.places - self.places.mean(axis=0)) ** 2, axis=1))
        bent = _BENT_SHARE * scale * (self.ranges + wide / self.ranges)
        return _MOST_STD * self.std + (bent + self.slack)[:, None]


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
        place, good = _majority_point(marks, views) if len(marks) > 1 else (None, np.ones(len(marks), dtype=bool))
        if place is None:
            (single if good.all() else inconsistent).append(point.name)
            continue
        points.append(point)
        places.append(place)
        ranges.append(min(np.linalg.norm(views[mark.view].centre - place) for mark in marks))
        slack.append(own_slack)
        wrong += [mark for mark, is_good in zip(marks, good, strict=True) if not is_good]
    return Intersections(
        tuple(points), np.array(places).reshape(-1, 3), np.array(ranges), np.array(slack),
        tuple(wrong), tuple(inconsistent), tuple(single),
    )  # fmt: skip


def _majority_point(marks: list[Mark], views: Mapping[str, PinholeCamera]) -> tuple[np.ndarray | None, np.ndarray]:
    """The point (3,) that most rays of some marks intersect, if from two directions, and which rays do (N,) bool."""
    cameras = [views[mark.view] for mark in marks]
    origins = np.array([camera.centre for camera in cameras])
    rays = np.array([camera.directions(mark.pixel) for camera, mark in zip(cameras, marks, strict=True)])
    wrong = np.array([_WRONG_SHARE * max(camera.width, camera.height) / camera.fx for camera in cameras])
    best, least = np.zeros(len(marks), dtype=bool), np.inf
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


def _nearest_to_rays(origins: np.ndarray, rays: np.ndarray) -> np.ndarray | None:
    """The point (3,) nearest to all rays, by angle; None where they are parallel."""
    normals, rights = equations_of_lines(origins, rays)
    place, weights = None, np.ones(len(rays))
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


@dataclass(frozen=True)
class ControlFit:
    """Placement of a block by its control."""

    similarity: Similarity  # From the frame of the block to that of the control
    intersections: Intersections
    # By name [m]: points that the others contradict, and how far they lie from where the photographs show them
    wrong: dict[str, float]
    line: PositionLine | None = None  # That they lie on, which leaves the roll of the block about it open

    @property
    def used(self) -> tuple[str, ...]:
        """Names of the points that agree."""
        return tuple(point.name for point in self.intersections.points if point.name not in self.wrong)


def fit_control(control: BlockControl, views: Mapping[str, PinholeCamera]) -> ControlFit:
    """Place a block by its control points; ``views`` by name, in the frame of the block."""
    intersections = intersect_marks(control, views)
    require_consistent_marks(control, views, intersections)
    if len(intersections.points) < MIN_POINTS:
        raise ControlError(_too_few(control, views, intersections))
    if _line(intersections.local, intersections.std) is not None:
        similarity, _ = robust_similarity(intersections.places, intersections.local)
        off = np.abs(similarity(intersections.places) - intersections.local)
        good = (off <= intersections.limits(similarity.scale)).all(axis=1)
        if good.sum() < MIN_POINTS or 2 * good.sum() <= len(good):
            raise ControlError(_contradiction(intersections))
        fit = _fit_to(intersections, good)
    else:
        fit = fit_majority(intersections, views)
    good = np.array([point.name not in fit.wrong for point in intersections.points])
    return replace(fit, line=_line(intersections.local[good], intersections.std[good]))


def _fit_to(intersections: Intersections, good: np.ndarray) -> ControlFit:
    similarity = fit_similarity(intersections.places[good], intersections.local[good])
    off = np.linalg.norm(similarity(intersections.places) - intersections.local, axis=1)
    wrong = dict(zip(intersections.names(~good), off[~good].tolist(), strict=True))
    return ControlFit(similarity, intersections, wrong)


def fit_majority(intersections: Intersections, views: Mapping[str, PinholeCamera]) -> ControlFit:
    """The similarity that most of at least three points agree on."""
    best = _agreements(intersections, intersections.local)
    if not best:
        raise ControlError(_contradiction(intersections))
    # Three points fit by chance alone where heights are wrong; four do not.
    if len(best) > 1 and best[0].sum() == MIN_POINTS:
        names = ", ".join(point.name for point in intersections.points)
        left = " or without ".join(listed(intersections.names(~good)) for good in best[:4])
        raise ControlError(
            f"the {len(intersections.points)} control points {names} contradict each other, and fit the photographs "
            f"equally well without {left}: correct the coordinates or the marks of the wrong one, or add points"
        )
    fit = _fit_to(intersections, best[0])
    cameras = fit.similarity(np.array([view.centre for view in views.values()]))
    if np.median(cameras[:, 2]) < np.median(fit.similarity(intersections.places[best[0]])[:, 2]):
        raise ControlError("control points put the cameras under the ground; swap easting and northing in their file")
    return fit


def require_consistent_marks(
    control: BlockControl, views: Mapping[str, PinholeCamera], intersections: Intersections
) -> None:
    """Raise where marks that contradict each other outnumber those that agree, by their points."""
    if len(intersections.inconsistent) > len(intersections.points):
        raise ControlError(_too_few(control, views, intersections))


def spread_of(places: np.ndarray, std: np.ndarray) -> tuple[float, float, float]:
    """Extent [m] of control points (K, 3) along their line and across, and the least one across that fixes the tilt."""
    along, across, _ = np.linalg.svd(places - places.mean(axis=0), compute_uv=False) / np.sqrt(len(places))
    least = max(_LINE_SHARE * along, _LINE_STD * float(np.median(std[:, :2])) / np.sqrt(len(places)))
    return float(along), float(across), float(least)


def line_of_control(points: Sequence[ControlPoint]) -> PositionLine | None:
    """The line that control points lie on, given how good they are; None where they span an area."""
    return _line(np.array([point.local for point in points]), np.array([point.std for point in points]))


def _line(places: np.ndarray, std: np.ndarray) -> PositionLine | None:
    along, across, least = spread_of(places, std)
    if across >= least:
        return None
    centre = places.mean(axis=0)
    direction = np.linalg.svd(places - centre, full_matrices=False)[2][0]
    return PositionLine(centre, direction, along, across, float(np.median(std)), "control points")


def _agreements(intersections: Intersections, control_xyz: np.ndarray) -> list[np.ndarray]:
    """The largest sets (K,) bool of points that one similarity fits, the best first; none that are not a majority."""
    sets: dict[bytes, tuple[float, np.ndarray]] = {}
    for triple in _triples(len(control_xyz)):
        start = np.isin(np.arange(len(control_xyz)), triple)
        good, cost = _consistent_points(intersections, control_xyz, start)
        if good.sum() >= MIN_POINTS and 2 * good.sum() > len(control_xyz):
            sets[good.tobytes()] = cost, good
    most = max((good.sum() for _, good in sets.values()), default=0)
    return [good for _, good in sorted(sets.values(), key=lambda found: found[0]) if good.sum() == most]


def _triples(num: int) -> Iterator[tuple[int, ...]]:
    if comb(num, MIN_POINTS) <= _MOST_TRIPLES:
        yield from combinations(range(num), MIN_POINTS)
        return
    rng = np.random.default_rng(0)
    for _ in range(_MOST_TRIPLES):
        yield tuple(rng.choice(num, MIN_POINTS, replace=False))


def _consistent_points(
    intersections: Intersections, control_xyz: np.ndarray, start: np.ndarray
) -> tuple[np.ndarray, float]:
    """Points (K,) bool within tolerance of the similarity fitted to them, from some to start with, and their cost."""
    good, cost, places = start, np.inf, intersections.places
    for _ in range(10):
        if good.sum() < MIN_POINTS or _is_line(places[good]):
            return np.zeros_like(start), np.inf
        similarity = fit_similarity(places[good], control_xyz[good])
        share = np.abs(similarity(places) - control_xyz) / intersections.limits(similarity.scale)
        before, good = good, share.max(axis=1) <= 1.0
        cost = float(np.sum(share[good] ** 2))
        if (good == before).all():
            break
    return good, cost


def _is_line(places: np.ndarray) -> bool:
    lengths = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)
    return bool(lengths[1] < _LINE_SHARE * lengths[0])


def _too_few(control: BlockControl, views: Mapping[str, PinholeCamera], intersections: Intersections) -> str:
    usable = [point.name for point in intersections.points]
    parts = {
        "usable": usable,
        "with fewer than two marks, or from one direction": intersections.single,
        "with marks whose rays do not intersect": intersections.inconsistent,
    }
    causes = [f"{what}: {listed(names)}" for what, names in parts.items() if names]
    remedy = "mark more points in more photographs, or correct the marks"
    swapped = replace(control, marks=tuple(replace(mark, pixel=mark.pixel[::-1]) for mark in control.marks))
    if len(intersections.inconsistent) > 1 and len(intersect_marks(swapped, views).points) >= MIN_POINTS:
        remedy = "their rays meet with x and y of the marks swapped: swap the two columns"
    return (
        f"{len(usable)} of {len(control.points)} control points fit the photographs, expected at least {MIN_POINTS} "
        "not on a line, each marked in two photographs or more "
        f"({'; '.join([*causes, f'{len(views)} photographs are placed'])}); {remedy}"
    )


def _contradiction(intersections: Intersections) -> str:
    """Reason why no similarity fits most of the points."""
    if _agreements(intersections, intersections.local[:, [1, 0, 2]]):
        return "control points fit with easting and northing (or longitude and latitude) swapped; swap these columns"
    similarity = fit_similarity(intersections.places, intersections.local)
    off = np.linalg.norm(similarity(intersections.places) - intersections.local, axis=1)
    limit = float(np.median(intersections.limits(similarity.scale)[:, 0]))
    return (
        f"{len(off)} control points do not fit the photographs: the misfit is {np.sqrt(np.mean(off**2)):.2g} m (root "
        f"mean square, largest at {intersections.points[int(np.argmax(off))].name}), and no more than half of them "
        f"agree to {limit:.2g} m; check their names, coordinates, CRS and marks, or say in [control] std_m how "
        "inaccurate they are"
    )
