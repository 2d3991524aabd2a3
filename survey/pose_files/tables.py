"""Tables and lines of poses: positions in crs, and omega, phi, kappa or yaw, pitch, roll in degrees.

Omega, phi and kappa count about the grid axes at the camera, yaw from true north, that of RealityCapture from grid
north. cameras.csv is such a table. Lines have a name, a position and omega, phi, kappa, as Metashape, BINGO and others
write them, in gon if a heading says so; Metashape adds the nine numbers of the rotation from the grid into photo axes,
which have to agree with the angles.
"""

import math
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from pyproj import CRS

from survey.errors import PosesError
from survey.files.csv_table import Row, Table, column_names, number_of, text_lines, words_of
from survey.files.foreign_text import crs_of_comment
from survey.photos import poses as pose_data
from survey.pose_files.format import Format, is_lens_key
from survey.words import GEO_TXT

COLUMNS = ("image", "easting", "northing", "height", "omega", "phi", "kappa")
_PLACE, _OPK = COLUMNS[1:4], COLUMNS[4:]
_YPR, _GIMBAL = ("yaw", "pitch", "roll"), ("gimbal_yaw", "gimbal_pitch", "gimbal_roll")
# As Metashape calls the poses that it found, beside the positions of its reference.
_ESTIMATED = {name: f"{name}_est" for name in (*_PLACE, *_OPK, *_YPR)}
_STDS = ("std_east", "std_north", "std_height")
_WORDS = words_of({
    "image": ("photo", "photograph", "file", "filename", "file_name", "imagename", "image_name", "name", "label",
              "camera", "photoid", "#label", "#name", "#image"),
    "easting": ("e", "east", "x", "x/easting", "x/east"), "northing": ("n", "north", "y", "y/northing", "y/north"),
    "longitude": ("lon", "long", "x/longitude"), "latitude": ("lat", "y/latitude"),
    "height": ("h", "z", "z/altitude", "z/height", "alt", "altitude", "elevation", "up"),
    "omega": ("om", "w"), "phi": ("ph", "p"), "kappa": ("ka", "k"),
    "yaw": ("heading", "azimuth"), "pitch": (), "roll": (),
    "gimbal_yaw": ("gimbalyawdegree", "gimbalyaw"), "gimbal_pitch": ("gimbalpitchdegree", "gimbalpitch"),
    "gimbal_roll": ("gimbalrolldegree", "gimbalroll"),
    "easting_est": ("x_est",), "northing_est": ("y_est",), "height_est": ("z_est",),
    "std": ("accuracy", "sigma", "std_position"), "std_east": ("std_e", "sx", "std_easting", "accuracy_x"),
    "std_north": ("std_n", "sy", "std_northing", "accuracy_y"), "std_height": ("std_h", "sz", "std_up", "accuracy_z"),
})  # fmt: skip
# A camera that looks straight down has this pitch by its gimbal, and 0 by the convention of photogrammetry.
_GIMBAL_DOWN_DEG = -90.0
_SUFFIXES = (".txt", ".dat", ".opk", ".eo")
_NUMBERS, _WITH_MATRIX = 6, 15
_ORDER = re.compile(r"\bx\b.*\by\b.*\bz\b.*\bomega\b.*\bphi\b.*\bkappa\b")
# Angles and matrix are written with six digits at least.
_AGREE = 1e-3
_EXPECTED = "expected name, x, y, z, omega, phi, kappa"


def is_table(path: Path) -> bool:
    """Whether the first line of a file has the columns of a table of poses."""
    return _columns(column_names(path, _WORDS)) is not None


