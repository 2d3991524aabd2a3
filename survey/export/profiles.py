"""`bathynerf profile`: profiles along the lines of a file, written as tables, pictures and DXF."""

import csv
import io
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from pyproj import CRS
from scipy.spatial import cKDTree

from evaluation import vertical_difference
from geo import Cloud, Mesh, read_cloud
from geo.crs import crs_code, has_height, height_unit_m, is_geographic
from geo.features import Line, assumed_crs, layer_of, read_lines
from geo.files import write_text
from geo.grid import plan_box
from geo.projection import ground_units_m
from geo.shapes import ground_of, in_height_unit, masked_cloud
from geo.vectors import DxfLine, Layer, geodataframe, write_dxf
from survey.compare.inputs import InputPaths, load_inputs
from survey.display.canvas import empty_figure, plain, save, unit_sign, write_title
from survey.display.palette import BLUE, INK
from survey.display.quantities import length, named, share
from survey.errors import SurveyError
from survey.export.bed_raster import LevelFit, round_side
from survey.export.export import cloud_of
from survey.files.paths import ReadFiles, is_png, require_file
from survey.progress import current
from survey.report.profile import draw_section
from survey.run.folder import RunDir

# A height is the median of the points within so many spacings of its place.
_SPACINGS = 2.0
# Between places along a line, where no distance is asked for, in spacings; at most so many places.
_STEP_SPACINGS, _MOST_PLACES = 4.0, 200_000
# Points whose neighbours tell the spacing.
_SAMPLE = 2000


@dataclass(frozen=True)
class Profile:
    """Heights along a line; arrays are over its places, NaN where nothing is known."""

    name: str
    crs: CRS  # Of places and heights
    distance: np.ndarray  # (K,) [m]: From the start of the line
    places: np.ndarray  # (K, 2), in crs
    bed: np.ndarray  # (K,), in the heights of crs: Median of the points near the place
    # std, std_common (K,) [m]: Standard deviation of a point there by its own errors, and by those common to all
    # heights; NaN where unknown
    std: np.ndarray
    std_common: np.ndarray
    num_points: np.ndarray  # (K,) int
    water: np.ndarray  # water, reference (K,), in the heights of crs: NaN for a dry survey, and without a reference
    reference: np.ndarray

    @property
    def depth(self) -> np.ndarray:
        """Depth of the bed below the water (K,) [m], negative above it."""
        return (self.water - self.bed) * height_unit_m(self.crs)

    def to_geopandas(self) -> Any:
        """A ``geopandas.GeoDataFrame`` of its places with the arrays as columns; GeoError without geopandas."""
        names = ("distance", "bed", "depth", "std", "std_common", "num_points", "water", "reference")
        columns = {name: list(getattr(self, name)) for name in names}
        return geodataframe(Layer(self.name, "Point", list(self.places), self.crs, columns))

    @property
    def error(self) -> np.ndarray:
        """Bed above the reference (K,) [m]."""
        return (self.bed - self.reference) * height_unit_m(self.crs)


