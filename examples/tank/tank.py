"""Refractive index or thickness of a pane from a board photographed in an empty and in a filled tank.

    python examples/tank/tank.py corners.csv --size 4000 3000 --distance 0.6
    python examples/tank/tank.py corners.csv --size 4000 3000 --distance 0.312 --distance-std 0.0005 --pane 0.012 \
        --index 1.3330 --unknown pane

The camera stands still, over the tank or before its pane. The table has a row for each corner of the board that a
photograph shows, with the columns

    place       name of the place where the board stood; the same in both media where it was not moved
    medium      air (the tank is empty) or water
    x_m, y_m    where the corner is on the board [m]
    u_px, v_px  where it is in the photograph, the centre of the first pixel at 0.5, 0.5

The board is photographed in three places or more, tilted in different ways, and best in the same places in both
media: fill the tank and leave the board where it is. The thickness of a pane can be separated from its distance only
where the distance is measured (--distance-std). Lens, plane of the water (or pane), poses of the board and the unknown
optics are estimated together by least squares, with rays bent at each interface. Prints each with its standard
deviation, and for each photograph the root mean square of its residuals.
"""

import argparse
import csv
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

COLUMNS = ("place", "medium", "x_m", "y_m", "u_px", "v_px")
# Of the plane of the water or pane: two slopes against the optical axis, and the distance along it.
DISTANCE, INDEX, PANE = "distance_m", "index", "pane_m"
LENS, PLANE, BOARD = ("f", "cx", "cy", "k1", "k2"), ("slope_x", "slope_y", DISTANCE), 6
# Fewest places of the board in air that determine a lens, and fewest corners that determine a place.
FEWEST_PLACES, FEWEST_CORNERS = 3, 4
WATER, GLASS = 1.333, 1.52
# Newton's steps to a ray through parallel interfaces: 12 reach the last bits for a pane of any thickness.
STEPS = 16


@dataclass(frozen=True)
class Corners:
    """Corners of the board in all photographs; N of them.

    Attributes
    ----------
    places : tuple of str
    place : (N,) int
        Number of the place.
    wet : (N,) bool
        Whether the tank was filled.
    board : (N, 2) [m]
    pixel : (N, 2) [px]
    """

    places: tuple[str, ...]
    place: np.ndarray
    wet: np.ndarray
    board: np.ndarray
    pixel: np.ndarray


@dataclass(frozen=True)
class Optics:
    """Prior knowledge of the optics: value and standard deviation, infinite where it is unknown.

    Attributes
    ----------
    size : (width, height) [px]
    distance_m, index, pane_m : (value, standard deviation)
        From the camera to the water or pane along the optical axis; refractive index of the water; thickness of the
        pane, (0, 0) where the camera looks on open water.
    glass : refractive index of the pane
    """

    size: tuple[int, int]
    distance_m: tuple[float, float]
    index: tuple[float, float] = (WATER, np.inf)
    pane_m: tuple[float, float] = (0.0, 0.0)
    glass: float = GLASS


@dataclass(frozen=True)
class Found:
    """Estimates: names (P,), values (P,), covariance (P, P), residuals (N, 2) [px], standard deviation of a pixel."""

    names: tuple[str, ...]
    values: np.ndarray
    covariance: np.ndarray
    residuals: np.ndarray
    std_px: float

    def __getitem__(self, name: str) -> tuple[float, float]:
        """Value and standard deviation of a parameter."""
        number = self.names.index(name)
        return float(self.values[number]), float(np.sqrt(self.covariance[number, number]))


def read_corners(path: Path) -> Corners:
    """The table of corners.

    Raises
    ------
    SystemExit
        If it has other columns, a value that is not a number, another medium, or too few corners.
    """
    with path.open(newline="", encoding="utf-8-sig") as stream:
        rows = list(csv.DictReader(stream))
    missing = [name for name in COLUMNS if not rows or name not in rows[0]]
    if missing:
        raise SystemExit(f"{path} has no column {', '.join(missing)}; expected {', '.join(COLUMNS)}")
    try:
        numbers = np.array([[float(row[name]) for name in COLUMNS[2:]] for row in rows])
    except (TypeError, ValueError) as error:
        raise SystemExit(f"{path}: {error}; expected numbers in {', '.join(COLUMNS[2:])}") from None
    media = sorted({row["medium"] for row in rows})
    if media != ["air", "water"]:
        raise SystemExit(f"{path} has the media {', '.join(media)}; expected photographs in air and in water")
    places = tuple(dict.fromkeys(row["place"] for row in rows))
    place = np.array([places.index(row["place"]) for row in rows])
    wet = np.array([row["medium"] == "water" for row in rows])
    in_air = {int(each) for each in place[~wet]}
    if len(in_air) < FEWEST_PLACES:
        raise SystemExit(
            f"{path} has {len(in_air)} places of the board in air, expected at least {FEWEST_PLACES}, tilted in "
            "different ways: they determine the lens"
        )
    for number, name in enumerate(places):
        for medium in (False, True):
            count = int(np.sum((place == number) & (wet == medium)))
            if 0 < count < FEWEST_CORNERS:
                where = "water" if medium else "air"
                raise SystemExit(f"{path}: {name} has {count} corners in {where}, expected at least {FEWEST_CORNERS}")
    return Corners(places, place, wet, numbers[:, :2], numbers[:, 2:])


