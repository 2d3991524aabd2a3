"""Lines and polygons in degrees that cross the meridian of 180 degrees, cut there (RFC 7946, section 3.1.9)."""

from __future__ import annotations

import numpy as np

_HALF_TURN, _TURN = 180.0, 360.0


def crosses(lonlat: np.ndarray) -> bool:
    """Whether places (N, 2 or more) [deg] of a survey lie on both sides of the meridian of 180 degrees."""
    longitude = lonlat[np.isfinite(lonlat[:, 0]), 0]
    return len(longitude) > 0 and float(np.ptp(longitude)) > _HALF_TURN


def cut_line(line: np.ndarray) -> list[np.ndarray]:
    """The parts of a line (N, 2) [deg] on both sides, in their order; the line itself where it does not cross."""
    if not crosses(line):
        return [line]
    return [_wrapped(chain, east) for chain, east in _split_line(_unwrapped(line))]


def cut_polygon(rings: list[np.ndarray]) -> list[list[np.ndarray]]:
    """The polygons, each as its closed rings (N, 2) [deg] with the outer one first, of one on both sides."""
    if not any(crosses(ring) for ring in rings) and not crosses(np.concatenate(rings)):
        return [rings]
    whole = [_unwrapped(ring) for ring in rings]
    return [polygon for east in (False, True) for polygon in _polygons_on_side(whole, east)]


def _unwrapped(line: np.ndarray) -> np.ndarray:
    """The line with longitudes from 0 to 360 degrees, without a jump at the meridian."""
    line = np.array(line, dtype=np.float64)
    line[line[:, 0] < 0.0, 0] += _TURN
    return line


def _wrapped(line: np.ndarray, east: bool) -> np.ndarray:
    """The line with longitudes from -180 degrees on where it lies east of the meridian."""
    return line - [_TURN, 0.0] if east else line


def _split_line(line: np.ndarray) -> list[tuple[np.ndarray, bool]]:
    """Pieces of a line that lie on one side each, with their ends on the meridian, and whether that is the eastern."""
    side = line[:, 0] > _HALF_TURN
    pieces, start = [], 0
    head: list[np.ndarray] = []
    for at in np.flatnonzero(side[1:] != side[:-1]) + 1:
        (x0, y0), (x1, y1) = line[at - 1], line[at]
        on_it = np.array([[_HALF_TURN, y0 + (y1 - y0) * (_HALF_TURN - x0) / (x1 - x0)]])
        pieces.append((np.concatenate([*head, line[start:at], on_it]), bool(side[at - 1])))
        head, start = [on_it], int(at)
    pieces.append((np.concatenate([*head, line[start:]]), bool(side[-1])))
    return pieces


def _polygons_on_side(rings: list[np.ndarray], east: bool) -> list[list[np.ndarray]]:
    """The part of a polygon on one side.

    Its border there is pieces of rings, joined along the meridian: of the ends on it, by latitude, the first and the
    second bound a stretch of the inside, the third and fourth the next.
    """
    chains: list[np.ndarray] = []
    holes: list[np.ndarray] = []
    outer: list[np.ndarray] = []
    for number, ring in enumerate(rings):
        pieces = _split_line(ring)
        if len(pieces) == 1:
            if pieces[0][1] == east:
                (holes if number else outer).append(ring)
            continue
        # The first piece goes on where the last one ended: rings are closed.
        joined = np.concatenate([pieces[-1][0], pieces[0][0][1:]])
        chains += [chain for chain, side in [(joined, pieces[0][1]), *pieces[1:-1]] if side == east]
    ends = np.array([[chain[0, 1], chain[-1, 1]] for chain in chains]).reshape(-1)
    order = np.argsort(ends, kind="stable")
    partner = np.empty(len(ends), dtype=np.int64)
    partner[order] = order.reshape(-1, 2)[:, ::-1].reshape(-1)
    left = set(range(len(chains)))
    while left:
        parts, at = [], first = [], min(left)
        end = 0
        while at in left:
            left.remove(at)
            parts.append(chains[at] if end == 0 else chains[at][::-1])
            # From the end of this piece along the meridian to the end that bounds the same stretch.
            at, end = divmod(int(partner[2 * at + 1 - end]), 2)
        outer.append(np.concatenate([*parts, chains[first][:1]]))
    polygons = [[ring] for ring in outer]
    for hole in holes:
        next(p for p in polygons if _contains(p[0], hole[0])).append(hole)
    return [[_wrapped(ring, east) for ring in polygon] for polygon in polygons]


def _contains(ring: np.ndarray, place: np.ndarray) -> bool:
    """Whether a place lies in a closed ring, by crossings of a line to the north."""
    (x0, y0), (x1, y1) = ring[:-1].T, ring[1:].T
    spans = (x0 > place[0]) != (x1 > place[0])
    above = y0[spans] + (y1 - y0)[spans] * (place[0] - x0[spans]) / (x1 - x0)[spans] > place[1]
    return bool(above.sum() % 2)
