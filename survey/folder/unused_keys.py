"""Keys of survey.toml that have no effect beside what else a survey has, each with its condition: one table."""

from __future__ import annotations

from collections.abc import Callable, Mapping
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


def _of_gps_height(given: Circumstances) -> str | None:
    if given.poses is None or given.is_placed_by_gps or given.frame is PoseFrame.GEOCENTRIC:
        return None
    return f"it is that of GPS positions, and the cameras have the heights of {given.poses}"


def _of_mapper(given: Circumstances) -> str | None:
    return None if given.poses is None else f"the poses are those of {given.poses}"


def _of_lens(name: str) -> Callable[[Circumstances], str | None]:
    def reason(given: Circumstances) -> str | None:
        lens, value = given.lens, getattr(given.config.cameras, name)
        if lens is None:
            return None
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
        size = f"{lens.width} x {lens.height} px, focal length {lens.focal[0]:.1f} px"
        return None if is_same else f"{given.poses} has a lens of its own ({lens.model}, {size})"

    return reason


def _of_rotation_std(given: Circumstances) -> str | None:
    if given.is_placed_by_gps:
        return "GPS positions place the poses, and with them their rotations"
    if given.poses is not None or any(header.motion.gimbal_deg is not None for header in given.headers.values()):
        return None
    return "it is that of poses of a file or attitudes in XMP, and there are none; remove it, or name [cameras] poses"


def _of_speed(given: Circumstances) -> str | None:
    if not given.config.cameras.rolls:
        return "rolling_shutter_s = 0 says that all rows are exposed at once"
    knows_all = all(header.motion.velocity is not None for header in given.headers.values())
    return "XMP tells how fast the camera flew" if knows_all else None


def _of_origin(given: Circumstances) -> str | None:
    if given.poses is None:
        return "it is that of poses in a local frame, and there is no file of poses"
    if given.frame is PoseFrame.LOCAL or given.has_other_poses:
        return None
    return f"the poses of {given.poses} have a place of their own"


def _of_control(given: Circumstances) -> str | None:
    return None if given.config.control.gcp_files else "there are no control points ([control] gcps)"


# By the name of the key: why it has no effect, or None where it has one.
CONDITIONS: dict[str, Callable[[Circumstances], str | None]] = {
    "cameras.gps_height": _of_gps_height,
    "cameras.mapper": _of_mapper,
    **{f"cameras.{name}": _of_lens(name) for name in ("model", "size_px", "focal_px", "principal_point_px")},
    "cameras.distortion": _of_lens("distortion"),
    "cameras.rotation_std_deg": _of_rotation_std,
    "cameras.speed_m_s": _of_speed,
    "local.origin": _of_origin,
    "control.std_m": _of_control,
    "control.marks_std_px": _of_control,
}


def unused_keys(given: Circumstances) -> tuple[str, ...]:
    """Warnings about keys that are given, not with their default, and have no effect."""
    values, defaults = table_of(given.config), table_of(SurveyConfig())
    reasons: dict[str, list[str]] = {}
    for key, condition in CONDITIONS.items():
        table, name = key.split(".")
        value = values[table][name]
        if value != defaults[table][name] and (reason := condition(given)) is not None:
            shown = list(value) if isinstance(value, tuple) else value
            reasons.setdefault(reason, []).append(f"[{table}] {name} = {shown}")
    return tuple(f"{' and '.join(keys)} in {FILE_NAME} has no effect: {why}" for why, keys in reasons.items())