def estimate(corners: Corners, optics: Optics) -> Found:
    """Least squares over all corners.

    The board gives the scale. Known optics are priors with their standard deviations; that of an image coordinate is
    estimated from the residuals.
    """
    start, names = _start(corners, optics), _names(corners)
    given = {DISTANCE: optics.distance_m, INDEX: optics.index, PANE: optics.pane_m}
    held = np.array([name in given and given[name][1] == 0.0 for name in names])
    priors = [(names.index(name), *each) for name, each in given.items() if 0.0 < each[1] < np.inf]
    std_px = 1.0

    def values(free: np.ndarray) -> np.ndarray:
        whole = start.copy()
        whole[~held] = free
        return whole

    def misfit(free: np.ndarray) -> np.ndarray:
        whole = values(free)
        off = (project(whole, corners, optics) - corners.pixel).ravel() / std_px
        known = [(whole[number] - value) / std for number, value, std in priors]
        return np.concatenate([off, known])

    # A pane has a thickness, and no medium an index below that of air.
    lowest = np.array([{INDEX: 1.0, PANE: 0.0}.get(name, -np.inf) for name in names])[~held]
    free = start[~held]
    # With priors a second time, weighted by the standard deviation of an image coordinate from the first.
    for _ in range(2 if priors else 1):
        found = least_squares(misfit, free, x_scale="jac", bounds=(lowest, np.inf))
        free, residuals = found.x, project(values(found.x), corners, optics) - corners.pixel
        scale, std_px = std_px, float(np.sqrt(np.sum(residuals**2) / (residuals.size + len(priors) - len(free))))
    jacobian = found.jac
    jacobian[: residuals.size] *= scale / std_px
    covariance = np.zeros((len(start), len(start)))
    covariance[np.ix_(~held, ~held)] = np.linalg.inv(jacobian.T @ jacobian)
    return Found(names, values(free), covariance, residuals, std_px)


def project(values: np.ndarray, corners: Corners, optics: Optics) -> np.ndarray:
    """Where the corners appear (N, 2) [px], for the values of all parameters."""
    count = len(LENS) + len(PLANE)
    f, cx, cy, k1, k2, slope_x, slope_y, distance, index, pane = values[: count + 2]
    places = values[count + 2 :].reshape(-1, BOARD)
    turned = Rotation.from_rotvec(places[:, :3])[corners.place]
    on_board = np.column_stack([corners.board, np.zeros(len(corners.board))])
    points = turned.apply(on_board) + places[corners.place, 3:]
    rays = np.empty_like(points)
    for medium, n in ((False, 1.0), (True, index)):
        mine = corners.wet == medium
        layers = ((1.0, optics.glass, n), (pane,)) if optics.pane_m[0] > 0.0 else ((1.0, n), ())
        rays[mine] = seen_through(points[mine], distance, np.array([slope_x, slope_y, -1.0]), *layers)
    x, y = rays[:, 0] / rays[:, 2], rays[:, 1] / rays[:, 2]
    square = x * x + y * y
    radial = f * (1.0 + square * (k1 + square * k2))
    # Where no ray reaches a corner, a residual that turns the estimation away.
    return np.nan_to_num(np.column_stack([cx + radial * x, cy + radial * y]), nan=1e6)


def seen_through(points: np.ndarray, distance: float, normal: np.ndarray, indices, thicknesses) -> np.ndarray:
    """Directions (N, 3) in which the camera, at the origin, sees points (N, 3) [m] behind parallel interfaces.

    ``n_i sin(theta_i)`` is the same in all media (Snell). With v the tangent to the normal, over the distance D along
    the interfaces, in the medium of least index n, and ``m_i = n_i / n``, the way covered is
    ``sum_i h_i v / sqrt(m_i^2 + (m_i^2 - 1) D^2 v^2) = 1``: it rises and is concave, so that Newton's steps from below
    never overshoot. NaN for a point that is not behind the last interface.

    Parameters
    ----------
    distance : of the first interface along the optical axis [m]
    normal : (3,) of the interfaces, toward the camera
    indices, thicknesses : of the media from the camera's on, and of those between the interfaces [m]
    """
    normal = normal / np.linalg.norm(normal)
    first = -distance * normal[2]
    last = -(points @ normal) - first - sum(thicknesses)
    along = points - (points @ normal)[:, None] * normal
    square = np.sum(along**2, axis=1)
    heights, m = (first, *thicknesses, np.where(last > 0.0, last, np.nan)), np.array(indices) / min(indices)
    v = 1.0 / sum(h / k for h, k in zip(heights, m, strict=True))
    for _ in range(STEPS):
        roots = [np.sqrt(k * k + (k * k - 1.0) * square * v * v) for k in m]
        covered = sum(h * v / root for h, root in zip(heights, roots, strict=True))
        v = v + (1.0 - covered) / sum(h * k * k / root**3 for h, k, root in zip(heights, m, roots, strict=True))
    return (v / np.sqrt(m[0] ** 2 + (m[0] ** 2 - 1.0) * square * v * v))[:, None] * along - normal


