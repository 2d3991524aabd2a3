"""[control] of a survey folder: its files read, checked against the cameras, and transformed to the local frame.

Marks are compared with the projections of their points under the poses and lenses of the survey. The reference, the dry
ground of an earlier survey, is cut to the block.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from pyproj import CRS
from pyproj.crs import CompoundCRS
from scipy.spatial import KDTree

from geo.atl24 import SUFFIXES as ATL24
from geo.atl24 import photons_between
from geo.compatibility import Reprojection, crs_difference
from geo.crs import has_height, height_unit_m, vertical_crs
from geo.features import assumed_crs, layer_of, points_inside, read_polygons
from geo.files import existing_file
from geo.frames import LocalFrame
from geo.grid import plan_box
from geo.projection import metres_per_unit
from geo.reading import read_reference
from geo.shapes import Cloud, Mesh, ground_of, in_height_unit, masked_cloud, vertices_of
from geo.transformation import Transformation
from refract import FlatWater
from survey.control.formats import read_checkpoints
from survey.control.points import Checkpoint, Content, Control, ControlPoint, GivenPoint, StableGround
from survey.control.reading import MergedControl, in_crs, merge_control, read_control
from survey.display.quantities import length, named
from survey.errors import ControlError, Findings
from survey.files.point_table import accuracy_warnings, point_table, several_heights
from survey.photos.cameras import View
from survey.photos.exif import Exif, exif_places
from survey.progress import current
from survey.settings.config import SurveyConfig
from survey.settings.tables import DEFAULT_MARKS_STD_PX, DEFAULT_STD_M, ControlConfig, per_direction
from survey.water.surface import Departure, height_above, plane_under

# A design focal length, or a pose from GPS alone, moves a point by less than this share of the longer side.
_DOUBTFUL_SHARE = 0.02
# Control and check points nearer than this are one point, measured twice.
_ONE_POINT_M = 0.05
# A level is in doubt that lies farther from all points of control, and so many times as far as with the other sign.
_FAR_LEVEL_M, _TIMES_NEARER = 3.0, 5.0
# Check points deeper than so many flying heights are none of this water.
_DEEP = 1.5
# Flying height where nothing states it: the highest without a permit in most countries.
_USUAL_HEIGHT_M = 120.0
_EARTH_RADIUS_M = 6_371_000.0
# A single mark this many times as far off as the median belongs to another point.
_TIMES = 10.0
# Assumed accuracy of a reference that states none: airborne lidar, or photogrammetry on control.
REFERENCE_STD_M = 0.1
# Ground may be wet if it is lower than this above the water [m], or than this many standard deviations of the level.
_LEAST_ABOVE_M, _LEAST_SIGMAS = 0.1, 3.0
# Reach of the reference around the middle of cameras and tie points, in units of their extent.
_REACH = 1.5
_MOST_POINTS = 1_000_000
# Fewer points are not ground.
_FEWEST = 50


@dataclass(frozen=True)
class FoundControl:
    """Contents of the files of [control], in the crs of the survey."""

    config: ControlConfig = field(default_factory=ControlConfig)  # With stds, where there are control points
    merged: MergedControl = field(default_factory=MergedControl)
    checkpoints: tuple[GivenPoint, ...] = ()

    @property
    def points(self) -> tuple[GivenPoint, ...]:
        """Control and check points."""
        return (*self.merged.points, *self.checkpoints)

    @property
    def given(self) -> tuple[GivenPoint, ...]:
        """Control points that the block is adjusted to."""
        return tuple(point for point in self.merged.points if not point.is_check)


def find_control(
    folder: Path, config: ControlConfig, crs: CRS, headers: Mapping[str, Exif], level: float | None = None
) -> tuple[FoundControl, Findings]:
    """Read the files of [control].

    Depths of check points count from ``level``, the one height of the water in crs, where there is one.
    """
    for name in (config.reference, config.stable):
        if name is not None:
            existing_file(layer_of(folder / name)[0])
    checkpoints: list[GivenPoint] = []
    merged, findings = MergedControl(), Findings()
    if config.checkpoints is not None:
        path = folder / config.checkpoints
        if path.suffix.lower() in ATL24:
            checkpoints, findings = _photons(path, crs, headers, level)
        else:
            checkpoints, findings = in_crs(read_checkpoints(path, level, crs), crs)
            findings += Findings(warnings=accuracy_warnings(point_table(path, ControlError)))
    if config.gcp_files:
        contents = [read_control(folder / name) for name in config.gcp_files]
        if config.marks is not None:
            # Metashape's XML has coordinates too, but here only its marks are used.
            contents.append(Content(marks=read_control(folder / config.marks).marks))
        merged, added = merge_control(contents, crs, {name: header.size_px for name, header in headers.items()})
        findings += added + _assumed_stds(config, merged)
        std_m, marks_std_px = config.std_m or DEFAULT_STD_M, config.marks_std_px or DEFAULT_MARKS_STD_PX
        config = replace(config, std_m=std_m, marks_std_px=marks_std_px)
    found = FoundControl(config, merged, (*checkpoints, *merged.unmarked))
    return found, findings + Findings(warnings=_doubts(found, crs, level))


def _photons(
    path: Path, crs: CRS, headers: Mapping[str, Exif], level: float | None
) -> tuple[list[GivenPoint], Findings]:
    """Photons of the bed under the photographs, of a file of ATL24, to a flying height about the GPS positions.

    A footprint reaches about as far: half of the diagonal of a wide lens, and some of the tilt of an oblique one.
    """
    places = exif_places(headers)
    if not len(places):
        raise ControlError(
            f"[control] checkpoints is {path}, of which the photons about the GPS positions of photographs are used; "
            f"the photographs have none: compare the cloud by bathynerf compare RUN {path.name}"
        )
    given_m = [header.above_start_m or np.nan for header in headers.values()]
    if level is not None:
        over_m = level * height_unit_m(crs)
        given_m += [header.lat_lon_height[2] - over_m for header in headers.values() if header.lat_lon_height]
    reach_m = max((height_m for height_m in given_m if height_m > 0.0), default=_USUAL_HEIGHT_M)
    reach = np.degrees(reach_m / _EARTH_RADIUS_M) / np.array([np.cos(np.radians(places[:, 1].mean())), 1.0])
    about = f", {reach_m:.0f} m (the flying height) about the GPS positions"
    found = photons_between(path, crs, plan_box(places) + np.array([-reach, reach]), about)
    stds = zip(found.extra["std_plan"].tolist(), found.extra["std"].tolist(), strict=True)
    points = [
        GivenPoint(f"photon {number}", str(path), (east, north, height), std_m=(plan, plan, up), is_check=True)
        for number, ((east, north, height), (plan, up)) in enumerate(
            zip(found.points.tolist(), stds, strict=True), start=1
        )
    ]
    return points, Findings(found.notes)


def _assumed_stds(config: ControlConfig, merged: MergedControl) -> Findings:
    """Standard deviations that are assumed, with a warning where nothing states that of points."""
    untold = sum(point.std_m is None for point in merged.points)
    warnings = () if config.std_m is not None or not untold else (
        f"no accuracy is stated for {untold} of {len(merged.points)} control points: {DEFAULT_STD_M:g} m is "
        "assumed, as of GNSS with corrections or a total station; give [control] std_m, e.g. 0.03, or [0.02, 0.03] "
        "horizontally and vertically",
    )  # fmt: skip
    assumed = f"[control] marks_std_px = {DEFAULT_MARKS_STD_PX:g}, the std of their marks in pixels"
    return Findings((assumed,) if config.marks_std_px is None else (), warnings)


def _doubts(found: FoundControl, crs: CRS, level: float | None) -> tuple[str, ...]:
    """Warnings about places of control with several heights, check points that are control, and a level's sign."""
    unit_m, places = height_unit_m(crs), np.array([point.place for point in found.points]).reshape(-1, 3)
    several = several_heights([point.name for point in found.points], places, unit_m)
    warnings = named(several, "place", "of control with several heights, of which one is true at most")
    given = [point.place for point in found.given]
    if given and found.checkpoints:
        unit = np.array([*metres_per_unit(crs, places), unit_m])
        checks = np.array([point.place for point in found.checkpoints])
        distance = KDTree(np.array(given) * unit).query(checks * unit)[0]
        same = [point.name for point, far in zip(found.checkpoints, distance, strict=True) if far < _ONE_POINT_M]
        warnings += named(
            same, "check point", "at the place of a control point, which the block is adjusted to: no independent check"
        )
    if level is not None and len(places):
        low, high = places[:, 2].min(), places[:, 2].max()
        off, off_other = (max(low - at, at - high, 0.0) * unit_m for at in (level, -level))
        if off > max(_FAR_LEVEL_M, _TIMES_NEARER * off_other):
            side = "under" if level < low else "over"
            warnings.append(
                f"the water at {level:g} lies {off:.1f} m {side} all control and check points ({low:.2f} to "
                f"{high:.2f}), and at {-level:g} it would not: check the sign of [water] level_m"
            )
    return tuple(warnings)


