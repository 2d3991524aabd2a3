"""Priors of poses, from GPS, attitudes or a poses file, with their standard deviations, for the adjustment."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from geo.frames import LocalFrame
from survey.folder.found import Found
from survey.photos.cameras import View
from survey.photos.exif import Exif
from survey.settings.config import CamerasConfig
from survey.settings.tables import per_axis
from survey.sfm.gps import EXACT, WELL_KNOWN_M, DatumStd, datum_stds, positions_in_crs
from survey.sfm.gps_fit import attitudes_of

# DJI's code of a fixed RTK solution; its standard deviations are those of the receiver.
_RTK_FIXED = 50
# Standard deviation of a position of GPS without corrections, to start from; the block then estimates it.
GPS_STD_M = 3.0
# Common error of heights in EXIF of unknown accuracy. Most drones take them from their barometer and the standard
# atmosphere, from which the pressure of the day differs by some 10 hPa, at 8 m each.
BAROMETER_STD_M = 80.0
# Common error of attitudes in XMP, in addition to [cameras] rotation_std_deg: from the sensors of the gimbal and the
# mounting of the camera.
_ATTITUDE_STD_DEG = 1.0
# Sources: positions before the adjustment of another program, with the accuracy that its file gives them; poses of a
# file that states no accuracy.
BY_FILE, BY_POSES = "GPS in the poses file", "poses file"


@dataclass(frozen=True, eq=False)
class PosePrior:
    # (3,) float64 [m], local, or None: of the camera: by GPS, or of its pose in the poses file
    position: np.ndarray | None
    position_std: np.ndarray | None  # (3,) float64 [m] or None: East, north, up. None where it is not known.
    # (3,) float64 [deg] or None: of the rotation that the view was loaded with, about the axes of local. None where
    # that rotation was found by structure from motion, or its accuracy is not known.
    rotation_std_deg: np.ndarray | None
    # Of the standard deviation, "survey.toml", "geo.txt", "XMP RTK", "stated accuracy" or `BY_FILE`; without one, of
    # the position: "GPS EXIF", "geo.txt", `BY_POSES`, or "none"
    source: str
    # [m]: of an error common to the heights of all positions; 0 where there is none
    common_up_std: float = 0.0
    # [m]: of an error common to all positions in plan, in addition to `position_std`: by a transformation of datums
    common_plan_std: float = 0.0
    # (3, 3) or None: cam from local, by the attitude of the camera in XMP, of views that structure from motion placed
    attitude: np.ndarray | None = None
    attitude_std_deg: float = _ATTITUDE_STD_DEG  # [deg]: of what attitudes have in common
    # The prior by a position that the block contradicts on straight rays, which count for nothing until the adjustment,
    # with bent rays, finds that it agrees; None where there is no such position
    rejected: PosePrior | None = None

    def without_position(self) -> PosePrior:
        """The prior whose position counts for nothing until the adjustment finds that it agrees."""
        return replace(self, position=None, position_std=None, source="none", common_up_std=0.0, rejected=self)

    def held_by_control(self) -> PosePrior:
        """The prior where control places the block: common errors are added to the std of single positions."""
        if self.rejected is not None:
            return replace(self, rejected=self.rejected.held_by_control())
        # Nothing to widen for poses that count as exact, and for positions of unknown accuracy.
        std = None if self.position_std is None else DatumStd(plan=self.common_plan_std).onto(self.position_std)
        return replace(self, position_std=std, common_plan_std=0.0) if self.common_plan_std else self


def priors_of_poses(
    cameras: CamerasConfig,
    views: Sequence[View],
    given: Mapping[str, tuple[np.ndarray, np.ndarray]] | None = None,
    datum: DatumStd = EXACT,
) -> dict[str, PosePrior]:
    """Priors of views with poses from a file: these poses, as accurate as [cameras] says.

    Where it says nothing, priors are the positions before adjustment that the file gives: ``given``, positions and
    standard deviations [m], local, by name of the view. ``datum`` is the std that their transformation into crs adds.
    """
    position_std, rotation_std = (
        None if std is None else np.array(per_axis(std)) for std in (cameras.position_std_m, cameras.rotation_std_deg)
    )
    own = BY_POSES if position_std is None else "survey.toml"
    priors = {}
    for view in views:
        position, std, source = view.camera.centre, position_std, own
        if position_std is None and given and view.name in given:
            (position, std), source = given[view.name], BY_FILE
        priors[view.name] = PosePrior(position, std, rotation_std, source, common_plan_std=datum.plan)
    return priors


def priors_of_gps(
    found: Found, frame: LocalFrame, views: Sequence[View], rejected: Collection[str] = ()
) -> dict[str, PosePrior]:
    """Priors of views that structure from motion placed: the positions in EXIF; the ``rejected`` ones only as such.

    As accurate as [cameras] says, else as XMP does, where the receiver had a fixed solution.
    """
    cameras = found.config.cameras
    positions, _ = positions_in_crs(found.headers, found.crs, cameras.gps_height)
    datums = datum_stds(found.headers, found.crs, cameras.gps_height)
    attitudes = attitudes_of({view.name: found.headers[view.name] for view in views})
    std_deg = cameras.rotation_std_deg
    attitude_std = _ATTITUDE_STD_DEG if std_deg is None else max(per_axis(std_deg))
    priors = {}
    for view in views:
        prior, datum = PosePrior(None, None, None, "none"), datums.get(view.name, EXACT)
        if (place := positions.get(view.name)) is not None:
            std, source = _std_by_exif(cameras, found.headers[view.name], datum)
            prior = PosePrior(frame.local_from_crs(place), std, None, source, _common_up(std), datum.plan)
        prior = prior.without_position() if view.name in rejected else prior
        priors[view.name] = replace(prior, attitude=attitudes.get(view.name), attitude_std_deg=attitude_std)
    return priors


def common_up_std(priors: Mapping[str, PosePrior]) -> float:
    """Standard deviation [m] of the common error of the heights of positions; 0 if any of them has none."""
    return min((prior.common_up_std for prior in priors.values() if prior.position is not None), default=0.0)


def common_plan_std(priors: Mapping[str, PosePrior]) -> float:
    """The same of the places of all positions in plan."""
    return min((prior.common_plan_std for prior in priors.values() if prior.position is not None), default=0.0)


def common_up_std_of_exif(cameras: CamerasConfig, headers: Mapping[str, Exif], datum: DatumStd = EXACT) -> float:
    """`common_up_std` of heights in EXIF, before structure from motion; ``datum`` is added by the transformation."""
    placed = [header for header in headers.values() if header.lat_lon_height is not None]
    return min((_common_up(_std_by_exif(cameras, header, datum)[0]) for header in placed), default=0.0)


def _common_up(std: np.ndarray | None) -> float:
    up = BAROMETER_STD_M if std is None else float(std[2])
    return up if up > WELL_KNOWN_M else 0.0


def _std_by_exif(cameras: CamerasConfig, header: Exif, datum: DatumStd = EXACT) -> tuple[np.ndarray | None, str]:
    """The std (3,) [m] of a GPS position, without that of the transformation into crs; its source, None if unknown."""
    std, source = _std_as_given(cameras, header)
    return None if std is None else DatumStd(up=datum.up).onto(np.array(std)), source


def _std_as_given(cameras: CamerasConfig, header: Exif) -> tuple[tuple[float, float, float] | None, str]:
    if cameras.position_std_m is not None:
        return per_axis(cameras.position_std_m), "survey.toml"
    if header.table_place is not None:
        # Given for these positions, as position_std_m is.
        return header.table_place.std_m, header.table_place.source
    if header.rtk is not None and header.rtk.flag == _RTK_FIXED:
        return header.rtk.std_m, "XMP RTK"
    # Receivers of other makers do not state the source of their accuracy: one of centimetres is by corrections; errors
    # of metres are nearly the same in all photographs, and a stated accuracy of metres says nothing of them.
    if header.std_m is not None and max(header.std_m) <= WELL_KNOWN_M:
        return header.std_m, "stated accuracy"
    return None, "GPS EXIF"


def best_plan_std(cameras: CamerasConfig, headers: Iterable[Exif]) -> float:
    """The smallest standard deviation [m] in plan that is known of GPS positions as given; infinite where none is."""
    stds = [_std_as_given(cameras, header)[0] for header in headers if header.lat_lon_height is not None]
    return min((max(std[:2]) for std in stds if std is not None), default=math.inf)


def accuracy_of_priors(priors: Mapping[str, PosePrior]) -> str:
    """Accuracy of the positions of views, and its source, in one sentence."""
    return _accuracy([(p.position_std, p.source) for p in priors.values()], common_plan_std(priors))


def accuracy_of_gps(cameras: CamerasConfig, headers: Mapping[str, Exif], datum: DatumStd = EXACT) -> str:
    """Expected accuracy of the positions in EXIF, in one sentence, before structure from motion.

    ``datum`` is the std that their transformation into crs adds.
    """
    stds: list[tuple[np.ndarray | None, str]] = []
    for header in headers.values():
        place = header.lat_lon_height
        is_known = place is not None and math.isfinite(place[2])
        stds.append(_std_by_exif(cameras, header, datum) if is_known else (None, "none"))
    return _accuracy(stds, datum.plan)


def _accuracy(all_stds: Sequence[tuple[np.ndarray | None, str]], common_plan: float) -> str:
    """Numbers of standard deviations by source, with their medians, and what all have in common."""
    parts = []
    for source in dict.fromkeys(source for _, source in all_stds):
        stds = [std for std, own in all_stds if own == source]
        count, known = f"{len(stds)} of {len(all_stds)} positions", [std for std in stds if std is not None]
        if source == "none":
            parts.append(f"{count} not known")
        elif known:
            east, north, up = np.median(known, axis=0)
            parts.append(f"{count} good to {east:.3g}, {north:.3g} and {up:.3g} m east, north and up ({source})")
        else:
            parts.append(f"{count} of unknown accuracy ({source})")
    if common_plan:
        parts.append(f"plus {common_plan:.2g} m in plan in common, by the datum transformation")
    return "; ".join(parts)
