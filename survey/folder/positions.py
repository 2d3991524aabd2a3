"""Positions of photographs far from the others: in height, in plan, off the line of flight, or the same twice."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from geo.crs import EARTH_RADIUS_M
from survey.display.quantities import distance_text, named
from survey.photos.exif import Exif

# A position is far from the others beyond this many times their usual spread, and these lengths [m]. If more than this
# share of positions is far, they are another part of the flight.
_FAR, _FAR_HEIGHT_M, _FAR_PLAN_M, _MOST_FAR = 10.0, 10.0, 50.0, 0.1
_FEWEST = 4
# Gap beyond which positions are of another survey [m].
_ELSEWHERE_M = 5000.0
# Off the flight line: by more than the noise of a receiver without corrections [m], and this many times the uncertainty
# of the prediction from two photographs before and two after, or of the spacing of photographs around it.
_OFF_M, _TIMES_OPEN, _TIMES_STEP = 10.0, 5.0, 2.0
_STEPS_BESIDE, _FEWEST_STEPS = 6, 4
# A photograph for which a drone flew off and back takes longer than others, in units of their usual interval and [s].
_LONGER, _CLOCK_STEP_S = 2.0, 1.0
# Receivers give one position per second, and camera clocks have whole seconds.
_BETWEEN_FIXES_S = 2.0


def position_warnings(headers: Mapping[str, Exif]) -> list[str]:
    """Warnings that name the photographs whose GPS position or height lies far from all others."""
    known = {name: header for name, header in headers.items() if header.lat_lon_height is not None}
    if len(known) < _FEWEST:
        return []
    names, places = np.array(list(known)), np.array([header.lat_lon_height for header in known.values()])
    # Longitudes are unwrapped across the antimeridian, relative to the first.
    east_deg = places[:, 1] - places[0, 1]
    plan = EARTH_RADIUS_M * np.radians(np.column_stack([places[:, 0], (east_deg + 180.0) % 360.0 - 180.0]))
    plan[:, 1] *= np.cos(np.radians(np.median(places[:, 0])))
    cameras = np.array([header.serial for header in known.values()])
    clocks = [header.clock for header in known.values() if header.clock is not None]
    seconds = None
    if len(clocks) == len(known):
        seconds = np.array([(clock - clocks[0]).total_seconds() for clock in clocks])
    return far_from_others(names, plan, places[:, 2], "GPS", seconds, cameras)


def far_from_others(
    names: np.ndarray,
    plan: np.ndarray,
    height: np.ndarray,
    by: str,
    seconds: np.ndarray | None = None,
    cameras: np.ndarray | None = None,
) -> list[str]:
    """Warnings that name the photographs whose place (N, 2) or height (N,) [m], NaN where unknown, is far from all.

    ``by`` is their source, "GPS" or "pose". ``seconds`` are the times of exposure; without these the order is taken as
    that of the flight. ``cameras`` (N,) distinguishes several aircraft.
    """
    if len(names) < _FEWEST:
        return []
    main = _largest_group(plan)
    warnings = named(names[~main].tolist(), "image", f"kilometres away from the others by {by}: of another survey?")
    nearest = KDTree(plan).query(plan, k=2)[0][:, 1]
    alone = main & (nearest > max(_FAR * float(np.median(nearest)), _FAR_PLAN_M))
    warnings += named(_few(names, alone), "image", f"far from all others by its {by} position")
    off = np.zeros(len(names))
    for camera in [np.s_[:]] if cameras is None else [cameras == each for each in np.unique(cameras)]:
        off[camera] = _off_the_line(plan[camera], None if seconds is None else seconds[camera])
    labels = np.array([f"{name} (by {distance_text(of_it)})" for name, of_it in zip(names, off, strict=True)])
    warnings += named(
        _few(labels, main & ~alone & (off > 0.0)),
        "image",
        f"off the line of flight by its {by} position, between those before and after it",
    )
    if by == "GPS":
        # Poses that also share their rotation are reported where poses are read.
        warnings += _repeated_positions(names, np.column_stack([plan, height]), seconds)
    with_height = np.isfinite(height)
    return warnings + _far_in_height(names[with_height], height[with_height], by)


def _far_in_height(names: np.ndarray, heights: np.ndarray, by: str) -> list[str]:
    """Warnings that name the photographs whose height (N,) [m] is far from the others."""
    if len(heights) < _FEWEST:
        return []
    deviation = np.abs(heights - np.median(heights))
    far = deviation > max(_FAR * float(np.median(deviation)), _FAR_HEIGHT_M)
    # Exactly 0 is what receivers write without a height: no other flight, however many have it.
    no_height = far & (heights == 0.0)
    low, high = heights[~far].min(), heights[~far].max()
    labels = np.array([f"{name} ({of_it:.1f} m)" for name, of_it in zip(names, heights, strict=True)])
    return named(
        labels[no_height].tolist() + _few(labels, far & ~no_height),
        "image",
        f"far from the others by its {by} height, which are at {low:.1f} to {high:.1f} m",
    )


def _repeated_positions(names: np.ndarray, places: np.ndarray, seconds: np.ndarray | None) -> list[str]:
    """Warnings about photographs (N,) that share a position (N, 3) to the last digit.

    Except those taken at once, or between two fixes of the receiver: bands, brackets, rigs and bursts.
    """
    alike = defaultdict(list)
    for number, place in enumerate(places):
        alike[place.tobytes()].append(number)
    if len(alike) == 1:
        return [f"all {len(names)} images have the same GPS position to the last digit: it tells nothing of them"]
    repeated = [
        number
        for group in alike.values()
        for number in group[1:]
        if seconds is None or abs(seconds[number] - seconds[group[0]]) > _BETWEEN_FIXES_S
    ]
    return named(names[repeated].tolist(), "image", "with the GPS position of an earlier one to the last digit")


def _off_the_line(plan: np.ndarray, seconds: np.ndarray | None) -> np.ndarray:
    """Distances (N,) [m] of places (N, 2) from the flight line before and after; 0 for those that are not far.

    On a straight part, the two places before and the two after both predict a place. Elsewhere a place is off if it is
    farther than usual steps from the line between its neighbours, and these are no farther apart than others: at a
    turn, no place is farther from that line than the shorter of its two steps.
    """
    num = len(plan)
    off = np.zeros(num)
    if num < _FEWEST + 1:
        return off
    order = np.arange(num) if seconds is None else np.argsort(seconds, kind="stable")
    at = plan[order]
    found = np.zeros(num)
    found[1:-1] = _from_neighbours(at)
    guesses = np.stack([2.0 * at[1:-3] - at[:-4], 2.0 * at[3:-1] - at[4:], (at[1:-3] + at[3:-1]) / 2.0])
    middle = guesses.mean(axis=0)
    open_m = np.linalg.norm(guesses - middle, axis=2).max(axis=0)
    deviation = np.linalg.norm(at[2:-2] - middle, axis=1)
    found[2:-2] = np.maximum(
        found[2:-2], np.where(deviation > np.maximum(_OFF_M, _TIMES_OPEN * open_m), deviation, 0.0)
    )
    if seconds is not None:
        taken = np.diff(seconds[order])
        longest = _LONGER * float(np.median(taken)) + _CLOCK_STEP_S
        found[1:-1][(taken[:-1] > longest) | (taken[1:] > longest)] = 0.0
    # Neighbours of a wrong place seem off too, but by less.
    around = sliding_window_view(np.pad(found, 2), 5).max(axis=1)
    off[order] = np.where(found >= around, found, 0.0)
    return off


def _from_neighbours(at: np.ndarray) -> np.ndarray:
    """Distance (N - 2,) [m] of each place from the line between its neighbours where it is far; 0 elsewhere."""
    before, place, behind = at[:-2], at[1:-1], at[2:]
    along = behind - before
    length = np.linalg.norm(along, axis=1)
    share = np.einsum("ni,ni->n", place - before, along) / np.maximum(length**2, np.finfo(float).tiny)
    deviation = np.linalg.norm(place - before - np.clip(share, 0.0, 1.0)[:, None] * along, axis=1)
    step = np.linalg.norm(np.diff(at, axis=0), axis=1)
    steps_around = sliding_window_view(np.pad(step, _STEPS_BESIDE, constant_values=np.nan), 2 * _STEPS_BESIDE + 2)[
        :, [*range(_STEPS_BESIDE), *range(_STEPS_BESIDE + 2, 2 * _STEPS_BESIDE + 2)]
    ]
    enough = np.isfinite(steps_around).sum(axis=1) >= _FEWEST_STEPS
    steps_around = np.where(enough[:, None], steps_around, 0.0)
    # Around the place, and in all of the flight.
    usual, most = np.nanquantile(steps_around, 0.75, axis=1), 1.1 * np.nanmax(steps_around, axis=1)
    far_around = (deviation > np.maximum(_OFF_M, _TIMES_STEP * usual)) & (
        length < np.maximum(_TIMES_STEP * usual, most)
    )
    usual, most = np.quantile(step, [0.75, 0.9])
    all_far = (deviation > max(_OFF_M, _TIMES_STEP * usual)) & (length < _TIMES_STEP * most)
    return np.where((far_around & enough) | all_far, deviation, 0.0)


def _largest_group(plan: np.ndarray) -> np.ndarray:
    """Mask (N,) bool of the places (N, 2) [m] of the largest group. Groups are at least `_ELSEWHERE_M` apart."""
    squares, square = np.unique(np.floor(plan / _ELSEWHERE_M), axis=0, return_inverse=True)
    adjacent = np.array(list(KDTree(squares).query_pairs(1.0, p=np.inf))).reshape(-1, 2)
    linked = coo_array((np.ones(len(adjacent)), tuple(adjacent.T)), shape=(len(squares), len(squares)))
    group = connected_components(linked, directed=False)[1][square.ravel()]
    return group == np.bincount(group).argmax()


def _few(names: np.ndarray, far: np.ndarray) -> list[str]:
    """Names of the far photographs, where these are few enough to be wrong."""
    return names[far].tolist() if far.sum() <= max(1, int(_MOST_FAR * len(names))) else []
