"""Poses of a file against the GPS positions of their photographs, by a similarity: shift, rotation and scale.

Programs that know no positions on Earth choose origin, axes and scale of a block themselves. Such poses are placed by
the GPS positions where these determine all three; where settings or format state another place, they are refused.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from geo.compatibility import require_at
from geo.crs import is_geographic
from geo.errors import GeoError
from geo.frames import LocalFrame, Similarity, robust_similarity
from geo.transformation import lon_lat
from survey.errors import FILE_NAME, ConfigError, Findings, PosesError, SurveyError
from survey.folder.found import Found, below
from survey.folder.headers import SAME_PLACE_M
from survey.folder.local_frame import points_in_crs
from survey.folder.plausible import ONE_SURVEY_M
from survey.folder.pose_priors import best_plan_std
from survey.photos.poses import FileTies, Pose, PoseFile, PoseFrame
from survey.sfm.gps import GpsPositions, gps_positions, is_whole
from survey.sfm.gps_fit import PositionLine, gps_std, line_of

# Three positions always fit, a fourth checks them.
_FEWEST = 4
# Scale and rotation that drifting receivers, or a grid, may seem to have; larger ones are those of a block.
_LEAST_CHANGE = 0.1
# A receiver without corrections drifts by this [m] during a flight; one with corrections stays within some of its std.
_DRIFT_M, _STDS = 2.0, 5.0
# Times the standard deviation, of what errors of single positions do not explain.
_SIGNIFICANT = 6.0
# Poses fit GPS positions by a shift if at most this share of the variance remains after it.
_UNEXPLAINED = 0.1
# Positions place a block where they determine its scale to this, and contradict few.
_MOST_SCALE_STD, _LEAST_AGREEING = 0.05, 0.75
# Distances from the centre of the Earth of places on its surface [m].
_EARTH_M = (6.34e6, 6.40e6)
_ELSEWHERE = (
    "transform the model to metres, east, north and up (COLMAP: model_aligner --ref_is_gps 1 --alignment_type enu), "
    f"or leave [cameras] poses out of {FILE_NAME} and the file out of the folder: poses are then found from the "
    "photographs"
)


@dataclass(frozen=True)
class GpsFit:
    """The similarity from camera positions of a poses file to GPS positions, both [m] in Cartesian axes."""

    similarity: Similarity
    num: int  # positions
    num_agreeing: int  # of these, to which the similarity is fitted
    std_m: np.ndarray  # (3,) [m]: of the GPS positions, by their residuals
    extent_m: float  # rms distance of GPS positions from their mean
    line: PositionLine | None  # that the GPS positions lie on; None where they span an area
    shift: np.ndarray  # (3,): median difference, GPS position less pose
    unshifted_m: float  # rms distance in plan between both after this shift
    is_free: bool  # whether rotation or scale of the poses is not that of the GPS positions, beyond errors of these

    @classmethod
    def of(cls, centres: np.ndarray, positions: np.ndarray, drift_m: float = _DRIFT_M) -> GpsFit | None:
        """The fit of camera centres to GPS positions (N, 3); None for fewer than three, or all at one place.

        Errors of GPS positions may have ``drift_m`` [m] in common along the flight.
        """
        if len(centres) < 3 or np.ptp(positions, axis=0).max() == 0.0 or np.ptp(centres, axis=0).max() == 0.0:
            return None
        similarity, agree = robust_similarity(centres, positions)
        num = int(agree.sum())
        if not (similarity.scale > 0.0 and math.isfinite(similarity.scale)) or num < 3:
            return None
        std = gps_std(similarity(centres[agree]) - positions[agree])
        from_mean, extent_m = (points[agree] - points[agree].mean(axis=0) for points in (centres, positions))
        # Displacement by rotation and scale alone; errors of single positions move these four parameters by as much.
        change_m = _rms(similarity.scale * from_mean @ similarity.rotation.T - from_mean)
        noise_m = math.sqrt(4.0 / num) * float(std.max())
        least_m = _LEAST_CHANGE * min(_rms(extent_m), _rms(from_mean))
        shift = np.median(positions - centres, axis=0)
        return cls(
            similarity, len(centres), num, std, _rms(extent_m), line_of(positions[agree], float(std.max())), shift,
            _rms((positions - centres - shift)[:, :2]), change_m > max(least_m, _SIGNIFICANT * noise_m, drift_m),
        )  # fmt: skip

    @property
    def fault(self) -> str | None:
        """Why the positions do not place the block, as a clause; None where they do."""
        scale_std = float(self.std_m[0]) / (math.sqrt(self.num_agreeing) * max(self.extent_m, 1e-9))
        if self.num_agreeing < _FEWEST:
            return f"{self.num_agreeing} GPS positions fit them, and {_FEWEST} are needed"
        if self.num_agreeing < _LEAST_AGREEING * self.num:
            return f"only {self.num_agreeing} of {self.num} GPS positions fit them"
        if self.line is not None:
            return self.line.describe(self.num_agreeing)
        if scale_std > _MOST_SCALE_STD:
            return (
                f"the GPS positions, good to {self.std_m[0]:.2g} m and {2.0 * self.extent_m:.3g} m apart, tell the "
                f"scale only to {100.0 * scale_std:.0f} %"
            )
        return None

    def describe(self) -> str:
        """Scale and rotation, as a part of a sentence."""
        cosine = 0.5 * (float(np.trace(self.similarity.rotation)) - 1.0)
        degrees = math.degrees(math.acos(min(max(cosine, -1.0), 1.0)))
        return f"a scale of {self.similarity.scale:.4g} and a rotation by {degrees:.0f} degrees"


def _rms(vectors: np.ndarray) -> float:
    return float(np.sqrt((vectors**2).sum(axis=1).mean()))


@dataclass(frozen=True, eq=False)
class PlacedPoses:
    """Poses of a file in a frame that has a place on Earth, or in that of [local]."""

    file: PoseFile  # With the frame of the poses
    poses: list[Pose]
    # takes the frame that the file has to the local frame of GPS positions; None where the file has its place
    by_gps: tuple[Similarity, LocalFrame] | None = None

    def points(self, ties: FileTies) -> np.ndarray:
        """Tie points (N, 3) in the frame of `file`."""
        if self.by_gps is None:
            return ties.points
        similarity, frame = self.by_gps
        return frame.crs_from_local(similarity(ties.points))


def place_poses(found: Found, file: PoseFile, poses: list[Pose]) -> tuple[PlacedPoses, Findings]:
    """Poses of photographs with their place: by file or [local], recognised in their coordinates, or by GPS."""
    gps, findings = None, Findings()
    headers = {pose.name: found.headers[pose.name] for pose in poses}
    # Where there are too few positions, or they do not lie on the map of crs, there are none.
    with suppress(SurveyError, GeoError):
        gps = gps_positions(headers, found.crs, found.config.cameras.gps_height)
    if file.frame is PoseFrame.LOCAL:
        file, findings = _recognised(found, file, poses, gps)
    is_local, origin = file.frame is PoseFrame.LOCAL, found.config.local.origin
    centres, fit, drift_m = np.array([pose.centre for pose in poses]), None, _DRIFT_M
    known, positions = np.zeros(len(poses), dtype=bool), np.zeros((0, 3))
    if gps is not None:
        known = np.array([pose.name in gps.local for pose in poses])
        positions = np.array([gps.local[pose.name] for pose in poses if pose.name in gps.local])
        drift_m = min(_STDS * best_plan_std(found.config.cameras, headers.values()), _DRIFT_M)
        fit = GpsFit.of(centres[known], positions, drift_m)
    if is_local and origin is None:
        if fit is None or gps is None:
            num = sum(is_whole(header.lat_lon_height) for header in headers.values())
            raise ConfigError(
                f"the poses in {found.poses_path} are in a local frame, and neither {FILE_NAME} nor GPS positions of "
                f"different places tell where that is ({num} of {len(poses)} photographs with a pose have one with a "
                f"height, expected {_FEWEST}); give [local] origin = [easting, northing, height] in crs"
            )
        return _placed(found, file, poses, gps, fit)
    if gps is None:
        return PlacedPoses(file, poses), findings
    # Where file and settings put the cameras in the local frame of GPS positions.
    if is_local and origin is not None:
        stated = gps.frame.from_frame(LocalFrame(found.crs, origin))(centres)
    else:
        stated = gps.frame.local_from_crs(points_in_crs(file, centres, found.crs, "crs"))
    is_on_map = np.isfinite(stated).all()
    at_place = GpsFit.of(stated[known], positions, drift_m) if is_on_map else None
    is_elsewhere = not is_on_map or (at_place is not None and np.hypot(*at_place.shift[:2]) > ONE_SURVEY_M)
    if is_elsewhere and fit is not None and _is_near_zero(centres) and file.crs is None:
        # Numbers that are no coordinates in crs, but those of a frame of the program's own.
        return _placed(found, file, poses, gps, fit)
    if at_place is not None and at_place.is_free:
        statement = f"they are read as coordinates in {(file.crs or found.crs).name}"
        remedy = f"correct them or crs, or {_ELSEWHERE}"
        if is_local:
            statement = f"[local] origin in {FILE_NAME} says that they are metric, east, north and up"
            remedy = (
                "remove [local] origin: the GPS positions then place them" if at_place.fault is None else _ELSEWHERE
            )
        raise PosesError(
            f"the poses in {found.poses_path} fit the GPS positions of their photographs only with "
            f"{at_place.describe()}, and {statement}; {remedy}"
        )
    return PlacedPoses(file, poses), findings


def _is_near_zero(centres: np.ndarray) -> bool:
    return bool(np.abs(centres).max() < ONE_SURVEY_M)


def _recognised(found: Found, file: PoseFile, poses: list[Pose], gps: GpsPositions | None) -> tuple[PoseFile, Findings]:
    """The file in the frame that its numbers show: metres from the centre of the Earth, or coordinates in crs."""
    centres = np.array([pose.centre for pose in poses])
    lengths = np.linalg.norm(centres, axis=1)
    name = below(found.folder, found.poses_path)
    if _EARTH_M[0] < lengths.min() and lengths.max() < _EARTH_M[1]:
        note = f"the poses in {name} are metres from the centre of the Earth (ECEF, WGS 84), by their size"
        return replace(file, frame=PoseFrame.GEOCENTRIC), Findings((note,))
    if is_geographic(found.crs):
        return file, Findings()
    is_in_crs = False
    if gps is None:
        places = lon_lat(found.crs, centres[:, :2])
        with suppress(GeoError):
            require_at(found.crs, places, "the poses", "crs")
            is_in_crs = not _is_near_zero(centres) and bool(np.isfinite(places).all())
    else:
        known = [pose.name in gps.local for pose in poses]
        positions = np.array([gps.local[pose.name] for pose in poses if pose.name in gps.local])
        away_m = np.linalg.norm((gps.frame.local_from_crs(centres)[known] - positions)[:, :2], axis=1)
        is_in_crs = bool(np.isfinite(away_m).all() and np.median(away_m) < SAME_PLACE_M)
    if is_in_crs:
        note = f"the poses in {name} are coordinates in {found.crs.name}, by their size"
        return replace(file, frame=PoseFrame.GRID), Findings((note,))
    if not _is_near_zero(centres) and np.ptp(centres, axis=0).max() < ONE_SURVEY_M:
        place = ", ".join(f"{value:.10g}" for value in centres[0])
        raise PosesError(
            f"the poses in {found.poses_path} are at {place}, which is in no local frame, nor in {found.crs.name} "
            "near the photographs, nor ECEF; correct crs, or transform the model to metres, east, north and up"
        )
    return file, Findings()


def _placed(
    found: Found, file: PoseFile, poses: list[Pose], gps: GpsPositions, fit: GpsFit
) -> tuple[PlacedPoses, Findings]:
    """Poses in a frame of their own placed by GPS: by a shift where axes and scale fit, else by the similarity."""
    name = below(found.folder, found.poses_path)
    if fit.is_free or fit.unshifted_m**2 > _UNEXPLAINED * fit.extent_m**2:
        if fit.fault is not None:
            raise PosesError(
                f"the poses in {found.poses_path} have axes and a scale of their own ({fit.describe()} to the GPS "
                f"positions), and {fit.fault}; {_ELSEWHERE}"
            )
        similarity = fit.similarity
    else:
        similarity = Similarity(1.0, np.eye(3), fit.shift)
    local = similarity(np.array([pose.centre for pose in poses]))
    in_crs = gps.frame.crs_from_local(local)
    # True east, north and up at each camera.
    turns = similarity.rotation.T @ gps.frame.local_from_enu(in_crs)
    placed = [
        replace(pose, centre=centre, cam_from_world=pose.cam_from_world @ turn)
        for pose, centre, turn in zip(poses, in_crs, turns, strict=True)
    ]
    placed_by = (
        f"by {fit.num_agreeing} GPS positions, which differ from it by about {fit.std_m[0]:.2g} m east and north and "
        f"{fit.std_m[2]:.2g} m up"
    )
    if similarity is fit.similarity:
        note = f"the axes and scale of the poses in {name} are their own: placed with {fit.describe()} {placed_by}"
    else:
        note = f"{name} does not state its place; its axes and scale are kept, and it is placed {placed_by}"
    file = replace(file, frame=PoseFrame.ENU, crs=None, tool=file.tool or "the program of the poses")
    return PlacedPoses(file, placed, (similarity, gps.frame)), Findings((note,))
