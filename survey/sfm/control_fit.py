"""Absolute orientation of a block by control points alone: the similarity that most of them agree on.

The rays of the photographs are straight here and the water is not: a block is bent by a per cent of its range, and
points under water seem to lie higher. So only gross errors count; the adjustment finds the small ones.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from math import comb

import numpy as np

from geo.frames import Similarity, fit_similarity, robust_similarity
from refract import PinholeCamera
from survey.control.points import ControlPoint
from survey.display.quantities import listed
from survey.errors import ControlError
from survey.sfm.gps_fit import PositionLine
from survey.sfm.mark_rays import BlockControl, Intersections, intersect_marks, swapped_marks

MIN_POINTS = 3
# A block may miss its control by this share of the distance to the cameras, and this many standard deviations of it.
_BENT_SHARE, _MOST_STD = 0.02, 3.0
# Of more sets of three points, so many are drawn.
_MOST_TRIPLES = 600
# Points closer to one line than this share of its length, or so many standard deviations of their mean, leave the tilt
# open.
_LINE_SHARE, _LINE_STD = 0.05, 3.0


@dataclass(frozen=True)
class ControlFit:
    """Placement of a block by its control."""

    similarity: Similarity  # From the frame of the block to that of the control
    intersections: Intersections
    # dict of name to float [m]: points that the others contradict, and how far they lie from where the photographs show
    # them
    wrong: dict[str, float]
    line: PositionLine | None = None  # That they lie on, which leaves the roll of the block about it open

    @property
    def used(self) -> tuple[str, ...]:
        """Names of the points that agree."""
        return tuple(point.name for point in self.intersections.points if point.name not in self.wrong)


def fit_control(control: BlockControl, views: Mapping[str, PinholeCamera]) -> ControlFit:
    """Place a block by its control points.

    Parameters
    ----------
    views : name to PinholeCamera, in the frame of the block
    """
    intersections = intersect_marks(control, views)
    require_consistent_marks(control, views, intersections)
    if len(intersections.points) < MIN_POINTS:
        raise ControlError(_too_few(control, views, intersections))
    control_xyz, std = coordinates(intersections)
    if _line(control_xyz, std) is not None:
        return _along_line(intersections)
    fit = fit_majority(intersections, views)
    good = np.array([point.name not in fit.wrong for point in intersections.points])
    return replace(fit, line=_line(control_xyz[good], std[good]))


def _line(places: np.ndarray, std: np.ndarray) -> PositionLine | None:
    """The line that control points (K, 3) [m] lie on, given how good they are (K, 3) [m]."""
    along, across, least = spread_of(places, std)
    if across >= least:
        return None
    centre = places.mean(axis=0)
    direction = np.linalg.svd(places - centre, full_matrices=False)[2][0]
    return PositionLine(centre, direction, along, across, float(np.median(std)), "control points")


def _along_line(intersections: Intersections) -> ControlFit:
    """A similarity to points on a line, with any roll about it."""
    control_xyz, std = coordinates(intersections)
    similarity, _ = robust_similarity(intersections.places, control_xyz)
    off = similarity(intersections.places) - control_xyz
    good = (np.abs(off) <= _limits(intersections, std, similarity.scale)).all(axis=1)
    if good.sum() < MIN_POINTS or 2 * good.sum() <= len(good):
        raise ControlError(_contradiction(intersections, control_xyz, std))
    wrong = {intersections.points[i].name: float(np.linalg.norm(off[i])) for i in np.flatnonzero(~good)}
    similarity = fit_similarity(intersections.places[good], control_xyz[good])
    return ControlFit(similarity, intersections, wrong, _line(control_xyz[good], std[good]))


def coordinates(intersections: Intersections) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates of control points (K, 3) [m], local, and their standard deviations."""
    points = intersections.points
    return np.array([point.local for point in points]), np.array([point.std for point in points])


def fit_majority(intersections: Intersections, views: Mapping[str, PinholeCamera]) -> ControlFit:
    """The similarity that most of at least three points agree on."""
    control_xyz, std = coordinates(intersections)
    best = _agreements(intersections, control_xyz, std)
    if not best:
        raise ControlError(_contradiction(intersections, control_xyz, std))
    # Three points fit by chance alone where heights are wrong; four do not.
    if len(best) > 1 and best[0].sum() == MIN_POINTS:
        names = ", ".join(point.name for point in intersections.points)
        raise ControlError(
            f"the {len(intersections.points)} control points {names} contradict each other, and fit the photographs "
            f"equally well without {' or without '.join(_left_of(intersections, good) for good in best[:4])}: correct "
            "the coordinates or the marks of the wrong one, or add points"
        )
    good = best[0]
    similarity = fit_similarity(intersections.places[good], control_xyz[good])
    if _is_below(similarity, intersections, good, views):
        raise ControlError("control points put the cameras under the ground; swap easting and northing in their file")
    off = np.linalg.norm(similarity(intersections.places) - control_xyz, axis=1)
    wrong = {intersections.points[i].name: float(off[i]) for i in np.flatnonzero(~good)}
    return ControlFit(similarity, intersections, wrong)


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


