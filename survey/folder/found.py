"""Contents of a survey folder: settings, image headers, poses file, and the files that no result may overwrite.

Keys of survey.toml that have no effect beside what else a survey has, each with its condition, are in `conditions`.
"""

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

from pyproj import CRS

from geo.compatibility import require_at
from geo.crs import EGM96_HEIGHT, height_unit_m, parse_crs
from geo.errors import GeoError
from geo.transformation import use_grids
from refract.lens import MODELS, Lens, coefficients_of
from survey.display.quantities import listed
from survey.errors import FILE_NAME, ConfigError, Findings, PosesError, SurveyError
from survey.files.paths import ReadFiles, require_plain_entries
from survey.files.remote import is_url
from survey.files.toml_table import table_of
from survey.folder.control import FoundControl, find_control
from survey.folder.headers import find_geo_txt, header_warnings, read_headers
from survey.photos.exif import SUFFIXES, Exif, exif_places, position_sources, utm_code_of
from survey.photos.images import fetch_images, list_images, photographs_below, same_files
from survey.photos.poses import ImageNames, PoseFrame
from survey.pose_files import find_poses, find_unread, pose_files, read_poses
from survey.settings.config import ImagesConfig, SurveyConfig, settings_of
from survey.sfm.gps import EXACT, DatumStd, PositionTransform, datum_warnings, plan_std, smallest, transforms_into_crs
from survey.water.level import with_level
from survey.water.level_observation import LevelObservation, water_place_warnings
from survey.water.tides import Tide
from survey.words import GCP_LIST

MIN_VIEWS = 2
# Folder of a survey for geoid grids.
GRIDS_FOLDER = "geoid"
# Of a focal length and a principal point that are given and those of the poses file, as a share.
_SAME = 0.01
# Positions of a flight by a drone of DJI, and by RTKLIB.
_OF_GNSS = (".mrk", ".pos")
NO_WATER = (
    "no water was given, rays were not bent; ground under water lies about a quarter of its depth too high; write "
    f"[water] level_m in {FILE_NAME}, or dry = true, above its first table, where no ground is under water"
)


@dataclass(frozen=True)
class Found:
    """Contents of a survey folder."""

    folder: Path
    config: SurveyConfig  # As read; the water has a level, if there is water
    crs: CRS  # Horizontal and vertical
    # name to path: sorted by name; a name is the path below the image folder, with forward slashes
    images: dict[str, Path]
    headers: dict[str, Exif]  # name to Exif
    poses_path: Path | None  # None where structure from motion has to find the poses
    findings: Findings = field(default_factory=Findings)
    control: FoundControl = field(default_factory=FoundControl)  # Control and check points in crs
    # What was measured of the water level; clicks in photographs are not among them before the poses are known
    levels: tuple[LevelObservation, ...] = ()
    tide: Tide | None = None  # How the level moved; None where nothing is said of it
    # Std that the transformation into crs adds to GPS positions; none where a file has the poses
    datum: DatumStd = EXACT

    @property
    def name(self) -> str:
        """Name of the survey by survey.toml, else that of the folder."""
        return self.config.name or self.folder.resolve().name

    @cached_property
    def own_masks(self) -> Path | None:
        """The folder of masks that the poses file names, None where there is none, or it cannot be read."""
        # Such a file is refused by the next run, in words of its own.
        with suppress(SurveyError, GeoError):
            return None if self.poses_path is None else read_poses(self.poses_path).masks
        return None


def require_survey_folder(folder: str | Path) -> Path:
    """The path of a folder; raises SurveyError where it is none, or has links and devices among its files."""
    folder = Path(folder)
    if not folder.is_dir():
        what = "is a file" if folder.exists() else "does not exist"
        raise SurveyError(f"the survey folder {folder} {what}; expected a folder with photographs")
    require_plain_entries(folder)
    return folder


def image_folder_of(folder: Path) -> str:
    """Where photographs lie in a folder: in images/, in it itself, or in the one folder below it that has some."""
    if (folder / "images").is_dir():
        return "images"
    if any(path.suffix.lower() in SUFFIXES for path in folder.iterdir()):
        return "."
    places = photographs_below(folder)
    if len(places) == 1:
        return next(iter(places))
    found = f"photographs in {', '.join(places)}" if places else "no photographs"
    raise ConfigError(f"{folder} has {found} and no {FILE_NAME}; put those of the survey into {folder / 'images'}")