class Bed:
    """A cloud of the bed (run folder, LAS, LAZ or COPC with a CRS), for queries by place.

    The optional reference is a mesh or cloud in the same CRS.
    """

    def __init__(self, path: Path, reference: Path | None = None):
        file = cloud_of(path)
        self._reference: Mesh | Cloud | None = None
        if reference is None:
            self._cloud, notes = ground_of(read_cloud(file), file)
            crs = self._cloud.crs
        else:
            inputs = load_inputs(InputPaths(file, reference), None)
            self._cloud, self._reference, crs = masked_cloud(inputs.cloud, inputs.inside), inputs.reference, inputs.crs
            notes = inputs.notes
        current().note(*notes)
        if crs is None:
            raise SurveyError(f"{file} names no CRS, which places the lines in it; give the run folder instead")
        self.crs = crs if has_height(crs) else crs.to_3d()
        # A file alone may give its heights in another unit than metres beside its CRS.
        self._cloud = in_height_unit(self._cloud, height_unit_m(self.crs))
        self._middle = self._cloud.points[:, :2].mean(axis=0)
        self._metres = ground_units_m(self.crs, self._middle)
        self._tree = cKDTree(self._plan(self._cloud.points[:, :2]))
        self._tree_of_reference: cKDTree | None = None

    @property
    def box(self) -> np.ndarray:
        """Lowest and highest corner (2, 2) of the cloud in plan, in crs."""
        return plan_box(self._cloud.points)

    def _plan(self, places: np.ndarray) -> np.ndarray:
        """Places (N, 2) in metres on the ground from the middle of the cloud."""
        return (places - self._middle) * self._metres

    @cached_property
    def spacing_m(self) -> float:
        """Distance of neighbouring points [m], median."""
        some = self._tree.data[:: len(self._tree.data) // _SAMPLE + 1]
        nearest = self._tree.query(some, k=2)[0][:, 1] if self._tree.n > 1 else np.empty(0)
        nearest = nearest[(nearest > 0.0) & np.isfinite(nearest)]
        if not len(nearest):
            raise SurveyError("all points of the cloud lie at one place, expected a bed with an extent")
        return float(np.median(nearest))

    @cached_property
    def _level(self) -> LevelFit | None:
        depth = self._cloud.extra.get("depth")
        points = self._cloud.points * [1.0, 1.0, height_unit_m(self.crs)]
        return None if depth is None else LevelFit.of(points, np.asarray(depth, dtype=np.float64))

    def along(self, line: Line, step_m: float | None = None) -> Profile:
        """The profile of a line, at places ``step_m`` apart; by default some spacings of the points."""
        if step_m is not None and not (math.isfinite(step_m) and step_m > 0.0):
            raise SurveyError(f"--step is {step_m:g}, expected metres between places, above 0, e.g. 0.5")
        corners = self._plan(line.corners)
        lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
        if not lengths[-1] > 0.0:
            raise SurveyError(f"the line {line.name} has no length, expected two different places at least")
        step = step_m if step_m is not None else max(_STEP_SPACINGS * self.spacing_m, lengths[-1] / _MOST_PLACES)
        if lengths[-1] / step > _MOST_PLACES * (1.0 + 1e-9):
            raise SurveyError(
                f"--step {step:g} makes more than {_MOST_PLACES:,} places along the {lengths[-1]:.0f} m of the line "
                f"{line.name}; give --step {round_side(lengths[-1] / _MOST_PLACES):g} or more"
            )
        # The last place is the end of the line.
        distance = np.append(np.arange(0.0, lengths[-1] - 1e-9 * step, step), lengths[-1])
        plan = np.column_stack([np.interp(distance, lengths, corner) for corner in corners.T])
        places, unit_m = plan / self._metres + self._middle, height_unit_m(self.crs)
        rows = self._tree.query_ball_point(plan, _SPACINGS * self.spacing_m)
        bed = _medians(self._cloud.points[:, 2], rows)
        return Profile(
            name=line.name,
            crs=self.crs,
            distance=distance,
            places=places,
            bed=bed,
            std=_medians(self._cloud.extra.get("std"), rows),
            std_common=_medians(self._cloud.extra.get("std_common"), rows),
            num_points=np.array([len(near) for near in rows]),
            water=np.full(len(places), np.nan) if self._level is None else self._level(places) / unit_m,
            reference=self._reference_heights(plan, bed),
        )

    def _reference_heights(self, plan: np.ndarray, bed: np.ndarray) -> np.ndarray:
        """Heights of the reference (K,) at places (K, 2) [m]: of a mesh near the bed (K,), of points their median."""
        shape = self._reference
        if shape is None:
            return np.full(len(plan), np.nan)
        if isinstance(shape, Cloud):
            self._tree_of_reference = self._tree_of_reference or cKDTree(self._plan(shape.points[:, :2]))
            near = self._tree_of_reference.query_ball_point(plan, _SPACINGS * self.spacing_m)
            return _medians(shape.points[:, 2], near)
        near_bed = np.where(np.isfinite(bed), bed, np.nanmedian(self._cloud.points[:, 2]))
        vertices, unit_m = self._plan(shape.vertices[:, :2]), height_unit_m(self.crs)
        surface = np.column_stack([vertices, shape.vertices[:, 2] * unit_m])
        above = vertical_difference(np.column_stack([plan, near_bed * unit_m]), surface, shape.faces)
        return near_bed - above / unit_m


def _medians(values: np.ndarray | None, rows: np.ndarray) -> np.ndarray:
    """Median of the values in each list of rows (K,); NaN where there is none."""
    if values is None:
        return np.full(len(rows), np.nan)
    parts = [values[near] for near in rows]
    return np.array([float(np.nanmedian(part)) if np.isfinite(part).any() else np.nan for part in parts])


# Width and height of the picture of one profile [inch]; pictures have so many at most.
_SIZE_IN = (10.0, 3.2)
MOST_DRAWN = 40
# A band of bed and standard deviation.
_SIGMAS = 2.0
COLUMNS = (
    "line", "distance_m", "easting", "northing", "bed", "std_m", "std_common_m", "points", "water", "depth_m",
    "reference", "error_m",
)  # fmt: skip
_HEAD = ",".join(COLUMNS).encode()


def profiles_along(
    path: str | Path,
    lines: str | Path,
    *,
    step_m: float | None = None,
    reference: str | Path | None = None,
    csv_path: str | Path | None = None,
    picture_path: str | Path | None = None,
    dxf_path: str | Path | None = None,
) -> list[Profile]:
    """Profiles of a run, LAS, LAZ or COPC along the lines of a file, at places ``step_m`` apart, written where asked.

    Lines are GeoJSON, GeoPackage, shapefile or DXF, which is in the CRS of the cloud; the step is by default some
    spacings of the points; the reference is a mesh, GeoTIFF or points. Raises SurveyError or GeoError if a file cannot
    be read or written, or is of another place.
    """
    path, lines = Path(path), Path(lines)
    given = (reference, csv_path, picture_path, dxf_path)
    truth, table, picture, drawing = (None if each is None else Path(each) for each in given)
    read = ReadFiles.of(path if path.is_file() else None, layer_of(lines)[0], truth)
    if path.is_dir():
        read += RunDir(path).inputs()
    require_file(
        "--csv", table, read, kind="a table of profiles", is_of_kind=lambda head: not head or head.startswith(_HEAD)
    )
    require_file("--picture", picture, read, kind="a PNG", is_of_kind=is_png)
    require_file("--dxf", drawing, read, kind="a DXF", is_of_kind=lambda head: b"SECTION" in head[:64] or not head)
    bed = Bed(path, truth)
    current().note(*assumed_crs(lines))
    profiles = [bed.along(line, step_m) for line in read_lines(lines, bed.crs, bed.box)]
    missed = [profile.name for profile in profiles if not profile.num_points.any()]
    if len(missed) == len(profiles):
        raise SurveyError(
            f"no line of {lines} runs over the cloud; draw the lines over it, and check that they are in the CRS that "
            "the file states (a drawing: that of the cloud, in its unit; GeoJSON without one: WGS 84)"
        )
    for text in named(missed, "line", f"of {lines.name} without a point of the cloud near it"):
        current().warn(text)
    if table is not None:
        write_csv(table, profiles)
    if picture is not None:
        write_picture(picture, profiles)
    if drawing is not None:
        write_dxf(drawing, drawn_lines(profiles), profiles[0].crs)
    return profiles


def drawn_lines(profiles: Sequence[Profile]) -> list[DxfLine]:
    """Bed, water and reference of profiles as lines in space, a layer for each; broken where nothing is known."""
    lines = []
    for profile in profiles:
        for layer, heights in (("bed", profile.bed), ("water", profile.water), ("reference", profile.reference)):
            places = np.column_stack([profile.places, heights])
            known = np.flatnonzero(np.isfinite(heights))
            pieces = np.split(known, np.flatnonzero(np.diff(known) > 1) + 1)
            lines += [DxfLine(f"{layer} {profile.name}", places[piece]) for piece in pieces if len(piece) > 1]
    return lines


def write_csv(path: Path, profiles: Sequence[Profile]) -> None:
    """Write all places of profiles as one table; what is not known is empty."""
    text = io.StringIO()
    crs = profiles[0].crs
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow((*COLUMNS, "crs"))
    # In the first row alone; programs take comments for rows.
    stated = itertools.chain([crs_code(crs) or crs.to_wkt()], itertools.repeat(""))
    places = 9 if is_geographic(crs) else 4
    for profile in profiles:
        numbers = (
            (profile.distance, 3), (profile.places[:, 0], places), (profile.places[:, 1], places), (profile.bed, 4),
            (profile.std, 4), (profile.std_common, 4), (profile.num_points, 0), (profile.water, 4), (profile.depth, 4),
            (profile.reference, 4), (profile.error, 4),
        )  # fmt: skip
        columns = [[f"{value:.{digits}f}" if np.isfinite(value) else "" for value in v] for v, digits in numbers]
        writer.writerows([profile.name, *row, next(stated)] for row in zip(*columns, strict=True))
    write_text(path, text.getvalue())


def draw(profile: Profile, axes: Axes) -> None:
    """Draw bed, water, the reference and a band of two standard deviations around the bed into axes."""
    x, bed = profile.distance, profile.bed
    sigma = _SIGMAS * np.hypot(np.nan_to_num(profile.std), np.nan_to_num(profile.std_common))
    sigma = sigma / height_unit_m(profile.crs)
    # Not the band: at walls it is wide.
    heights = np.concatenate([bed, profile.water, profile.reference])
    heights = heights[np.isfinite(heights)]
    low, high = (float(heights.min()), float(heights.max())) if len(heights) else (0.0, 1.0)
    margin = 0.12 * max(high - low, 0.01)
    axes.set(xlim=(0.0, x[-1]), ylim=(low - margin, high + margin))
    axes.fill_between(x, bed - sigma, bed + sigma, color=BLUE, alpha=0.35, lw=0, label="bed, two standard deviations")
    draw_section(axes, x, bed, profile.water, profile.reference)
    axes.set(xlabel="distance along the line [m]", ylabel=f"height [{unit_sign(profile.crs, 2)}]")
    write_title(plain(axes), profile.name, subtitle_of(profile))
    # Beside the title, where it hides nothing.
    axes.legend(frameon=False, fontsize=8.5, ncols=4, loc="lower right", bbox_to_anchor=(1.0, 1.07), labelcolor=INK)


def figure_of(profiles: Sequence[Profile]) -> Figure:
    """A figure with an axes for each profile, one below the other."""
    figure = empty_figure(_SIZE_IN[0], _SIZE_IN[1] * len(profiles))
    for axes, profile in zip(figure.subplots(len(profiles), squeeze=False)[:, 0], profiles, strict=True):
        draw(profile, axes)
    return figure


def write_picture(path: Path, profiles: Sequence[Profile], *, most: int = MOST_DRAWN) -> None:
    """Write profiles as PNG, of many the first; a warning says so."""
    if len(profiles) > most:
        current().warn(f"{path} shows the first {most} of {len(profiles)} profiles; --csv and --dxf hold all of them")
    save(figure_of(profiles[:most]), path)


def subtitle_of(profile: Profile) -> str:
    """A profile in one sentence."""
    known = np.isfinite(profile.bed)
    parts = [f"{profile.distance[-1]:.1f} m, bed known at {share(float(known.mean()))} of {len(known)} places"]
    if np.isfinite(profile.depth).any():
        deepest = int(np.nanargmax(profile.depth))
        parts.append(f"deepest {length(float(profile.depth[deepest]))} at {profile.distance[deepest]:.1f} m")
    error = profile.error[np.isfinite(profile.error)]
    if len(error):
        parts.append(f"bed over reference {length(float(error.mean()))} mean, {length(float(error.std()))} std")
    return "; ".join(parts)
