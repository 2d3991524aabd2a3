"""Marks that are proposed: coded targets, the corners of chequered ones, and what looks like a place that is marked."""

import re
from typing import NamedTuple

import cv2
import numpy as np

from refract import FlatWater
from survey.errors import SurveyError
from survey.photos.cameras import View, projection_and_jacobian

# Half sides [px] of the window that is compared, and of the square about the predicted pixel that is searched.
_HALF, _REACH = 7, 40
# Least normalised cross-correlation (NCC) of a proposal.
_LEAST_NCC = 0.75
_CODES = (cv2.aruco.DICT_4X4_50, cv2.aruco.DICT_5X5_100, cv2.aruco.DICT_6X6_250, cv2.aruco.DICT_APRILTAG_36H11)
# Least perimeter of a coded target, as a share of the longer side of the photograph: 14 px a side of 20 megapixels.
_LEAST_PERIMETER = 0.01
# Half side [px] of the window in which the corner of a chequered target is found.
_CORNER = 7
# Circles about the corner of a chequered target [px], the values on each, and the least share of their variance that
# has two periods: 0.81 of a square wave.
_RADII, _ROUND, _OF_TWO_PERIODS = (3.0, 5.0), 64, 0.6


class Proposal(NamedTuple):
    """A pixel, and the NCC with the marked window; 1 of a coded target."""

    pixel: tuple[float, float]
    score: float


def coded(grey: np.ndarray, name: str, near: np.ndarray | None) -> Proposal | None:
    """The middle of the coded target (ArUco, AprilTag) whose number ends the name of a point; nearest to a pixel."""
    number, detector = re.search(r"\d+$", name), cv2.aruco.ArucoDetector()
    parameters = cv2.aruco.DetectorParameters()
    parameters.minMarkerPerimeterRate = _LEAST_PERIMETER
    detector.setDetectorParameters(parameters)
    middles = []
    for code in _CODES if number is not None else ():
        detector.setDictionary(cv2.aruco.getPredefinedDictionary(code))
        corners, ids, _ = detector.detectMarkers(grey)
        for square, found in zip(corners, [] if ids is None else ids.ravel().tolist(), strict=True):
            if number is not None and found == int(number[0]):
                # The diagonals of a square meet in its middle in perspective, too.
                a, b, c, d = np.column_stack([square.reshape(4, 2) + 0.5, np.ones(4)])
                middle = np.cross(np.cross(a, c), np.cross(b, d))
                middles.append(middle[:2] / middle[2])
    if not middles:
        return None
    x, y = middles[0] if near is None else min(middles, key=lambda each: float(np.linalg.norm(each - near)))
    return Proposal((float(x), float(y)), 1.0)


def corner(grey: np.ndarray, pixel: tuple[float, float]) -> tuple[float, float]:
    """The corner of a chequered target near a pixel; raises SurveyError where none is within the window."""
    height, width = grey.shape
    at = np.clip(np.array(pixel) - 0.5, 0.0, [width - 1.0, height - 1.0]).astype(np.float32)
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 50, 1e-3)
    x, y = cv2.cornerSubPix(grey, at.reshape(1, 1, 2).copy(), (_CORNER, _CORNER), (-1, -1), stop)[0, 0].tolist()
    if at.tolist() == [x, y] or not _is_chequered(grey, x, y):
        raise SurveyError("there is no corner of a chequered target near the mark")
    return x + 0.5, y + 0.5


def _is_chequered(grey: np.ndarray, x: float, y: float) -> bool:
    """Whether four fields about a corner, counted from zero, are light and dark in turn: like across, unlike beside.

    On circles about it grey levels have two periods, and little else.
    """
    angles = np.linspace(0.0, 2.0 * np.pi, _ROUND, endpoint=False)
    radii = np.array(_RADII)[:, None]
    rings = cv2.remap(
        grey, (x + radii * np.cos(angles)).astype(np.float32), (y + radii * np.sin(angles)).astype(np.float32),
        cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE,
    ).astype(np.float64)  # fmt: skip
    power = np.abs(np.fft.rfft(rings, axis=1)[:, 1:]) ** 2
    return bool((power[:, 1] > _OF_TWO_PERIODS * np.maximum(power.sum(axis=1), 1e-9)).all())


def correlated(
    views: tuple[View, View], greys: tuple[np.ndarray, np.ndarray], mark: tuple[float, float], place: np.ndarray,
    water: FlatWater | None,
) -> Proposal | None:  # fmt: skip
    """Where the second photograph shows what the first shows at a mark; None where nothing there is as much alike.

    The window is warped by the affine map between both at the place (3,), local, as if the ground there were level.
    """
    (_, first), (predicted, second) = (projection_and_jacobian(view.camera, place, water) for view in views)
    across = first[:, :2] @ np.linalg.inv(second[:, :2])
    warp = np.column_stack([across, np.array(mark) - 0.5 - across @ np.full(2, _HALF)])
    sizes = [(2 * half + 1, 2 * half + 1) for half in (_HALF, _HALF + _REACH)]
    window = cv2.warpAffine(greys[0], warp, sizes[0], flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    searched = cv2.getRectSubPix(greys[1], sizes[1], (predicted - 0.5).tolist())
    ncc = cv2.matchTemplate(searched, window, cv2.TM_CCOEFF_NORMED)
    row, column = divmod(int(ncc.argmax()), ncc.shape[1])
    if not (0 < row < 2 * _REACH and 0 < column < 2 * _REACH) or ncc[row, column] < _LEAST_NCC:
        return None
    x = predicted[0] + column - _REACH + _vertex(ncc[row, column - 1 : column + 2])
    y = predicted[1] + row - _REACH + _vertex(ncc[row - 1 : row + 2, column])
    return Proposal((float(x), float(y)), float(ncc[row, column]))


def _vertex(values: np.ndarray) -> float:
    """Where the parabola through the values (3,) at -1, 0, 1 has its vertex."""
    before, at, after = values.astype(np.float64)
    return float(0.5 * (before - after) / min(before - 2.0 * at + after, -1e-9))