def find_survey(folder: Path, *, config: SurveyConfig | None = None) -> Found:
    """Read the settings, or take those of `config`, and image headers of a survey folder; no pixel is decoded."""
    folder = require_survey_folder(folder)
    toml = folder / FILE_NAME
    if config is None and (config := settings_of(folder)) is None:
        raise ConfigError(f"{folder} has no {FILE_NAME}; bathynerf init (bathynerf.init in Python) writes it")
    place = folder / config.images.local_dir
    if is_url(config.images.dir):
        fetch_images(config.images.dir, place)
    images = list_images(place, deep=config.images.dir != ".")
    poses_path, findings = _poses_path(folder, config, images)
    headers, added = read_headers(folder, place, images)
    findings += added
    if config.crs is None:
        raise ConfigError(
            f"{toml}: crs is missing; give that of all positions and heights there, with a vertical part, e.g. "
            f'crs = "EPSG:{utm_code_of(headers) or 25832}+{EGM96_HEIGHT}" above mean sea level (EGM96), as GPS has it'
        )
    use_grids(folder / GRIDS_FOLDER)
    crs = parse_crs(config.crs, where=f"crs in {toml}")
    config, levels, tide, added = with_level(folder, config, headers, crs)
    findings += added
    if poses_path is not None and config.water is not None:
        config.water.require_level()
    transforms: list[PositionTransform] = []
    if poses_path is None:
        sources = f"the GPS positions in {position_sources(headers)}"
        require_at(crs, exif_places(headers), sources, f"crs in {FILE_NAME}")
        transforms = transforms_into_crs(headers, crs, config.cameras.gps_height)
    datum = smallest([DatumStd(plan_std(transform.plan), transform.up_std_m) for transform in transforms])
    found = Found(folder, config, crs, images, headers, poses_path, levels=levels, tide=tide, datum=datum)
    findings += Findings(warnings=tuple(_warnings_of(found, transforms)))
    if config.control.files:
        # The height of the water in crs, where it is given and the same everywhere.
        water, level = config.water, None
        if water is not None and water.level_m is not None and not (water.slope_east or water.slope_north):
            level = water.level_m / height_unit_m(crs)
        control, added = find_control(folder, config.control, crs, headers, level)
        findings += added
        found = replace(found, control=control, config=replace(config, control=control.config))
    return replace(found, findings=findings)


def _warnings_of(found: Found, transforms: Sequence[PositionTransform]) -> Iterator[str]:
    """Warnings about photographs, positions and unused settings, before control is read."""
    config, headers = found.config, found.headers
    yield from header_warnings(config, headers)
    for names in same_files(found.images):
        copies = " and ".join(names[:4])
        yield f"{copies} are copies of one photograph, which agree wherever they are compared: keep one"
    if config.water is None and not config.dry:
        yield NO_WATER
    if found.poses_path is None:
        yield from water_place_warnings(found.crs, exif_places(headers), config.water, found.levels)
        yield from datum_warnings(transforms)
        yield from find_unread(found.folder)
        yield from _unread_positions(found)
        yield from unused_keys(Circumstances(config, headers))
    if not config.control.gcp_files and (found.folder / GCP_LIST).is_file():
        yield f'{GCP_LIST} is not used; for its control points write gcps = "{GCP_LIST}" in [control]'


def _unread_positions(found: Found) -> Iterator[str]:
    """Files of a drone's or RTKLIB's GNSS positions, where those of the photographs have no accuracy."""
    if found.config.cameras.position_std_m is not None or any(
        header.std_m or header.table_place for header in found.headers.values()
    ):
        return
    folders = {found.folder, *(path.parent for path in found.images.values())}
    names = sorted(
        path.name
        for folder in folders
        for path in folder.iterdir()
        if path.suffix.lower() in _OF_GNSS and not path.name.startswith(".")
    )
    if names:
        yield (
            f"GNSS positions not read, of {listed(names, 2)}: write those at the exposures into geo.txt, with their "
            "accuracy (image x y z 0 0 0 std std_up)"
        )