def _names(corners: Corners) -> tuple[str, ...]:
    axes = ("turn_x", "turn_y", "turn_z", "x_m", "y_m", "z_m")
    return (*LENS, *PLANE, INDEX, PANE, *(f"{place}.{axis}" for place in corners.places for axis in axes))


def _start(corners: Corners, optics: Optics) -> np.ndarray:
    """Approximate values: the lens from the places in air, places that are only wet from straight rays."""
    seen = [np.flatnonzero((corners.place == k) & ~corners.wet) for k in range(len(corners.places))]
    dry = [rows for rows in seen if len(rows)]
    flat = [np.column_stack([corners.board[rows], np.zeros(len(rows))]).astype(np.float32) for rows in dry]
    # OpenCV has the centre of the first pixel at 0, 0.
    pixels = [(corners.pixel[rows] - 0.5).astype(np.float32) for rows in dry]
    flags = cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K3
    width, height = optics.size
    guess = np.array([[width, 0.0, 0.5 * width], [0.0, width, 0.5 * height], [0.0, 0.0, 1.0]])
    _, matrix, distortion, *_ = cv2.calibrateCamera(flat, pixels, optics.size, guess, None, flags=flags)
    distortion = np.ravel(distortion)
    lens = [matrix[0, 0], matrix[0, 2] + 0.5, matrix[1, 2] + 0.5, distortion[0], distortion[1]]
    boards = []
    for number, rows in enumerate(seen):
        rows = rows if len(rows) else np.flatnonzero(corners.place == number)
        board = np.column_stack([corners.board[rows], np.zeros(len(rows))])
        _, turn, shift = cv2.solvePnP(board, corners.pixel[rows] - 0.5, matrix, distortion)
        turn, shift = np.ravel(turn), np.ravel(shift)
        if corners.wet[rows[0]]:
            # Apparent depth: through the water the board seems nearer than it is.
            distance = optics.distance_m[0]
            shift *= (distance + optics.index[0] * (shift[2] - distance)) / shift[2]
        boards.append(np.concatenate([turn, shift]))
    plane = [0.0, 0.0, optics.distance_m[0]]
    return np.concatenate([lens, plane, [optics.index[0], optics.pane_m[0]], *boards])


def table(corners: Corners, found: Found) -> list[str]:
    """Lines of the estimates and of the photographs."""
    lines = [f"{'':12} {'value':>12} {'std':>10}"]
    for name in (*LENS, *PLANE, INDEX, PANE):
        value, std = found[name]
        lines.append(f"{name:12} {value:12.5f} {std:10.5f}" + ("  (fixed)" if std == 0.0 else ""))
    lines += ["", f"std of an image coordinate: {found.std_px:.3f} px", f"{'photograph':20} corners  rms [px]"]
    for number, name in enumerate(corners.places):
        for wet, medium in ((False, "air"), (True, "water")):
            mine = (corners.place == number) & (corners.wet == wet)
            if mine.any():
                rms = np.sqrt(np.mean(found.residuals[mine] ** 2))
                lines.append(f"{name + ', ' + medium:20} {mine.sum():7}  {rms:8.3f}")
    return lines


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the estimates from a table of corners."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("corners", type=Path, metavar="CSV")
    parser.add_argument("--size", type=int, nargs=2, required=True, metavar=("W", "H"), help="of the photographs [px]")
    parser.add_argument("--distance", type=float, required=True, metavar="M", help="camera to water or pane, about")
    parser.add_argument("--distance-std", type=float, default=np.inf, metavar="M", help="where it was measured")
    parser.add_argument("--index", type=float, default=WATER, help="of the water; a start where it is unknown")
    parser.add_argument("--pane", type=float, default=0.0, metavar="M", help="thickness; 0: open water from above")
    parser.add_argument("--glass", type=float, default=GLASS, metavar="INDEX", help="of the pane")
    parser.add_argument("--unknown", choices=("index", "pane", "both"), default="index")
    parser.add_argument("--known-std", type=float, default=0.0, metavar="STD", help="of the one that is known")
    options = parser.parse_args(arguments)
    if options.unknown != "index" and not options.pane > 0.0:
        parser.error("--unknown pane needs a start: --pane, its thickness in metres, about")
    index = np.inf if options.unknown in ("index", "both") else options.known_std
    pane = np.inf if options.unknown in ("pane", "both") else options.known_std if options.pane > 0.0 else 0.0
    distance = options.distance, options.distance_std
    optics = Optics(tuple(options.size), distance, (options.index, index), (options.pane, pane), options.glass)
    corners = read_corners(options.corners)
    found = estimate(corners, optics)
    sys.stdout.write("\n".join(table(corners, found)) + "\n")


if __name__ == "__main__":
    main()