def _agreements(intersections: Intersections, control_xyz: np.ndarray, std: np.ndarray) -> list[np.ndarray]:
    """The largest sets (K,) bool of points that one similarity fits, the best first; none that are not a majority."""
    found: dict[bytes, tuple[int, float, np.ndarray]] = {}
    for triple in _triples(len(control_xyz)):
        start = np.zeros(len(control_xyz), dtype=bool)
        start[list(triple)] = True
        good, cost = _consistent_points(intersections, control_xyz, std, start)
        if good.sum() >= MIN_POINTS and 2 * good.sum() > len(control_xyz):
            found[good.tobytes()] = (int(good.sum()), cost, good)
    if not found:
        return []
    most = max(count for count, _, _ in found.values())
    return [good for count, _, good in sorted(found.values(), key=lambda each: each[1]) if count == most]


def _triples(num: int) -> Iterator[tuple[int, ...]]:
    if comb(num, MIN_POINTS) <= _MOST_TRIPLES:
        yield from combinations(range(num), MIN_POINTS)
        return
    rng = np.random.default_rng(0)
    for _ in range(_MOST_TRIPLES):
        yield tuple(rng.choice(num, MIN_POINTS, replace=False))


def _consistent_points(
    intersections: Intersections, control_xyz: np.ndarray, std: np.ndarray, start: np.ndarray
) -> tuple[np.ndarray, float]:
    """Points (K,) bool within tolerance of the similarity fitted to them, from some to start with, and their cost."""
    good, cost = start, np.inf
    for _ in range(10):
        if good.sum() < MIN_POINTS or _is_line(intersections.places[good]):
            return np.zeros_like(start), np.inf
        similarity = fit_similarity(intersections.places[good], control_xyz[good])
        share = np.abs(similarity(intersections.places) - control_xyz) / _limits(intersections, std, similarity.scale)
        before, good = good, share.max(axis=1) <= 1.0
        cost = float(np.sum(share[good] ** 2))
        if (good == before).all():
            break
    return good, cost


def _is_line(places: np.ndarray) -> bool:
    lengths = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)
    return bool(lengths[1] < _LINE_SHARE * lengths[0])


def _limits(intersections: Intersections, std: np.ndarray, scale: float) -> np.ndarray:
    """Tolerances (K, 3) [m] of a block at its points: it is bent, the more the wider it is for its range."""
    wide = np.mean(np.sum((intersections.places - intersections.places.mean(axis=0)) ** 2, axis=1))
    bent = _BENT_SHARE * scale * (intersections.ranges + wide / intersections.ranges)
    return _MOST_STD * std + (bent + intersections.slack)[:, None]


def _is_below(
    similarity: Similarity, intersections: Intersections, good: np.ndarray, views: Mapping[str, PinholeCamera]
) -> bool:
    """Whether most cameras lie lower than the points that they show."""
    heights = similarity(np.array([view.centre for view in views.values()]))[:, 2]
    return bool(np.median(heights) < np.median(similarity(intersections.places[good])[:, 2]))


def _too_few(control: BlockControl, views: Mapping[str, PinholeCamera], intersections: Intersections) -> str:
    causes = []
    if intersections.points:
        causes.append(f"usable: {listed([point.name for point in intersections.points])}")
    if intersections.single:
        causes.append(f"with fewer than two marks, or from one direction: {listed(intersections.single)}")
    if intersections.inconsistent:
        causes.append(f"with marks whose rays do not intersect: {listed(intersections.inconsistent)}")
    causes.append(f"{len(views)} photographs are placed")
    remedy = "mark more points in more photographs, or correct the marks"
    if len(intersections.inconsistent) > 1 and len(intersect_marks(swapped_marks(control), views).points) >= MIN_POINTS:
        remedy = "their rays meet with x and y of the marks swapped: swap the two columns"
    return (
        f"{len(intersections.points)} of {len(control.points)} control points fit the photographs, expected at least "
        f"{MIN_POINTS} not on a line, each marked in two photographs or more ({'; '.join(causes)}); {remedy}"
    )


def _contradiction(intersections: Intersections, control_xyz: np.ndarray, std: np.ndarray) -> str:
    """Reason why no similarity fits most of the points."""
    if _agreements(intersections, control_xyz[:, [1, 0, 2]], std):
        return "control points fit with easting and northing (or longitude and latitude) swapped; swap these columns"
    similarity = fit_similarity(intersections.places, control_xyz)
    off = similarity(intersections.places) - control_xyz
    rms = float(np.sqrt(np.mean(np.sum(off**2, axis=1))))
    worst = int(np.argmax(np.linalg.norm(off, axis=1)))
    limit = float(np.median(_limits(intersections, std, similarity.scale)[:, 0]))
    return (
        f"{len(intersections.points)} control points do not fit the photographs: the misfit is {rms:.2g} m (root mean "
        f"square, largest at {intersections.points[worst].name}), and no more than half of them agree to {limit:.2g} "
        "m; check their names, coordinates, CRS and marks, or say in [control] std_m how inaccurate they are"
    )


def _left_of(intersections: Intersections, good: np.ndarray) -> str:
    return listed([intersections.points[i].name for i in np.flatnonzero(~good)])