def place_control(
    found: FoundControl, frame: LocalFrame, views: Sequence[str]
) -> tuple[Control | None, tuple[Checkpoint, ...], Findings]:
    """Control and check points in the local frame of the views that have a pose, by name."""
    checkpoints = tuple(
        Checkpoint(point.name, point.place, _local(point, frame), np.array(point.std_m or np.zeros(3)))
        for point in found.checkpoints
    )
    if not found.merged.points:
        return None, checkpoints, Findings()
    posed = set(views)
    lost = [view for view in dict.fromkeys(mark.view for mark in found.merged.marks) if view not in posed]
    warnings = named(lost, "photograph", "with marks of control has no pose, its marks left out")
    control = control_in_local(found, frame, views)
    if control is None:
        warnings.append("no photograph with a pose shows a control point: they are not used")
    return control, checkpoints, Findings(warnings=tuple(warnings))


def control_in_local(found: FoundControl, frame: LocalFrame, views: Sequence[str]) -> Control | None:
    """The control that views with a pose show; None where they show none of it."""
    posed = set(views)
    marks = tuple(mark for mark in found.merged.marks if mark.view in posed)
    shown, points = {mark.point for mark in marks}, []
    for point in (point for point in found.merged.points if point.name in shown):
        std = np.hypot(point.std_m or per_direction(found.config.std_m), [point.datum_std_m, point.datum_std_m, 0.0])
        place = _local(point, frame)
        points.append(ControlPoint(point.name, point.place, place, std, point.is_check, point.datum_std_m))
    return Control(tuple(points), marks, found.config.marks_std_px or DEFAULT_MARKS_STD_PX) if points else None


