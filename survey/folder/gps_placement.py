"""Poses of a file against the GPS positions of their photographs, by a similarity: shift, rotation and scale.

Programs that know no positions on Earth choose origin, axes and scale of a block themselves. Such poses are placed by
the GPS positions where these determine all three; where settings or format state another place, they are refused.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from pyproj import CRS

from geo.compatibility import require_at
from geo.crs import is_geographic
from geo.errors import GeoError
from geo.frames import LocalFrame, Similarity, robust_similarity
from geo.transformation import lon_lat
from survey.errors import FILE_NAME, ConfigError, Findings, PosesError, SurveyError
from survey.folder.found import Found, below
from survey.folder.plausible import ONE_SURVEY_M, SAME_PLACE_M
from survey.folder.pose_frames import points_in_crs
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
    change_m: float  # rms displacement of the positions by rotation and scale alone
    extent_m: float  # rms distance of GPS positions from their mean
    own_extent_m: float  # the same of the poses, in their own unit
    line: PositionLine | None  # that the GPS positions lie on; None where they span an area
    shift: np.ndarray  # (3,): median difference, GPS position less pose
    unshifted_m: float  # rms distance in plan between both after this shift
    drift_m: float  # that errors of GPS positions may have in common along the flight

    @classmethod
    def of(cls, centres: np.ndarray, positions: np.ndarray, drift_m: float = _DRIFT_M) -> GpsFit | None:
        """The fit of camera centres to GPS positions (N, 3); None for fewer than three, or all at one place."""
        if len(centres) < 3 or np.ptp(positions, axis=0).max() == 0.0 or np.ptp(centres, axis=0).max() == 0.0:
            return None
        similarity, agree = robust_similarity(centres, positions)
        if not (similarity.scale > 0.0 and math.isfinite(similarity.scale)) or agree.sum() < 3:
            return None
        residuals = similarity(centres[agree]) - positions[agree]
        from_mean = centres[agree] - centres[agree].mean(axis=0)
        of_gps = positions[agree] - positions[agree].mean(axis=0)
        change = similarity.scale * from_mean @ similarity.rotation.T - from_mean
        std, shift = gps_std(residuals), np.median(positions - centres, axis=0)
        return cls(
            similarity, len(centres), int(agree.sum()), std, _rms(change), _rms(of_gps), _rms(from_mean),
            line_of(positions[agree], float(std.max())), shift, _rms((positions - centres - shift)[:, :2]),
            drift_m,
        )  # fmt: skip

    @property
    def scale_std(self) -> float:
        """Standard deviation of the scale, as a share of it."""
        return float(self.std_m[0]) / (math.sqrt(self.num_agreeing) * max(self.extent_m, 1e-9))

    @property
    def is_free(self) -> bool:
        """Whether rotation or scale of the poses is not that of the GPS positions, beyond the errors of these."""
        # Of scale and rotation, four parameters, errors of single positions move the block by this much.
        noise_m = math.sqrt(4.0 / self.num_agreeing) * float(self.std_m.max())
        return self.change_m > max(
            _LEAST_CHANGE * min(self.extent_m, self.own_extent_m), _SIGNIFICANT * noise_m, self.drift_m
        )

    @property
    def fault(self) -> str | None:
        """Why the positions do not place the block, as a clause; None where they do."""
        if self.num_agreeing < _FEWEST:
            return f"{self.num_agreeing} GPS positions fit them, and {_FEWEST} are needed"
        if self.num_agreeing < _LEAST_AGREEING * self.num:
            return f"only {self.num_agreeing} of {self.num} GPS positions fit them"
        if self.line is not None:
            return self.line.describe(self.num_agreeing)
        if self.scale_std > _MOST_SCALE_STD:
            return (
                f"the GPS positions, good to {self.std_m[0]:.2g} m and {2.0 * self.extent_m:.3g} m apart, tell the "
                f"scale only to {100.0 * self.scale_std:.0f} %"
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
    # Where there are too few positions, or they do not lie on the map of crs, there are none.
    with suppress(SurveyError, GeoError):
        headers = {pose.name: found.headers[pose.name] for pose in poses}
        gps = gps_positions(headers, found.crs, found.config.cameras.gps_height)
    if file.frame is PoseFrame.LOCAL:
        file, findings = _recognised(found, file, poses, gps)
    known = [] if gps is None else [number for number, pose in enumerate(poses) if pose.name in gps.local]
    centres = np.array([pose.centre for pose in poses])
    positions = None if gps is None else np.array([gps.local[poses[i].name] for i in known])
    std_m = best_plan_std(found.config.cameras, [found.headers[pose.name] for pose in poses])
    drift_m = min(_STDS * std_m, _DRIFT_M)
    fit = None if positions is None else GpsFit.of(centres[known], positions, drift_m)
    if file.frame is PoseFrame.LOCAL and found.config.local.origin is None:
        if fit is None or gps is None:
            num = sum(is_whole(found.headers[pose.name].lat_lon_height) for pose in poses)
            raise ConfigError(
                f"the poses in {found.poses_path} are in a local frame, and neither {FILE_NAME} nor GPS positions of "
                f"different places tell where that is ({num} of {len(poses)} photographs with a pose have one with a "
                f"height, expected {_FEWEST}); give [local] origin = [easting, northing, height] of its zero point in "
                "crs"
            )
        return _placed(found, file, poses, gps, fit)
    if gps is None or positions is None:
        return PlacedPoses(file, poses), findings
    # Where file and settings put the cameras in the local frame of GPS positions; None off the map.
    origin = found.config.local.origin
    stated: np.ndarray | None
    if file.frame is PoseFrame.LOCAL and origin is not None:
        stated = gps.frame.from_frame(LocalFrame(found.crs, origin))(centres)
    else:
        stated = gps.frame.local_from_crs(points_in_crs(file, centres, found.crs, "crs"))
        stated = stated if np.isfinite(stated).all() else None
    at_place = None if stated is None else GpsFit.of(stated[known], positions, drift_m)
    is_elsewhere = stated is None or (at_place is not None and np.hypot(*at_place.shift[:2]) > ONE_SURVEY_M)
    if is_elsewhere and fit is not None and _is_near_zero(centres) and file.crs is None:
        # Numbers that are no coordinates in crs, but those of a frame of the program's own.
        return _placed(found, file, poses, gps, fit)
    if at_place is not None and at_place.is_free:
        statement = (
            f"[local] origin in {FILE_NAME} says that they are metric, east, north and up"
            if file.frame is PoseFrame.LOCAL
            else f"they are read as coordinates in {(file.crs or found.crs).name}"
        )
        remedy = "remove [local] origin: the GPS positions then place them" if at_place.fault is None else _ELSEWHERE
        raise PosesError(
            f"the poses in {found.poses_path} fit the GPS positions of their photographs only with "
            f"{at_place.describe()}, and {statement}; "
            f"{remedy if file.frame is PoseFrame.LOCAL else 'correct them or crs, or ' + _ELSEWHERE}"
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
    if gps is None:
        is_in_crs = not _is_near_zero(centres) and _is_in_area(found.crs, centres)
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
            "where the photographs are, nor metres from the centre of the Earth; correct crs, or transform the model "
            "to metres, east, north and up about a point of the survey"
        )
    return file, Findings()


def _is_in_area(crs: CRS, points: np.ndarray) -> bool:
    """Whether points (N, 3) in crs lie where it is used."""
    places = lon_lat(crs, points[:, :2])
    try:
        require_at(crs, places, "the poses", "crs")
    except GeoError:
        return False
    return bool(np.isfinite(places).all())


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
        warning = f"the axes and scale of the poses in {name} are their own: placed with {fit.describe()} {placed_by}"
        findings = Findings(warnings=(warning,))
    else:
        findings = Findings(
            (f"{name} does not state its place; its axes and scale are kept, and it is placed {placed_by}",)
        )
    file = replace(file, frame=PoseFrame.ENU, crs=None, tool=file.tool or "the program of the poses")
    return PlacedPoses(file, placed, (similarity, gps.frame)), findings