def read_table(path: Path) -> pose_data.PoseFile:
    """Poses in crs from a table with the columns of `COLUMNS` or their like, in any order; others are not read.

    Columns longitude and latitude are those of WGS 84, unless a comment names the CRS, as Metashape writes it. Where
    there are columns of the accuracy of positions, these are how well the positions are known.
    """
    table = Table.read(path, _WORDS, PosesError)
    columns = _columns(table.names) or dict(zip(COLUMNS, COLUMNS, strict=True))
    names, units = tuple(columns.values()), table.units
    rows = table.rows(names, ("std", *_STDS))
    poses = [_pose_of_row(row, names, units) for row in rows]
    of_lens = [column.cell for column in table.columns if is_lens_key(column.cell)]
    warning = f"columns of a lens in {path.name} ({', '.join(of_lens[:10])}) are not read: give it in [cameras]"
    frame, notes = pose_data.PoseFrame.GRID, tuple[str, ...]()
    if "omega" not in columns:
        is_of_gimbal = "gimbal_yaw" in columns
        pitch = float(np.median([row.number(names[5]) for row in rows] or [0.0]))
        if not is_of_gimbal and pitch < 0.5 * _GIMBAL_DOWN_DEG:
            raise PosesError(
                f"{path}: the pitch is {pitch:.0f} degrees (median), expected 0 for straight down; if it is that of a "
                "gimbal, call the columns gimbal_yaw, gimbal_pitch, gimbal_roll"
            )
        # RealityCapture's table counts its heading from the north of the grid that it exports.
        head = next((line.casefold() for _, line in text_lines(path, PosesError) if line.strip()), "")
        is_of_grid = head.startswith("#name") and "heading" in head
        frame = pose_data.PoseFrame.GRID if is_of_grid else pose_data.PoseFrame.ENU
        north = "grid north, as RealityCapture writes it" if is_of_grid else "true north, not from the grid's"
        down = "-90 looks" if is_of_gimbal else "0 looks"
        notes = (f"yaw in {path.name} counts from {north}, and a pitch of {down} straight down",)
    return pose_data.PoseFile(
        tuple(poses),
        frame,
        crs_of_comment(path, PosesError) or (CRS("EPSG:4326") if names[1] == "longitude" else None),
        notes=notes,
        warnings=(warning,) if of_lens else (),
        height_unit_m=units.get(names[3]),
        plan_unit_m=table.common_unit_m(names[1], names[2]),
    )


def _columns(names: Sequence[str]) -> dict[str, str] | None:
    """Names of the columns of a pose in a table; None where they are not all there."""
    there = set(names)
    estimated = all(_ESTIMATED[name] in there for name in _PLACE)
    place = [_ESTIMATED[name] if estimated else name for name in _PLACE]
    if not estimated and not set(place) <= there:
        place = ["longitude", "latitude", "height"]
    for angles in (_OPK, _YPR, _GIMBAL):
        columns = ("image", *place, *(_ESTIMATED.get(name, name) if estimated else name for name in angles))
        if set(columns) <= there:
            return dict(zip(("image", *_PLACE, *angles), columns, strict=True))
    return None


def _pose_of_row(row: Row, names: tuple[str, ...], units: Mapping[str, float]) -> pose_data.Pose:
    *place, a, b, c = (row.number(name) for name in names[1:])
    centre, angles = np.array(place), [math.radians(angle) for angle in (a, b, c)]
    if names[4].startswith("omega"):
        world_from_cam = pose_data.grid_from_opk(*angles) @ pose_data.CAM_FROM_OPK_CAM
    else:
        lift = math.radians(_GIMBAL_DOWN_DEG) if names[4] == "gimbal_yaw" else 0.0
        world_from_cam = pose_data.enu_from_yaw_pitch_roll(angles[0], angles[1] - lift, angles[2])
    given, stds = None, [name if row.cells.get(name) else "std" for name in _STDS]
    if all(row.cells.get(name) for name in stds):
        values = np.array([row.number(name) * units.get(name, 1.0) for name in stds])
        if not (values > 0.0).all():
            raise PosesError(f"{row.where}: the accuracy is {values.tolist()}, expected above 0; correct it")
        given = pose_data.GivenPosition(centre, values)
    return pose_data.Pose(row.text("image"), centre, world_from_cam.T, given=given, where=row.where)