def _local(point: GivenPoint, frame: LocalFrame) -> np.ndarray:
    local = frame.local_from_crs(np.array(point.place))
    if not np.isfinite(local).all():
        raise ControlError(
            f"{point.where}: {point.place[0]:.10g}, {point.place[1]:.10g} is not on the map of {frame.crs.name}; "
            "correct it, or the CRS of the file"
        )
    return local


def mark_residuals(control: Control, views: Sequence[View], water: FlatWater | None) -> np.ndarray:
    """Distances (marks,) [px] of the marks from their points, as seen through the water where these are wet.

    NaN where a point lies behind its camera.
    """
    cameras = {view.name: view.camera for view in views}
    local = {point.name: point.local for point in control.points}
    shown = [cameras[mark.view].project(local[mark.point], water) for mark in control.marks]
    return np.linalg.norm(np.array([mark.pixel for mark in control.marks]) - np.array(shown), axis=1)


def mark_warnings(control: Control, views: Sequence[View], water: FlatWater | None) -> list[str]:
    """Warnings about marks that lie far from where the poses show their points."""
    residuals = mark_residuals(control, views, water)
    longer = {view.name: max(view.lens.width, view.lens.height) for view in views}
    near = residuals <= _DOUBTFUL_SHARE * np.array([longer[mark.view] for mark in control.marks])
    middle = np.nanmedian(residuals) if np.isfinite(residuals).any() else np.inf
    if near.mean() < 0.5:
        return [
            f"the marks of control points lie {middle:.0f} px (median) from where the poses show these points; check "
            "the coordinates and heights of the points, the order x, y of the marks, that they are in pixels of these "
            "images, and the poses"
        ]
    # NaN is wrong, too.
    wrong = np.flatnonzero(~near & ~(residuals <= _TIMES * middle))
    names = [f"{control.marks[i].point} in {control.marks[i].view}" for i in wrong]
    return named(names, "mark", "far from where the pose shows its point, to be checked")