def _poses_path(folder: Path, config: SurveyConfig, images: Collection[str]) -> tuple[Path | None, Findings]:
    """The file of poses: as the settings name it, else of those found the one with most photographs."""
    if config.cameras.poses is not None:
        path = folder / config.cameras.poses
        if path.exists():
            return path, Findings()
        raise PosesError(f"the poses {path} do not exist; correct [cameras] poses in {folder / FILE_NAME}")
    paths = find_poses(folder)
    if len(paths) < 2:
        notes = tuple(f"the poses are those in {below(folder, path)}, the only poses found" for path in paths)
        return next(iter(paths), None), Findings(notes)
    counts = {path: _num_posed(path, images) for path in paths}
    most = max(paths, key=lambda path: counts[path])
    said = ", ".join(f"{below(folder, path)} with {num} of {len(images)} photographs" for path, num in counts.items())
    if sorted(counts.values())[-2] == counts[most]:
        raise ConfigError(f"{folder} has several files of poses ({said}); name one in [cameras] poses")
    return most, Findings((f"the poses are those in {below(folder, most)}, which has most: found were {said}",))


def _num_posed(path: Path, images: Collection[str]) -> int:
    """Number of photographs of which a poses file has the pose; 0 where it cannot be read."""
    try:
        names = ImageNames(images)
        return len({names.find(pose.name, str(path)) for pose in read_poses(path).poses} - {None})
    except SurveyError:
        return 0


def below(folder: Path, path: Path | None) -> str:
    """A path as it is seen from a folder."""
    return "" if path is None else path.relative_to(folder).as_posix() if path.is_relative_to(folder) else str(path)


def survey_inputs(folder: Path, config: SurveyConfig | None = None) -> ReadFiles:
    """Settings, poses, photographs, masks, control and measured water levels of a survey folder.

    ``config`` are its settings, where they are read already.
    """
    if not folder.is_dir():
        return ReadFiles()
    config = config or settings_of(folder) or SurveyConfig(images=ImagesConfig(dir=image_folder_of(folder)))
    images, masks = folder / config.images.local_dir, config.images.masks
    named = [FILE_NAME, *config.control.files, *(config.water.level_files.values() if config.water else ())]
    poses = find_poses(folder) if config.cameras.poses is None else [folder / config.cameras.poses]
    paths = [find_geo_txt(folder, images), *(folder / name for name in named), folder / masks if masks else None]
    if config.images.dir == ".":
        paths += [path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES]
    else:
        paths.append(images)
    return sum((poses_inputs(path) for path in poses), ReadFiles.of(*paths))


def poses_inputs(path: Path) -> ReadFiles:
    """The files of poses: a table, or those of a model or project, but not what lies below its folder."""
    return ReadFiles.of(*pose_files(path))


@dataclass(frozen=True)
class Circumstances:
    """What decides which keys of survey.toml are read."""

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
    gps_height = rotation_std = speed = origin = None
    if poses is not None and not given.is_placed_by_gps and frame is not PoseFrame.GEOCENTRIC:
        gps_height = f"it is that of GPS positions, and the cameras have the heights of {poses}"
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
        "cameras.gps_height": gps_height,
        **_conditions_of_lens(given),
        "cameras.rotation_std_deg": rotation_std,
        "cameras.speed_m_s": speed,
        "local.origin": origin,
        "control.std_m": control,
        "control.marks_std_px": control,
    }


def _conditions_of_lens(given: Circumstances) -> dict[str, str | None]:
    """Keys of a lens beside that of the poses file, which have no effect only where it is another."""
    cameras, lens, is_same = given.config.cameras, given.lens, dict[str, bool]()
    if lens is not None:
        numbers = dict(zip(MODELS[lens.model][1], lens.params, strict=True))
        is_same = {
            "model": cameras.model == lens.model,
            "size_px": cameras.size_px == (lens.width, lens.height),
            "focal_px": _is_near(cameras.focal_px, lens.focal),
            "principal_point_px": _is_near(cameras.principal_point_px, (numbers["cx"], numbers["cy"])),
            "distortion": cameras.distortion == tuple(numbers[part] for part in coefficients_of(lens.model)),
        }
    reasons = dict[str, str | None]()
    for name in ("model", "size_px", "focal_px", "principal_point_px", "distortion"):
        reasons[f"cameras.{name}"] = None
        if lens is not None and getattr(cameras, name) is not None and not is_same[name]:
            size = f"{lens.width} x {lens.height} px, focal length {lens.focal[0]:.1f} px"
            reasons[f"cameras.{name}"] = f"{given.poses} has a lens of its own ({lens.model}, {size})"
    return reasons


def _is_near(given: float | tuple[float, float] | None, own: tuple[float, float]) -> bool:
    pair = given if isinstance(given, tuple) else (given or math.inf,) * 2
    return all(abs(a - b) <= _SAME * abs(b) for a, b in zip(pair, own, strict=True))


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