def read_lines(path: Path) -> pose_data.PoseFile:
    """Poses in crs from the lines of a file that are neither empty nor headings."""
    poses: list[pose_data.Pose] = []
    heading = ""
    for number, line in text_lines(path, PosesError):
        if _is_heading(line) and not poses:
            heading += line.casefold() + " "
        elif line.strip() and not line.lstrip().startswith("#"):
            is_gon = "gon" in heading.split() or "[gon]" in heading or "(gon)" in heading
            where = f"{path}, line {number}"
            poses.append(_pose_of_line(*_split(line, where), 0.9 if is_gon else 1.0, where))
    if heading.lstrip("# ").startswith(("epsg:", "+proj", "wgs84")):
        raise PosesError(
            f"{path} begins with a CRS, as OpenDroneMap's geo.txt does, whose angles are not poses: under the name "
            f"{GEO_TXT} its positions are used without being named; {_EXPECTED}"
        )
    return pose_data.PoseFile(
        tuple(poses), pose_data.PoseFrame.GRID, tool="Metashape" if "photoid" in heading else None
    )


def _pose_of_line(name: str, values: list[float], unit: float, where: str) -> pose_data.Pose:
    omega, phi, kappa = (unit * angle for angle in values[3:6])
    if max(abs(omega), abs(phi), abs(kappa)) > 360.0:
        raise PosesError(
            f"{where}: the angles are {values[3]:g}, {values[4]:g}, {values[5]:g}, expected degrees within 360; write "
            "gon into the heading if that is their unit"
        )
    grid_from_photo = pose_data.grid_from_opk(*(math.radians(angle) for angle in (omega, phi, kappa)))
    if len(values) == _WITH_MATRIX and not np.abs(np.reshape(values[6:], (3, 3)) - grid_from_photo.T).max() < _AGREE:
        raise PosesError(
            f"{where}: the nine numbers of its rotation are not those of omega, phi and kappa, expected the "
            "rotation from the grid into photo axes (x right, y up); export the cameras again as omega, phi, kappa"
        )
    return pose_data.Pose(name, np.array(values[:3]), (grid_from_photo @ pose_data.CAM_FROM_OPK_CAM).T, where=where)


def _split(line: str, where: str) -> tuple[str, list[float]]:
    """The name and the numbers of a line; names may hold spaces, and a number may stand before them."""
    cells = [cell.strip() for cell in line.rstrip().split("\t" if "\t" in line else None)]
    for count in (_WITH_MATRIX, _NUMBERS):
        values = [number_of(cell) for cell in cells[-count:]]
        if len(cells) > count and all(map(math.isfinite, values)):
            words = cells[:-count]
            if len(words) > 1 and words[0].isdecimal() and not math.isfinite(number_of(words[1])):
                words = words[1:]
            return " ".join(words), values
    raise PosesError(f'{where}: "{line.strip()}" was found, {_EXPECTED}; correct or remove the line')


def _is_heading(line: str) -> bool:
    """Whether a line has no number but those in a heading."""
    return line.lstrip().startswith("#") or sum(math.isfinite(number_of(cell)) for cell in line.split()) < 3


def _heading_of(path: Path) -> str | None:
    """The lines before the first pose, in lower case; None where a file has no lines of poses.

    A heading that names the angles in another order makes it a table.
    """
    heading = ""
    if path.is_file() and path.suffix.casefold() in _SUFFIXES:
        with suppress(PosesError):
            for _, line in text_lines(path, PosesError):
                if not _is_heading(line):
                    _split(line, "")
                    return heading if _ORDER.search(heading) or "omega" not in heading else None
                heading += line.casefold() + "\n"
    return None


def _find_lines(folder: Path) -> list[Path]:
    """Files of lines; other lists of positions have as many numbers, and no heading that names the angles."""
    paths = (path for path in folder.iterdir() if "calibrated_" not in path.name and path.name != GEO_TXT)
    return sorted(path for path in paths if "omega" in (_heading_of(path) or ""))


TABLE = Format(
    name="a table image,easting,northing,height,omega,phi,kappa, or with yaw,pitch,roll (.csv)",
    find=lambda folder: sorted(path for path in folder.glob("*.csv") if is_table(path)),
    recognises=lambda path: path.is_file() and (path.suffix.lower() == ".csv" or is_table(path)),
    read=read_table,
)
LINES = Format(
    name="lines of name, x, y, z, omega, phi, kappa (.txt, .dat, .opk, .eo)",
    find=_find_lines,
    recognises=lambda path: _heading_of(path) is not None,
    read=read_lines,
)
