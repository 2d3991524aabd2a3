"""Cameras as Metashape exports them to XML: poses in the coordinates of a chunk, which a transform sets on the Earth.

The world of a georeferenced chunk is geocentric, on the datum of the chunk's reference, whatever its map is.

Metashape counts the principal point from the middle of the image, writes p1 and p2 in the other order than OpenCV, adds
b1 to the horizontal focal length, and shears columns by b2 (its manual, Camera models).
"""

import math
from collections.abc import Iterator
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from pyproj import CRS

from refract.lens import Lens, LensError
from survey.display.quantities import distance_text, named
from survey.errors import PosesError
from survey.files.csv_table import number_of
from survey.files.foreign_text import crs_of_chunk, read_chunk
from survey.photos.poses import GivenPosition, Pose, PoseFile, PoseFrame, is_rotation, nearest_rotation
from survey.pose_files.format import Format, brown_lens, numbers_in, require_understood

# What is read of a calibration, and when it was made.
_READ = ("resolution", "f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "date")
_FISHEYE = ("fisheye", "equidistant_fisheye", "fisheye_equidistant")
# What a fisheye lens here has no place for may move no pixel by more than this.
_LOST_PX = 0.02
_REMEDY = "export the cameras to COLMAP's format from Metashape (undistorted), or calibrate without it"
_EXPORT = "in Metashape, File > Export > Export Cameras writes it again"
# A rotation is written with 16 digits.
_ROUNDED = 1e-6
# Nothing on Earth is nearer to its centre than this [m]; a chunk in local coordinates lies near its own zero.
_UNDERGROUND_M = 6.2e6


def read_lens(sensor: Element) -> Lens:
    """The adjusted lens of a sensor, else the one that it began with."""
    by_class = {tag.get("class", "adjusted"): tag for tag in sensor.iterfind("calibration")}
    calibration = by_class.get("adjusted", by_class.get("initial"))
    if calibration is None:
        raise LensError("there is no calibration; align the photos, and export the cameras again")
    kind = (calibration.get("type") or sensor.get("type") or "frame").casefold()
    size = calibration.find("resolution")
    size = sensor.find("resolution") if size is None else size
    if size is None:
        raise LensError("there is no resolution; export the cameras again")
    width, height = (_whole(size.get(key), key) for key in ("width", "height"))
    f, b1, b2 = (_number(calibration, key) for key in ("f", "b1", "b2"))
    cx, cy = 0.5 * width + _number(calibration, "cx"), 0.5 * height + _number(calibration, "cy")
    k1, k2, k3, k4 = (_number(calibration, key) for key in ("k1", "k2", "k3", "k4"))
    p1, p2 = _number(calibration, "p2"), _number(calibration, "p1")
    parts = {tag.tag: tag.text or "" for tag in calibration}
    require_understood(parts, _READ, remedy=_REMEDY, are_all_of_lens=True)
    if kind in _FISHEYE:
        reach = math.hypot(width, height) / f if f > 0.0 else math.inf
        lost = 0.5 * abs(b2) * reach + 0.75 * f * max(abs(p1), abs(p2)) * reach**2
        if lost > _LOST_PX:
            raise LensError(f"p1, p2, b2 of a fisheye move pixels by {lost:.2g} px, expected none; {_REMEDY}")
        return Lens("OPENCV_FISHEYE", (f + b1, f, cx, cy, k1, k2, k3, k4), width, height)
    if kind != "frame":
        raise LensError(f"a lens of the type {kind} is not supported, expected frame or fisheye; {_REMEDY}")
    shear = 0.0 if not b2 else b2 / (f + b1) if f + b1 else math.nan
    return brown_lens((f + b1, f, cx, cy, k1, k2, p1, p2), (width, height), k3=k3, k4=k4, shear=shear)


def _number(calibration: Element, key: str) -> float:
    """A number of a calibration; what is left out is zero."""
    text = (calibration.findtext(key) or "0").strip()
    value = number_of(text)
    if not math.isfinite(value):
        raise LensError(f"{key} is {text}, expected a finite number; export the cameras again")
    return value


def _whole(text: str | None, key: str) -> int:
    if text is None or not text.isdecimal() or len(text) > 9:
        raise LensError(f"its {key} is {text or 'missing'}, expected whole pixels; export the cameras again")
    return int(text)


def read_metashape(path: Path) -> PoseFile:
    """Poses and lenses of the cameras that are aligned and enabled."""
    chunk = read_chunk(path, "camera/transform", "aligned cameras", PosesError)
    sensors = {sensor.get("id", ""): sensor for sensor in chunk.iter("sensor")}
    lenses: dict[str, Lens] = {}
    transforms = _transforms(chunk, path)
    crs = crs_of_chunk(chunk, "cameras", path, PosesError)
    poses: list[Pose] = []
    disabled, unplaced, nameless, components = [], [], [], set()
    # Of a series in time: other photographs of the same cameras.
    of_frames = {photo for frames in chunk.iter("frames") for photo in frames.iter("camera")}
    for camera in chunk.iter("camera"):
        if camera in of_frames:
            continue
        photo, matrix = camera.find("photo"), camera.find("transform")
        name = (camera.get("label") or "").strip() or ("" if photo is None else photo.get("path", "").strip())
        if not name:
            nameless.append(f"id {camera.get('id', 'missing')}")
            continue
        if not _is_true(camera.get("enabled")):
            disabled.append(name)
            continue
        component = _component_of(camera, transforms)
        if matrix is None or component not in transforms:
            unplaced.append(name)
            continue
        where = f'{path}, camera "{name}"'
        number = camera.get("sensor_id", "")
        if (sensor := sensors.get(number)) is None:
            raise PosesError(f"{where}: its sensor is not in the file; {_EXPORT}")
        try:
            lens = lenses.setdefault(number, lenses.get(number) or read_lens(sensor))
        except LensError as error:
            raise PosesError(f'{where}, sensor "{sensor.get("label", "")}": {error}') from error
        given = _given(camera, sensor, where, crs)
        poses.append(_pose(name, matrix, transforms[component], lens, given, where))
        components.add(component)
    if not poses:
        if nameless:
            raise PosesError(f"{path}: no aligned camera has a label, expected the name of its image; {_EXPORT}")
        raise PosesError(
            f"{path} has no camera that is enabled, aligned and georeferenced; align the photos, set the reference of "
            f"the chunk and update it, then {_EXPORT}"
        )
    warnings = (
        *named(disabled, "camera", f"disabled in {path.name}, left out"),
        *named(unplaced, "camera", f"not aligned in {path.name}, left out"),
        *named(nameless, "camera", f"without a label in {path.name}, left out"),
        *_warnings(chunk, path, num_components=len(components)),
    )
    nearest_m = min(float(np.linalg.norm(pose.centre)) for pose in poses)
    is_earth = nearest_m > _UNDERGROUND_M
    if crs is not None and not is_earth:
        raise PosesError(
            f"{path}: its chunk has the reference {crs.name}, but a camera lies {distance_text(nearest_m)} from "
            "the centre of the Earth; update the reference in Metashape, and export the cameras again"
        )
    frame = PoseFrame.GEOCENTRIC if is_earth else PoseFrame.LOCAL
    return PoseFile(tuple(poses), frame, crs, "Metashape", warnings=warnings)


def _warnings(chunk: Element, path: Path, *, num_components: int) -> Iterator[str]:
    if num_components > 1:
        yield (
            f"{path.name} has a block in {num_components} components that no tie point joins; they fit each other "
            "only as their references do: align them together, or export one alone"
        )
    num_frames = len(chunk.findall("frames/frame"))
    if num_frames > 1:
        yield (
            f"{path.name} has {num_frames} frames, photographs of the same cameras at other times: the poses are those "
            "of the photographs that the labels of the cameras name"
        )
    if any(_is_true(tag.text, default="true") for tag in chunk.iter("rolling_shutter")):
        yield (
            f"Metashape compensated a rolling shutter in {path.name}: its poses are those of the middle of each "
            "exposure, and rows count as exposed at once unless [cameras] rolling_shutter_s gives the readout"
        )


def _transforms(chunk: Element, path: Path) -> dict[str, np.ndarray]:
    """World from chunk (4, 4) of each component by its id; that of the chunk itself as "", where it has one."""
    parts = {"": chunk} | {part.get("id", ""): part for part in chunk.iterfind("components/component")}
    return {
        key: _similarity(transform, f"{path}, the transform of {'component ' + key if key else 'the chunk'}")
        for key, part in parts.items()
        if (transform := part.find("transform")) is not None
    }


def _component_of(camera: Element, transforms: dict[str, np.ndarray]) -> str | None:
    """The key of the transform of a camera; files of old versions have that of the chunk only."""
    own = camera.get("component_id")
    if own is None and "" not in transforms and len(transforms) == 1:
        return next(iter(transforms))
    # A component without a transform of its own has that of the chunk, if there is one.
    return own if own in transforms else ""


def _similarity(transform: Element, where: str) -> np.ndarray:
    rotation, translation, scale = (transform.find(key) for key in ("rotation", "translation", "scale"))
    if rotation is None:
        return _numbers(transform, 16, where).reshape(4, 4)
    matrix, size = np.eye(4), 1.0 if scale is None else float(_numbers(scale, 1, where)[0])
    # What overflows is infinite, and refused as no rotation with a scale.
    with np.errstate(over="ignore"):
        matrix[:3, :3] = size * _numbers(rotation, 9, where).reshape(3, 3)
    if translation is not None:
        matrix[:3, 3] = _numbers(translation, 3, where)
    return matrix


def _pose(
    name: str, matrix: Element, world_from_chunk: np.ndarray, lens: Lens, given: GivenPosition | None, where: str
) -> Pose:
    chunk_from_cam = _numbers(matrix, 16, where).reshape(4, 4)
    # Numbers that overflow are not finite, and no rotation.
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        world_from_cam = world_from_chunk @ chunk_from_cam
        turn = world_from_cam[:3, :3] / np.cbrt(np.linalg.det(world_from_cam[:3, :3]))
    if not np.isfinite(world_from_cam).all() or not is_rotation(turn, _ROUNDED):
        raise PosesError(f"{where}: its transform is not a rotation with a scale; {_EXPORT}")
    return Pose(name, world_from_cam[:3, 3], nearest_rotation(turn).T, lens, given, where)


def _given(camera: Element, sensor: Element, where: str, crs: CRS | None) -> GivenPosition | None:
    """The position and its accuracy in the reference of a camera, where both are there and not of an antenna."""
    reference, antenna = camera.find("reference"), sensor.find("antenna")
    if crs is None or reference is None or not _is_true(reference.get("enabled")) or reference.get("x") is None:
        return None
    texts = [] if antenna is None else [text for tag in antenna for text in (tag.text or "").replace(",", " ").split()]
    stds = [reference.get(key) or reference.get("sxyz") for key in ("sx", "sy", "sz")]
    if None in stds or any(math.isfinite(offset) and offset != 0.0 for offset in map(number_of, texts)):
        return None
    values = numbers_in([*(reference.get(key, "") for key in "xyz"), *filter(None, stds)], 6, where, _EXPORT)
    if min(values[3:]) <= 0.0:
        raise PosesError(f"{where}: the accuracy of its reference is {values[3:]} m, expected above 0; {_EXPORT}")
    return GivenPosition(np.array(values[:3]), np.array(values[3:]))


def _numbers(element: Element, count: int, where: str) -> np.ndarray:
    return np.array(numbers_in((element.text or "").replace(",", " ").split(), count, where, _EXPORT))


def _is_true(text: str | None, default: str = "true") -> bool:
    return (text or default).strip().casefold() not in ("false", "0", "disabled", "none")


def is_metashape(path: Path) -> bool:
    """Whether a file of XML has cameras with poses; files of markers have cameras too, without them."""
    with path.open("rb") as file:
        _, cameras, after_cameras = file.read().partition(b"<cameras")
    return bool(cameras) and b"<transform>" in after_cameras


FORMAT = Format(
    name="the cameras of Metashape (.xml)",
    find=lambda folder: sorted(path for path in folder.glob("*.xml") if is_metashape(path)),
    recognises=lambda path: path.is_file() and path.suffix.casefold() == ".xml",
    read=read_metashape,
)
