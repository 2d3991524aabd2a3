"""Tables of poses: positions in crs, and omega, phi, kappa or yaw, pitch, roll in degrees.

Omega, phi and kappa count about the grid axes at the camera, yaw from true north, that of RealityCapture from grid
north. cameras.csv is such a table.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from pyproj import CRS

from survey.errors import PosesError
from survey.files.crs_lines import crs_of_comment
from survey.files.csv_table import Row, Table, column_names, text_lines, words_of
from survey.photos.poses import GivenPosition, Pose, PoseFile, PoseFrame
from survey.photos.rotations import CAM_FROM_OPK_CAM, enu_from_yaw_pitch_roll, grid_from_opk
from survey.pose_files.format import Format, is_lens_key

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


def is_opk_csv(path: Path) -> bool:
    """Whether the first line of a file has the columns of a table of poses."""
    return _columns(column_names(path, _WORDS)) is not None


def read_opk_csv(path: Path) -> PoseFile:
    """Poses in crs from a table with the columns of `COLUMNS` or their like, in any order; others are not read.

    Columns longitude and latitude are those of WGS 84, unless a comment names the CRS, as Metashape writes it. Where
    there are columns of the accuracy of positions, these are how well the positions are known.
    """
    table = Table.read(path, _WORDS, PosesError)
    columns = _columns(table.names) or dict(zip(COLUMNS, COLUMNS, strict=True))
    names, units = tuple(columns.values()), table.units
    rows = table.rows(names, ("std", *_STDS))
    poses = [_pose(row, names, units) for row in rows]
    of_lens = [column.cell for column in table.columns if is_lens_key(column.cell)]
    warning = f"columns of a lens in {path.name} ({', '.join(of_lens[:10])}) are not read: give it in [cameras]"
    warnings = (warning,) if of_lens else ()
    crs = crs_of_comment(path, PosesError) or (CRS("EPSG:4326") if names[1] == "longitude" else None)
    height_m, plan_m = units.get(names[3]), table.common_unit_m(names[1], names[2])
    frame, notes = PoseFrame.GRID, tuple[str, ...]()
    if "omega" not in columns:
        is_of_gimbal = "gimbal_yaw" in columns
        pitches = [row.number(names[5]) for row in rows]
        if not is_of_gimbal and pitches and np.median(pitches) < 0.5 * _GIMBAL_DOWN_DEG:
            raise PosesError(
                f"{path}: the pitch is {np.median(pitches):.0f} degrees (median), expected 0 for straight down; if it "
                "is that of a gimbal, call the columns gimbal_yaw, gimbal_pitch, gimbal_roll"
            )
        # RealityCapture's table counts its heading from the north of the grid that it exports.
        head = next((line.casefold() for _, line in text_lines(path, PosesError) if line.strip()), "")
        is_of_grid = head.startswith("#name") and "heading" in head
        frame = PoseFrame.GRID if is_of_grid else PoseFrame.ENU
        north = "grid north, as RealityCapture writes it" if is_of_grid else "true north, not from the grid's"
        down = "-90 looks" if is_of_gimbal else "0 looks"
        notes = (f"yaw in {path.name} counts from {north}, and a pitch of {down} straight down",)
    return PoseFile(
        tuple(poses),
        frame,
        crs,
        notes=notes,
        warnings=warnings,
        height_unit_m=height_m,
        plan_unit_m=plan_m,
    )


def _columns(names: Sequence[str]) -> dict[str, str] | None:
    """Names of the columns of a pose in a table; None where they are not all there."""
    found = set(names)
    estimated = all(_ESTIMATED[name] in found for name in _PLACE)
    place = [_ESTIMATED[name] if estimated else name for name in _PLACE]
    if not estimated and not set(place) <= found:
        place = ["longitude", "latitude", "height"]
    for angles in (_OPK, _YPR, _GIMBAL):
        angle_columns = [_ESTIMATED.get(name, name) if estimated else name for name in angles]
        if {"image", *place, *angle_columns} <= found:
            return dict(zip(("image", *_PLACE, *angles), ("image", *place, *angle_columns), strict=True))
    return None


def _pose(row: Row, names: tuple[str, ...], units: Mapping[str, float]) -> Pose:
    e, n, h, *degrees = (row.number(name) for name in names[1:])
    angles = [math.radians(angle) for angle in degrees]
    centre = np.array([e, n, h])
    if names[4].startswith("omega"):
        world_from_cam = grid_from_opk(*angles) @ CAM_FROM_OPK_CAM
    else:
        lift = math.radians(_GIMBAL_DOWN_DEG) if names[4] == "gimbal_yaw" else 0.0
        world_from_cam = enu_from_yaw_pitch_roll(angles[0], angles[1] - lift, angles[2])
    return Pose(row.text("image"), centre, world_from_cam.T, given=_given(row, centre, units), where=row.where)


def _given(row: Row, centre: np.ndarray, units: Mapping[str, float]) -> GivenPosition | None:
    stds = [row.cells.get(name) or row.cells.get("std") for name in _STDS]
    if any(not std for std in stds):
        return None
    std_columns = [name if row.cells.get(name) else "std" for name in _STDS]
    values = np.array([row.number(name) * units.get(name, 1.0) for name in std_columns])
    if not (values > 0.0).all():
        raise PosesError(f"{row.where}: the accuracy is {values.tolist()}, expected above 0; correct it")
    return GivenPosition(centre, values)


FORMAT = Format(
    name="a table image,easting,northing,height,omega,phi,kappa, or with yaw,pitch,roll (.csv)",
    find=lambda folder: sorted(path for path in folder.glob("*.csv") if is_opk_csv(path)),
    recognises=lambda path: path.is_file() and (path.suffix.lower() == ".csv" or is_opk_csv(path)),
    read=read_opk_csv,
)