def checkpoint_findings(
    checkpoints: Sequence[Checkpoint], views: Sequence[View], water: FlatWater | None, departure: Departure | None
) -> Findings:
    """What check points no photograph shows by its pose, a warning if none is shown or heights of all may be depths."""
    if not checkpoints:
        return Findings()
    places = np.array([point.local for point in checkpoints])
    above = np.full(len(places), np.inf) if water is None else height_above(water, departure, places)
    wet, seen = above < 0.0, np.zeros(len(places), bool)
    for view in views:
        for part, over in ((wet, plane_under(water, departure, view.camera.centre)), (~wet, None)):
            if part.any():
                seen[part] |= view.camera.sees(view.camera.project(places[part], over))
    unseen = [point.name for point, is_seen in zip(checkpoints, seen, strict=True) if not is_seen]
    said = tuple(named(unseen, "check point", "that no photograph shows, so that nothing is compared with it"))
    # A line of photons passes over more than the flight; that lowers no verdict on the rest.
    findings = Findings(warnings=said) if len(unseen) == len(places) else Findings(assumptions=said)
    if water is None:
        return findings
    flying = float(np.median(height_above(water, departure, np.array([view.camera.centre for view in views]))))
    if (above > 0.0).all() or (above < -_DEEP * flying).all():
        side = "over" if above[0] > 0.0 else "under"
        low, high = np.sort(np.abs(above))[[0, -1]]
        message = (
            f"all {len(above)} check points lie {side} the water, by {length(low)} to {length(high)}: if their heights "
            "are depths, call the column depth; if they are not, check the level of the water and its sign"
        )
        findings += Findings(warnings=(message,))
    return findings


def read_ground(
    folder: Path,
    config: SurveyConfig,
    frame: LocalFrame,
    places: np.ndarray,
    above_water: Callable[[np.ndarray], np.ndarray] | None,
    *,
    is_level_known: bool,
) -> tuple[StableGround | None, Findings]:
    """The stable dry ground of the reference; None without a reference.

    ``places`` (N, 3) [m], local, are cameras and tie points; ``above_water`` gives heights (K,) [m] of places (K, 3).
    """
    given = config.control
    if given.reference is None:
        return None, Findings()
    if above_water is not None and not is_level_known and given.stable is None:
        raise ControlError(
            "[control] reference: the level of the water is not given, so that nothing tells which ground of "
            f"{given.reference} is dry; give level_m, or polygons of stable ground in [control] stable"
        )
    path = folder / given.reference
    cloud, way_std, findings = _in_crs(path, frame.crs)
    num_all = len(cloud.points)
    if given.stable is not None:
        polygons = read_polygons(folder / given.stable, frame.crs, plan_box(cloud.points)).values()
        current().note(*assumed_crs(folder / given.stable))
        inside = points_inside(polygons, cloud.points[:, :2])
        if not inside.any():
            raise ControlError(f"no point of {path} lies in the polygons of {given.stable}; correct them or their CRS")
        cloud = masked_cloud(cloud, inside)
    cloud = _near(cloud, frame, places)
    local = frame.local_from_crs(cloud.points)
    dry = np.ones(len(local), dtype=bool)
    if above_water is not None and is_level_known:
        level_std = config.water.level_std_m if config.water is not None else None
        dry = above_water(local) > max(_LEAST_ABOVE_M, _LEAST_SIGMAS * (level_std or 0.0))
    if dry.sum() < _FEWEST:
        raise ControlError(
            f"{path} has {int(dry.sum())} points of dry ground near the photographs, expected at least {_FEWEST} "
            f"(of {num_all} points, {len(local)} are near the photographs); give a reference of the bank or of rocks "
            "over the water, in the vertical datum of crs"
        )
    std, of_std = _shared_std(given.reference_std_m, masked_cloud(cloud, dry), given.reference)
    across, up = np.hypot(std, way_std).tolist()
    return StableGround(local[dry], (across, up)), findings + of_std


