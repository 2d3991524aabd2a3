"""Keys of survey.toml that have no effect beside what else a survey has, each with its condition: one table."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from refract.lens import MODELS, Lens, coefficients_of
from survey.errors import FILE_NAME
from survey.files.toml_table import table_of
from survey.photos.exif import Exif
from survey.photos.poses import PoseFrame
from survey.settings.config import SurveyConfig

# Of a focal length and a principal point that are given and those of the poses file, as a share.
_SAME = 0.01


@dataclass(frozen=True)
class Circumstances:
    """What decides which keys are read."""

    config: SurveyConfig
    headers: Mapping[str, Exif]
    poses: str | None = None  # name of the poses file; None where poses are found from the photographs
    frame: PoseFrame | None = None  # of these poses, as they are used
    is_placed_by_gps: bool = False  # whether GPS positions place the poses of the file
    lens: Lens | None = None  # of the first pose of the file; None where the file has none
    has_other_poses: bool = False  # whether the folder has more files of poses, whose keys may be there, too


def conditions(given: Circumstances) -> dict[str, str | None]:
    """By the name of a key: why it has no effect, or None where it has one."""
    poses, frame, motions = given.poses, given.frame, [header.motion for header in given.headers.values()]
    has_own_heights = poses is not None and not given.is_placed_by_gps and frame is not PoseFrame.GEOCENTRIC
    rotation_std = speed = origin = None
    if given.is_placed_by_gps:
        rotation_std = "GPS positions place the poses, and with them their rotations"
    elif poses is None and all(motion.gimbal_deg is None for motion in motions):
        rotation_std = (
            "it is that of poses of a file or attitudes in XMP, and there are none; remove it, or name [cameras] poses"
        )
    if not given.config.cameras.rolls:
        speed = "rolling_shutter_s = 0 says that all rows are exposed at once"
    elif all(motion.velocity is not None for motion in motions):
        speed = "XMP tells how fast the camera flew"
    if poses is None:
        origin = "it is that of poses in a local frame, and there is no file of poses"
    elif frame is not PoseFrame.LOCAL and not given.has_other_poses:
        origin = f"the poses of {poses} have a place of their own"
    control = None if given.config.control.gcp_files else "there are no control points ([control] gcps)"
    return {
        "cameras.gps_height": f"it is that of GPS positions, and the cameras have the heights of {poses}"
        if has_own_heights
        else None,
        "cameras.mapper": None if poses is None else f"the poses are those of {poses}",
        **_of_lens(given),
        "cameras.rotation_std_deg": rotation_std,
        "cameras.speed_m_s": speed,
        "local.origin": origin,
        "control.std_m": control,
        "control.marks_std_px": control,
    }


def _of_lens(given: Circumstances) -> dict[str, str | None]:
    """Keys of a lens beside that of the poses file, which has no effect only where it is another."""
    names = ("model", "size_px", "focal_px", "principal_point_px", "distortion")
    lens, reasons = given.lens, dict[str, str | None]()
    for name in names:
        value, reasons[f"cameras.{name}"] = getattr(given.config.cameras, name), None
        if lens is None or value is None:
            continue
        by_name = dict(zip(MODELS[lens.model][1], lens.params, strict=True))
        own = {
            "model": lens.model,
            "size_px": (lens.width, lens.height),
            "focal_px": lens.focal,
            "principal_point_px": (by_name["cx"], by_name["cy"]),
            "distortion": tuple(by_name[part] for part in coefficients_of(lens.model)),
        }[name]
        is_same = value == own
        if name in ("focal_px", "principal_point_px"):
            values = value if isinstance(value, tuple) else (value, value)
            is_same = all(abs(a / b - 1.0) <= _SAME for a, b in zip(values, own, strict=True))
        if not is_same:
            size = f"{lens.width} x {lens.height} px, focal length {lens.focal[0]:.1f} px"
            reasons[f"cameras.{name}"] = f"{given.poses} has a lens of its own ({lens.model}, {size})"
    return reasons


def unused_keys(given: Circumstances) -> tuple[str, ...]:
    """Warnings about keys that are given, not with their default, and have no effect."""
    values, defaults = table_of(given.config), table_of(SurveyConfig())
    reasons: dict[str, list[str]] = {}
    for key, reason in conditions(given).items():
        table, name = key.split(".")
        value = values[table][name]
        if reason is not None and value != defaults[table][name]:
            shown = list(value) if isinstance(value, tuple) else value
            reasons.setdefault(reason, []).append(f"[{table}] {name} = {shown}")
    return tuple(f"{' and '.join(keys)} in {FILE_NAME} has no effect: {why}" for why, keys in reasons.items())
