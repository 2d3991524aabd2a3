"""`bathynerf profile`: the profiles of a file of lines, and what is written of them.

Tables, pictures and lines of text.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from geo.crs import crs_code, height_unit_m, is_geographic
from geo.files import write_whole
from geo.lines import read_lines
from geo.vectors import DxfLine, write_dxf
from survey.compare.canvas import save, write_title
from survey.display.palette import BLUE, INK, LAND, RED, WATER, WATER_LINE
from survey.display.quantities import length, share
from survey.files.outputs import ReadFiles, require_file
from survey.profile.profile import Bed, Profile
from survey.run.folder import RunDir

_PNG = b"\x89PNG"
# Width and height of the picture of one profile [inch]; pictures have so many at most.
_SIZE_IN = (10.0, 3.2)
MOST_DRAWN = 40
# A band of bed and standard deviation.
_SIGMAS = 2.0
COLUMNS = (
    "line", "distance_m", "easting", "northing", "bed", "std_m", "std_common_m", "points", "water", "depth_m",
    "reference", "error_m",
)  # fmt: skip


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
    """Profiles of a run or a cloud along the lines of a file.

    Parameters
    ----------
    path : str or Path
        Run folder, LAS, LAZ or COPC.
    lines : str or Path
        GeoJSON, GeoPackage, shapefile or DXF; a DXF is in the CRS of the cloud.
    step_m : [m], optional
        Between places; by default some spacings of the points.
    reference : str or Path, optional
        Mesh, GeoTIFF or points.
    csv_path, picture_path, dxf_path : str or Path, optional
        Where the table, the picture and the drawing go.

    Raises
    ------
    SurveyError, GeoError
        If a file cannot be read or written, or is of another place.
    """
    path, lines = Path(path), Path(lines)
    given = (reference, csv_path, picture_path, dxf_path)
    truth, table, picture, drawing = (None if each is None else Path(each) for each in given)
    read = ReadFiles.of(path if path.is_file() else None, lines, truth)
    if path.is_dir():
        read += RunDir(path).inputs()
    # A table that bathynerf wrote begins with its CRS.
    require_file("--csv", table, read, kind="a table of profiles", is_of_kind=lambda head: head[:2] in (b"# ", b""))
    require_file("--picture", picture, read, kind="a PNG", is_of_kind=lambda head: head[:4] in (_PNG, b""))
    require_file("--dxf", drawing, read, kind="a DXF", is_of_kind=lambda head: b"SECTION" in head[:64] or not head)
    bed = Bed(path, truth)
    found = [bed.along(line, step_m) for line in read_lines(lines, bed.crs)]
    if table is not None:
        write_csv(table, found)
    if picture is not None:
        write_picture(picture, found)
    if drawing is not None:
        write_dxf(drawing, drawn_lines(found), found[0].crs)
    return found


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
    text.write(f"# CoordinateSystem: {crs_code(crs) or crs.to_string()}\n")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    places = 9 if is_geographic(crs) else 4
    for profile in profiles:
        numbers = (
            (profile.distance, 3), (profile.places[:, 0], places), (profile.places[:, 1], places), (profile.bed, 4),
            (profile.std, 4), (profile.std_common, 4), (profile.num_points, 0), (profile.water, 4), (profile.depth, 4),
            (profile.reference, 4), (profile.error, 4),
        )  # fmt: skip
        columns = [[f"{value:.{digits}f}" if np.isfinite(value) else "" for value in v] for v, digits in numbers]
        writer.writerows([profile.name, *row] for row in zip(*columns, strict=True))
    with write_whole(path) as stream:
        stream.write(text.getvalue().encode())


def draw(profile: Profile, axes: Axes) -> None:
    """Draw bed, water, the band of two standard deviations and the reference into axes."""
    x, bed = profile.distance, profile.bed
    sigma = _SIGMAS * np.hypot(np.nan_to_num(profile.std), np.nan_to_num(profile.std_common))
    sigma = sigma / height_unit_m(profile.crs)
    # Not the band: at walls it is wide.
    heights = np.concatenate([bed, profile.water, profile.reference])
    heights = heights[np.isfinite(heights)]
    low, high = (float(heights.min()), float(heights.max())) if len(heights) else (0.0, 1.0)
    margin = 0.12 * max(high - low, 0.01)
    axes.set(xlim=(0.0, x[-1]), ylim=(low - margin, high + margin))
    if np.isfinite(profile.water).any():
        axes.fill_between(x, bed, profile.water, where=bed < profile.water, color=WATER, alpha=0.45, lw=0)
        axes.plot(x, profile.water, color=WATER_LINE, lw=1.0, label="water")
    axes.fill_between(x, bed, low - margin, color=LAND, lw=0)
    axes.fill_between(x, bed - sigma, bed + sigma, color=BLUE, alpha=0.35, lw=0, label="bed, two standard deviations")
    axes.plot(x, bed, color=INK, lw=1.2, label="bed")
    if np.isfinite(profile.reference).any():
        axes.plot(x, profile.reference, color=RED, lw=1.2, label="reference")
    unit = profile.crs.axis_info[2].unit_name
    axes.set(xlabel="distance along the line [m]", ylabel=f"height [{unit}]")
    write_title(axes, profile.name, subtitle_of(profile))
    axes.legend(loc="best", frameon=False, fontsize=8.5)


def figure_of(profiles: Sequence[Profile]) -> Figure:
    """A figure with an axes for each of the first profiles."""
    shown = profiles[:MOST_DRAWN]
    figure = Figure(figsize=(_SIZE_IN[0], _SIZE_IN[1] * len(shown)), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, profile in zip(figure.subplots(len(shown), squeeze=False)[:, 0], shown, strict=True):
        draw(profile, axes)
    return figure


def write_picture(path: Path, profiles: Sequence[Profile]) -> None:
    """Write the first profiles as PNG, one below the other."""
    save(figure_of(profiles), path)


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