def _near(cloud: Cloud, frame: LocalFrame, places: np.ndarray) -> Cloud:
    """Points of a cloud near places (N, 3) [m], local; a sample of `_MOST_POINTS` where there are more."""
    middle = np.median(places, axis=0)
    x, y = _REACH * np.maximum(np.abs(places - middle).max(axis=0)[:2], 1.0)
    # Corners give the box in units of the map.
    around = frame.crs_from_local(middle + np.array([[-x, -y, 0.0], [-x, y, 0.0], [x, -y, 0.0], [x, y, 0.0]]))
    low, high = around.min(axis=0)[:2], around.max(axis=0)[:2]
    cloud = masked_cloud(cloud, ((cloud.points[:, :2] >= low) & (cloud.points[:, :2] <= high)).all(axis=1))
    if len(cloud.points) <= _MOST_POINTS:
        return cloud
    keep = np.zeros(len(cloud.points), dtype=bool)
    keep[np.random.default_rng(0).choice(len(keep), _MOST_POINTS, replace=False)] = True
    return masked_cloud(cloud, keep)


def _in_crs(path: Path, crs: CRS) -> tuple[Cloud, tuple[float, float], Findings]:
    """The ground of a file in the crs of the survey, the accuracy of the operation [m], and what was assumed."""
    shape = read_reference(path)
    if isinstance(shape, Mesh):
        shape = Cloud(points=vertices_of(shape), crs=shape.crs, height_unit_m=shape.height_unit_m)
    cloud, notes = ground_of(shape, path.name)
    own, unit_m = cloud.crs, height_unit_m(crs)
    if own is None or not has_height(own):
        of = "its CRS" if own is None else "what its heights count from"
        notes = (*notes, f"{path.name} does not say {of}: taken to be that of the survey")
    if own is not None and not has_height(own):
        vertical = vertical_crs(crs)
        own = own.to_3d() if vertical is None else CompoundCRS(f"{own.name} + {vertical.name}", [own, vertical])
    if own is None or crs_difference(own, crs) is None:
        if own is not None:
            cloud = replace(cloud, points=cloud.points * [1.0, 1.0, height_unit_m(own) / unit_m])
        return in_height_unit(cloud, unit_m), (0.0, 0.0), Findings(tuple(notes))
    if cloud.height_unit_m is not None:
        cloud = replace(cloud, points=cloud.points * [1.0, 1.0, cloud.height_unit_m / height_unit_m(own)])
    reprojection = Reprojection.between(own, crs, where=f"the CRS of {path}", places=cloud.points)
    accuracy_m = Transformation.between(own, reprojection.crs, cloud.points).accuracy_m or 0.0
    cloud = replace(cloud, points=reprojection(cloud.points), crs=crs)
    warnings = () if reprojection.warning is None else (reprojection.warning,)
    return cloud, (accuracy_m, reprojection.height_std_m), Findings(tuple(notes), warnings)


def _shared_std(
    given: float | tuple[float, float] | None, cloud: Cloud, name: str
) -> tuple[tuple[float, float], Findings]:
    """Standard deviation of a shift of the reference: as given, as the cloud carries it, or assumed."""
    if given is not None:
        return given if isinstance(given, tuple) else (given, given), Findings()
    carried = cloud.extra.get("std_common")
    if carried is not None and np.isfinite(carried).any():
        std = float(np.nanmedian(carried))
        return (std, std), Findings((f"[control] reference_std_m = {std:.2g}, the std_common of {name}",))
    message = (
        f"no accuracy is stated for {name}: {REFERENCE_STD_M:g} m in common is assumed; give [control] "
        "reference_std_m, e.g. 0.05, or [0.1, 0.05] horizontally and vertically"
    )
    return (REFERENCE_STD_M, REFERENCE_STD_M), Findings(warnings=(message,))
