"""OpenSfM and OpenDroneMap: reconstruction.json, topocentric at reference_lla, with the tracks beside it.

At the end OpenDroneMap moves that file to reconstruction.topocentric.json, and writes another reconstruction.json in
grid coordinates, whose rotations hold grid scale and convergence: that one is never read.

Lenses come in pixels from the upper left corner.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from geo.projection import enu_from_geocentric, geocentric_from_geodetic
from refract.lens import Lens, LensError
from survey.errors import PosesError
from survey.files.foreign_text import finite_numbers, read_foreign_json
from survey.files.paths import begins_with
from survey.photos.poses import FileTies, Pose, PoseFile, PoseFrame
from survey.pose_files.format import Format, brown_lens, lens_number, lens_size, require_understood

_TOPOCENTRIC, _PLAIN, _GRID = "reconstruction.topocentric.json", "reconstruction.json", "reconstruction.geocoords.json"
_REFERENCE, _TRACKS = "reference_lla.json", "tracks.csv"
_EXPORT = "reconstruct it again with OpenSfM or OpenDroneMap"
# Semi-axes of WGS 84 [m].
_A, _B = 6378137.0, 6356752.314245179
_MASKS = "masks"
# The parameters of each projection besides focal lengths and principal point, in the order of our model.
_BROWN = ("k1", "k2", "p1", "p2", "k3")
_FISHEYE = ("k1", "k2", "k3", "k4")
_COMMON = ("projection_type", "width", "height", "focal", "focal_x", "focal_y", "c_x", "c_y")
_SUPPORTED = ("perspective", "simple_radial", "radial", "brown", "fisheye", "fisheye_opencv")


@dataclass(frozen=True)
class _Block:
    """The largest reconstruction of a file: its cameras, shots and points, and where it stands."""

    path: Path
    lenses: dict[str, Lens]
    shots: dict[str, dict]
    points: dict[str, dict]
    reference: tuple[float, float, float] | None
    sizes: tuple[int, ...]


def read_opensfm(path: Path) -> PoseFile:
    """Poses and lenses of a reconstruction: geocentric where it has a reference, else in the frame of [local]."""
    block = _block(path)
    poses, notes, warnings = [], [], []
    turn = None if block.reference is None else enu_from_geocentric(*_lon_lat(block.reference))
    for name, shot in block.shots.items():
        rotation, translation = (finite_numbers(shot.get(key), 3) for key in ("rotation", "translation"))
        if rotation is None or translation is None:
            raise PosesError(f"{block.path}: the pose of {name} is not a finite rotation and translation; {_EXPORT}")
        cam_from_world = Rotation.from_rotvec(rotation).as_matrix()
        centre = _geocentric(-cam_from_world.T @ np.array(translation), block.reference)
        lens = block.lenses[str(shot["camera"])]
        poses.append(Pose(name, centre, cam_from_world if turn is None else cam_from_world @ turn, lens))
    if block.path != path and path.is_file():
        notes.append(f"the poses are those of {block.path.name}: {path.name} beside it is in grid coordinates")
    if block.reference is not None:
        lat, lon, altitude = block.reference
        notes.append(f"the poses are topocentric at latitude {lat:.8f}, longitude {lon:.8f}, height {altitude:g} m")
    if len(block.sizes) > 1:
        others = ", ".join(str(size) for size in block.sizes[1:5]) + (", ..." if len(block.sizes) > 5 else "")
        warnings.append(
            f"{block.path.name} has a block in {len(block.sizes)} pieces that no tie point joins: the largest, of "
            f"{block.sizes[0]} images, is used, the others, of {others}, are left out; reconstruct them with more "
            "overlap, or each as a survey of its own"
        )
    frame = PoseFrame.LOCAL if block.reference is None else PoseFrame.GEOCENTRIC
    # Those of OpenDroneMap lie beside the images.
    masks = block.path.with_name(_MASKS)
    return PoseFile(
        tuple(poses), frame, None, "OpenSfM", masks if masks.is_dir() else None, tuple(notes), tuple(warnings)
    )


def read_ties(path: Path) -> FileTies | None:
    """Points of a reconstruction with their places in its images, by the tracks beside it; None without these."""
    block = _block(path)
    tracks = _tracks_of(block.path)
    ids, numbers = ({key: i for i, key in enumerate(part)} for part in (block.points, block.shots))
    if tracks is None or not ids:
        return None
    coordinates = [finite_numbers(_object(point).get("coordinates"), 3) for point in block.points.values()]
    points = np.array([[math.nan] * 3 if xyz is None else xyz for xyz in coordinates])
    observed = []
    try:
        with tracks.open(encoding="utf-8") as file:
            for line in file:
                cells = line.rstrip("\n").split("\t", 5)
                if len(cells) >= 5:
                    if cells[1] in ids and cells[0] in numbers:
                        observed.append((ids[cells[1]], numbers[cells[0]], float(cells[3]), float(cells[4])))
                elif line.strip() and not cells[0].startswith("OPENSFM_TRACKS_VERSION"):
                    raise ValueError(f"a line has {len(cells)} values")
    except OSError as error:
        raise PosesError(f"{tracks} cannot be read ({error.strerror}); correct its permissions") from error
    except ValueError as error:
        raise PosesError(f"{tracks} is damaged ({error}), expected rows of tracks; remove it, or {_EXPORT}") from error
    table = np.array(observed, dtype=np.float64).reshape(-1, 4)
    point, image = table[:, 0].astype(np.int64), table[:, 1].astype(np.int64)
    lenses = [block.lenses[str(shot["camera"])] for shot in block.shots.values()]
    size = np.array([[max(lens.width, lens.height), lens.width, lens.height] for lens in lenses], dtype=np.float64)
    # A place that overflows is not finite, and left out as one.
    with np.errstate(over="ignore"):
        pixel = size[image, :1] * table[:, 2:] + 0.5 * size[image, 1:]
    good = np.isfinite(points).all(axis=1)
    keep = good[point] & np.isfinite(pixel).all(axis=1)
    number = np.cumsum(good) - 1
    num_views = np.bincount(point, minlength=len(points))[good]
    points = _geocentric(points[good], block.reference)
    return FileTies(points, num_views, tuple(block.shots), number[point[keep]], image[keep], pixel[keep])


def _block(path: Path) -> _Block:
    path = _topocentric_of(path)
    content = read_foreign_json(path, PosesError)
    if not isinstance(content, list) or not content or not all(isinstance(block, dict) for block in content):
        raise PosesError(f"{path} is not a list of reconstructions, expected that of OpenSfM; {_EXPORT}")
    by_size = sorted(content, key=lambda block: -len(_object(block.get("shots"))))
    block, lenses = by_size[0], {}
    shots = {name: _object(shot) for name, shot in _object(block.get("shots")).items()}
    cameras = _object(block.get("cameras"))
    for name in dict.fromkeys(str(shot.get("camera")) for shot in shots.values()):
        if name not in cameras:
            shown = next(image for image, shot in shots.items() if str(shot.get("camera")) == name)
            raise PosesError(f"{path}: the camera of {shown} is not in the file; {_EXPORT}")
        try:
            lenses[name] = read_lens(_object(cameras[name]))
        except LensError as error:
            raise PosesError(f'{path}, camera "{name}": {error}') from error
    sizes = tuple(len(_object(block.get("shots"))) for block in by_size)
    return _Block(path, lenses, shots, _object(block.get("points")), _reference(path, block), sizes)


def _topocentric_of(path: Path) -> Path:
    """The file in topocentric coordinates that a path, a file or its folder, stands for."""
    if path.is_dir():
        return _files_in(path)[0]
    topocentric = path.with_name(_TOPOCENTRIC)
    if path.name in (_PLAIN, _GRID) and topocentric.is_file():
        return topocentric
    is_of_finished_project = path.name == _PLAIN and (path.parent.parent / "odm_georeferencing").is_dir()
    if path.name == _GRID or (is_of_finished_project and path.parent.name == "opensfm"):
        raise PosesError(
            f"{path} is in grid coordinates, and its rotations hold the scale and convergence of the grid; put "
            f"OpenDroneMap's {_TOPOCENTRIC} beside it, which has the same poses without them"
        )
    return path


def _lon_lat(reference: tuple[float, float, float]) -> tuple[float, float]:
    return math.radians(reference[1]), math.radians(reference[0])


def _geocentric(points: np.ndarray, reference: tuple[float, float, float] | None) -> np.ndarray:
    """Topocentric points (..., 3) as geocentric ones; as they are where there is no reference."""
    if reference is None:
        return points
    lon, lat = _lon_lat(reference)
    return geocentric_from_geodetic(lon, lat, reference[2], a=_A, b=_B) + points @ enu_from_geocentric(lon, lat)


def _reference(path: Path, block: dict) -> tuple[float, float, float] | None:
    given, reference_path = block.get("reference_lla"), path.with_name(_REFERENCE)
    if given is None and reference_path.is_file():
        given = read_foreign_json(reference_path, PosesError)
    if given is None:
        return None
    keys = ("latitude", "longitude", "altitude")
    found = finite_numbers([_object(given).get(key) for key in keys], 3)
    if found is None or abs(found[0]) > 90.0 or abs(found[1]) > 360.0:
        raise PosesError(f"{path}: its reference is {given}, expected latitude, longitude and altitude; correct it")
    # What OpenSfM writes where no photograph has a position.
    return None if found[:2] == [0.0, 0.0] else (found[0], found[1], found[2])


def _object(value) -> dict:
    """An object of JSON; empty where it is anything else."""
    return value if isinstance(value, dict) else {}


def _tracks_of(path: Path) -> Path | None:
    own = path.name.replace(".topocentric", "").replace("reconstruction", "tracks", 1).replace(".json", ".csv")
    return next((place for name in (own, _TRACKS) if (place := path.with_name(name)).is_file()), None)


def _files_in(folder: Path) -> list[Path]:
    """The reconstruction in a folder, or in opensfm/ below it: the topocentric one before the plain one."""
    for place in (folder / "opensfm", folder):
        for name in (_TOPOCENTRIC, _PLAIN):
            if (place / name).is_file():
                return [place / name]
    return sorted(path for path in folder.glob("reconstruction*.json") if path.name != _GRID)


def is_opensfm(path: Path) -> bool:
    """Whether a path is a reconstruction, a list in JSON, or a folder that has one."""
    if path.is_dir():
        return len(_files_in(path)) == 1
    return path.suffix.casefold() == ".json" and begins_with(path, b"[")


FORMAT = Format(
    name="a reconstruction of OpenSfM or OpenDroneMap (reconstruction.json)",
    find=_files_in,
    recognises=is_opensfm,
    read=read_opensfm,
    files=lambda path: [*map(path.with_name, (_TOPOCENTRIC, _PLAIN, _REFERENCE)), *filter(None, [_tracks_of(path)])],
    read_ties=read_ties,
)


def read_lens(camera: dict) -> Lens:
    """The lens of a camera, whose lengths are in units of the longer side of its image, from the middle of that."""
    kind = str(camera.get("projection_type", "perspective"))
    if kind not in _SUPPORTED:
        raise LensError(
            f"the projection {kind} is not supported, expected one of {', '.join(_SUPPORTED)}; reconstruct "
            "with one of these, e.g. --camera-lens brown in OpenDroneMap"
        )
    # What the camera began with changes nothing.
    lens = {key: value for key, value in camera.items() if not key.endswith("_prior")}
    known = (*_COMMON, *(_FISHEYE if kind.startswith("fisheye") else _BROWN))
    require_understood(lens, known, remedy="reconstruct with --camera-lens brown or fisheye", are_all_of_lens=True)
    size = width, height = lens_size(camera, "width", "height")
    longer = max(size)
    fx, fy = (longer * lens_number(camera, key if key in camera else "focal") for key in ("focal_x", "focal_y"))
    cx, cy = (longer * lens_number(camera, key, 0.0) + 0.5 * side for key, side in (("c_x", width), ("c_y", height)))
    if kind.startswith("fisheye"):
        return Lens("OPENCV_FISHEYE", (fx, fy, cx, cy, *(lens_number(camera, key, 0.0) for key in _FISHEYE)), *size)
    k1, k2, p1, p2, k3 = (lens_number(camera, key, 0.0) for key in _BROWN)
    return brown_lens((fx, fy, cx, cy, k1, k2, p1, p2), size, k3=k3)
