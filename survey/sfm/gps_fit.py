"""Fit of a block to GPS positions: residuals, whether they determine its orientation, and its roll about one line.

Attitudes of the camera in XMP tell the roll about the one line that positions lie on, and control points by where they
lie across it. Without either, a block is taken to look straight down across the line, or, where its ground would then
be steep, to lie over level ground. The adjustment finds the roll from all that tells it, and how well
(`survey.adjust.block.roll`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from geo.frames import Similarity, gross_error_limit
from survey.photos.exif import Exif
from survey.photos.poses import enu_from_yaw_pitch_roll

# Accuracy of a receiver with carrier-phase corrections: the smallest standard deviation that is assumed.
MIN_STD_M = 0.02
# Cameras closer to one line than this many std, or share of its length, leave the roll of the block about it open.
_LINE_STD, _LINE_SHARE = 3.0, 0.03
# Focal lengths in EXIF are within 5 % of calibrated ones, 35 mm equivalents of cropped images within 8 %.
FOCAL_SHARE = 0.08
ROLL_REMEDY = "give control beside the line, or attitudes in XMP, or add images of a second strip"
# When the shape of all positions is asked for, one of so many may be wrong: farther from their middle than the median
# by this factor. Of a strip the ends are twice as far.
_ONE_WRONG_OF, _FAR = 5, 8.0
# Fewer residuals do not tell a wrong one.
_FEWEST = 4
# Steeper across the line than this [rad], ground that seems so is one that the cameras looked at from aside.
_STEEP = math.radians(25.0)
# Steps of the fit of a line to ground points across the strip, each without those farther off than the median by this.
_STEPS, _FAR_ACROSS = 5, 3.0


def gps_std(residuals) -> np.ndarray:
    """Standard deviation (3,) [m] of GPS positions: east and north alike, up; from residuals (N, 3) [m], local.

    The seven parameters of the similarity reduce the degrees of freedom; never below `MIN_STD_M`.
    """
    residuals = np.asarray(residuals, dtype=np.float64)
    share = max(3.0 * len(residuals) - 7.0, 1.0) / (3.0 * len(residuals))
    mean_squares = (residuals**2).mean(axis=0) / share
    plan = math.sqrt(0.5 * (mean_squares[0] + mean_squares[1]))
    return np.maximum([plan, plan, math.sqrt(mean_squares[2])], MIN_STD_M)


@dataclass(frozen=True)
class PositionLine:
    """A line that positions lie on, given how good they are: they leave the roll of a block about it open."""

    # centre, direction: (3,) [m], local; (3,)
    centre: np.ndarray
    direction: np.ndarray
    # along, across [m]: root mean squares of the positions along the line and beside it
    along: float
    across: float
    std_m: float  # [m]: of the positions
    what: str = "GPS positions"  # What they are, as a plural

    def describe(self, num: int) -> str:
        """The finding on so many of them, as a clause."""
        return (
            f"{num} {self.what} lie on one line (spread {self.along:.1f} m along and {self.across:.2f} m across, good "
            f"to {self.std_m:.2g} m), which does not determine the roll of the block about it"
        )


def line_of(positions, std_m: float) -> PositionLine | None:
    """The line that positions (N, 3) [m], local, lie on; None where they span an area."""
    positions = np.asarray(positions, dtype=np.float64)
    num = len(positions)
    # A wrong position may make a line of an area, and an area of a line.
    distance = np.linalg.norm(positions - np.median(positions, axis=0), axis=1)
    far = distance > _FAR * np.median(distance)
    kept = positions[~far] if far.sum() <= num // _ONE_WRONG_OF else positions
    centre = kept.mean(axis=0)
    _, lengths, axes = np.linalg.svd(kept - centre, full_matrices=False)
    along, across = (float(length) for length in lengths[:2] / math.sqrt(len(kept)))
    is_line = across < max(_LINE_STD * std_m, _LINE_SHARE * along)
    return PositionLine(centre, axes[0], along, across, std_m) if is_line else None


def is_contradicted(residuals) -> np.ndarray:
    """Positions (N,) bool that the block contradicts, by their residuals (N, 3) [m], local; NaN counts for nothing.

    Residuals may have a shift in common, as heights by a barometer do.
    """
    residuals = np.asarray(residuals, dtype=np.float64)
    known = np.isfinite(residuals).all(axis=1)
    wrong = np.zeros(len(residuals), dtype=bool)
    if known.sum() < _FEWEST:
        return wrong
    distance = np.linalg.norm(residuals[known] - np.median(residuals[known], axis=0), axis=1)
    # At first no more than half of them are trusted, as in `geo.frames.robust_similarity`.
    num = len(distance) // 2 + 1
    for _ in range(2):
        is_wrong = distance > gross_error_limit(float(np.median(distance)), num)
        num = max(int((~is_wrong).sum()), num)
    wrong[known] = is_wrong
    return wrong


@dataclass(frozen=True)
class LineAxes:
    """Axes across a line, which with its direction make a right-handed frame."""

    # centre, along: (3,) [m], (3,)
    centre: np.ndarray
    along: np.ndarray
    # lateral, up (3,): `lateral` is horizontal where the line is
    lateral: np.ndarray
    up: np.ndarray

    @classmethod
    def of(cls, line: PositionLine) -> LineAxes:
        """Directions along and across a line."""
        along = line.direction
        up = np.array([0.0, 0.0, 1.0]) - along[2] * along
        # Of a line that goes straight up, any side will do.
        up = up if np.linalg.norm(up) > 1e-6 else np.array([0.0, 1.0, 0.0])
        up = up / np.linalg.norm(up)
        return cls(line.centre, along, np.cross(up, along), up)

    def flat(self, points: np.ndarray) -> np.ndarray:
        """Places (N, 2) [m] of points (N, 3), local, beside the line and above it."""
        return (points - self.centre) @ np.stack([self.lateral, self.up], axis=1)

    def rolled(self, angle: float) -> Similarity:
        """The rotation about the line by an angle [rad]."""
        turn = Rotation.from_rotvec(angle * self.along).as_matrix()
        return Similarity(1.0, turn, self.centre - turn @ self.centre)


def attitudes_of(headers: Mapping[str, Exif]) -> dict[str, np.ndarray]:
    """Rotations (3, 3) from true east, north, up to cam, by the attitudes of the camera in XMP, where it has them."""
    found = {}
    for name, header in headers.items():
        if header.motion.gimbal_deg is not None:
            yaw, pitch, roll = np.radians(header.motion.gimbal_deg)
            found[name] = enu_from_yaw_pitch_roll(yaw, pitch + 0.5 * math.pi, roll).T
    return found


def roll_by_attitudes(across: LineAxes, rotations: np.ndarray, attitudes: np.ndarray) -> float:
    """Roll [rad] about the line that turns rotations (V, 3, 3), cam from local, to the attitudes of the cameras."""
    turns = Rotation.from_matrix(attitudes.transpose(0, 2, 1) @ rotations).as_quat()
    # The twist about the line; what is left of a turn, errors of the heading above all, leaves it as it is.
    angles = 2.0 * np.arctan2(turns[:, :3] @ across.along, turns[:, 3])
    middle = math.atan2(float(np.sin(angles).sum()), float(np.cos(angles).sum()))
    return middle + float(np.median((angles - middle + math.pi) % (2.0 * math.pi) - math.pi))


def roll_by_ground(across: LineAxes, rotations: np.ndarray, points: np.ndarray) -> float:
    """Roll [rad] after which cameras look straight down across the line, or else the ground (N, 3) is level there."""
    lateral, up = rotations[:, 2].sum(axis=0) @ np.stack([across.lateral, across.up], axis=1)
    angle = -0.5 * math.pi - math.atan2(up, lateral)
    steep = _slope(across.flat(across.rolled(angle)(points)))
    return angle - steep if abs(steep) > _STEEP else angle


def roll_by_control(across: LineAxes, places: np.ndarray, control: np.ndarray) -> float:
    """Roll [rad] that rotates places (K, 3) of a block onto their control (K, 3), by their offsets across the line.

    Heights of positions and of control may have different datums, so that heights do not count.
    """
    places_across, control_across = across.flat(places), across.flat(control)
    reach = np.linalg.norm(places_across, axis=1)
    # A point at the same distance below the line, at its own place beside it.
    below = -np.sqrt(np.maximum(reach**2 - control_across[:, 0] ** 2, (0.1 * reach) ** 2))
    angles = np.arctan2(below, control_across[:, 0]) - np.arctan2(places_across[:, 1], places_across[:, 0])
    return float(np.median((angles + math.pi) % (2.0 * math.pi) - math.pi))


def _slope(places: np.ndarray) -> float:
    """Angle [rad] by which most of some places (N, 2) [m], beside a line and above it, rise to the side."""
    kept = places
    for _ in range(_STEPS):
        rise, start = np.polyfit(kept[:, 0], kept[:, 1], 1)
        off = np.abs(places[:, 1] - start - rise * places[:, 0])
        kept = places[off <= _FAR_ACROSS * np.median(off)]
    return math.atan(rise)
