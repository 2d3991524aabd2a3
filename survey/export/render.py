"""`bathynerf render`: views of the bed of a run from other cameras, and videos of flights along them."""

from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from PIL import Image
from PIL.PngImagePlugin import PngInfo
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation, RotationSpline

from fields.image_based import NovelView
from geo.files import reporting_disk_errors, write_whole
from geo.frames import LocalFrame
from refract import PinholeCamera
from refract.lens import Lens
from survey.errors import FILE_NAME, ConfigError, OutputError, SurveyError
from survey.export.loaded import LoadedRun, colours_without_water
from survey.export.novel_views import image_based_field
from survey.files.paths import ReadFiles, require_file, require_folder
from survey.folder.found import poses_inputs, survey_inputs
from survey.folder.local_frame import poses_in_local
from survey.folder.pairing import lens_from_config
from survey.photos.poses import PoseFile, PoseFrame
from survey.pose_files import read_poses
from survey.progress import current
from survey.run.flight import load_flight
from survey.run.folder import RunDir
from survey.run.trained_field import load_layer_field
from survey.settings.config import read_config

FIELD_STAGE = "field"
VIDEO, FRAMES_PER_S = "flight.mp4", 25
# In the order of the layers that `write_view` makes.
_ENDINGS = (".png", "_normal.png", "_height.tif", "_distance.tif")
_BANDS = {"_height.tif": "height of the bed over the plane of the water", "_distance.tif": "distance along the ray"}
# Tags of GDAL with name and unit of the band, and with the value of what is not known.
_GDAL_METADATA, _GDAL_NODATA = 42112, 42113
_METADATA = (
    '<GDALMetadata><Item name="DESCRIPTION" sample="0" role="description">{}</Item>'
    '<Item name="UNITTYPE" sample="0" role="unittype">metre</Item></GDALMetadata>'
)
# Tag in pictures that render wrote.
_SOFTWARE = "bathynerf render"


def render(
    run: str | Path,
    cameras: str | Path,
    output: str | Path,
    *,
    dry: bool = False,
    trained: bool = False,
    survey: str | None = None,
    device: str = "auto",
    video_s: float | None = None,
) -> list[Path]:
    """Render views of the bed of a run for other cameras.

    The run's photographs are warped along bent rays onto its height maps, and blended (`fields.image_based`);
    or its `trained` field is rendered.

    Of each camera NAME.png (transparent where it sees no bed), NAME_height.tif (of the bed over the water plane [m],
    float32, NaN outside), NAME_distance.tif (from the camera along the path [m]) and NAME_normal.png (local east,
    north, up as red, green, blue, -1 to 1 as 0 to 255). They are seen through the lens of the camera: at the pose of a
    photograph, they fit it pixel by pixel. Raises SurveyError or GeoError if the run has no height maps or no field,
    its photographs are not there, or the cameras are unusable; OutputError if the pictures must not be written there,
    see `survey.files.paths`: a picture that is there is replaced only where render wrote it.

    Parameters
    ----------
    cameras : Path
        Poses, in a format that surveys may have; a lens that it does not carry is that of survey.toml, else of the run.
    dry : bool
        Without water: straight rays, and the colour of the bed where the run has it (``--true-colour``).
    trained : bool
        Render the field that ``process --field mdw`` trained, on a device, instead of the photographs.
    survey : str, optional
        Folder of the survey, if it was moved since the run.
    video_s : [s], optional
        Write one video of a flight along the cameras, flight.mp4, in place of pictures.
    """
    folder, output = RunDir(run), Path(output)
    folder.require_run()
    field_folder = None
    if trained:
        try:
            field_folder = folder.load_stage(FIELD_STAGE)
        except SurveyError as error:
            raise SurveyError(
                f"the run {folder.path} has no trained field; run `bathynerf process` again with --field mdw, or leave "
                "--field out: its photographs are rendered then"
            ) from error
    flight = load_flight(folder.path)
    folder.warn_if_unfinished()
    targets = targets_of(folder, flight.frame, Path(cameras), output)
    if field_folder is not None:
        field = load_layer_field(field_folder, flight.water, device)
        return write_seen(targets, output, video_s, lambda _cameras: lambda camera: field.view(camera, dry))
    with LoadedRun(run) as loaded:

        def view_of(cameras: list[PinholeCamera]) -> Callable[[PinholeCamera], NovelView]:
            with current().stage("Exposure") as stage:
                of_photographs = image_based_field(loaded, survey, cameras, dry=dry, advance=stage.advance)
            without_water = colours_without_water(loaded) if dry else None
            if dry and without_water is None and flight.water is not None:
                current().note(
                    "colours are as photographed; a run with --true-colour has those of the bed without its water"
                )
            return lambda camera: of_photographs.render(camera, dry=dry, without_water=without_water)

        return write_seen(targets, output, video_s, view_of)


@dataclass(frozen=True)
class Target:
    """A camera to be rendered, and where its pictures go: paths that begin with ``stem``."""

    name: str
    camera: PinholeCamera
    stem: Path


def targets_of(run: RunDir, frame: LocalFrame, cameras: Path, output: Path) -> list[Target]:
    """The cameras of a file of poses in a local frame, and their pictures in a folder; errors as `render`."""
    inputs = run.inputs()
    if cameras.exists():
        inputs += poses_inputs(cameras)
    # The photographs of the surveys in whose folders the run and the cameras lie.
    for place in {run.path.absolute().parent, cameras.absolute().parent}:
        if (place / FILE_NAME).is_file():
            # An unreadable survey is skipped: the run has its own settings.
            with suppress(ConfigError):
                inputs += survey_inputs(place)
    require_folder("-o", output, inputs, may_hold_inputs=True)
    posed = _cameras(read_poses(cameras), cameras, frame, run)
    short = Counter(Path(name).with_suffix("") for name in posed)
    targets = []
    for name, camera in posed.items():
        # Without the suffix, unless another camera would have the same name.
        bare = Path(name).with_suffix("")
        stem = output / (bare if short[bare] == 1 else name)
        if not stem.resolve().is_relative_to(output.resolve()):
            raise OutputError(f"the camera {name} in {cameras} would be written outside of {output}; rename it")
        targets.append(Target(name, camera, stem))
    for picture in (path for target in targets for path in _pictures(target.stem) if path.exists()):
        kind = "a picture that render wrote"
        require_file("-o", picture, inputs, kind=kind, is_of_kind=lambda head: _SOFTWARE.encode() in head)
    return targets


def write_seen(
    targets: list[Target],
    output: Path,
    video_s: float | None,
    view_of: Callable[[list[PinholeCamera]], Callable[[PinholeCamera], NovelView]],
) -> list[Path]:
    """Pictures of cameras, or a video along them; ``view_of`` gets all cameras, and gives what renders one."""
    cameras = [target.camera for target in targets]
    if video_s is None:
        return write_views(targets, view_of(cameras))
    cameras, path = flown(cameras, video_s), output / VIDEO
    if path.exists():
        require_file("-o", path, ReadFiles.of(), kind="an MP4", is_of_kind=lambda head: head[4:8] == b"ftyp")
    return [write_video(path, cameras, view_of(cameras))]


def write_views(targets: list[Target], view_of: Callable[[PinholeCamera], NovelView]) -> list[Path]:
    """Render and write the pictures of cameras; those that see nothing are named in a warning."""
    written, empty = [], []
    with current().stage("Render", len(targets)) as stage:
        for target in targets:
            view = view_of(target.camera)
            if not view.seen.any():
                empty.append(target.name)
            written.append(write_view(target.stem, view))
            stage.advance()
    if empty:
        current().warn(f"{len(empty)} of {len(targets)} cameras see nothing of the bed: {', '.join(empty[:5])}")
    return written


def _cameras(file: PoseFile, path: Path, frame: LocalFrame, run: RunDir) -> dict[str, PinholeCamera]:
    """Cameras of a file of poses in a local frame, by name; a lens that is in no file is that of the run."""
    config = read_config(run.settings_path)
    if file.frame is PoseFrame.LOCAL and config.local.origin != frame.origin and not file.is_camera_path:
        raise SurveyError(
            f"the poses in {path} are in a local frame, but the run's cameras were not; give a table of positions in "
            f"{frame.crs.name} instead (image, easting, northing, height, omega, phi, kappa)"
        )
    given = config.cameras
    is_given = given.size_px is not None and given.focal_px is not None
    open_names, lenses = [pose.name for pose in file.poses if pose.lens is None], dict[str, Lens]()
    if open_names and is_given:
        lenses = dict.fromkeys(open_names, lens_from_config(given, {})[0])
    elif open_names:
        own = {view.name: view.lens for view in load_flight(run.path).views}
        first = next(iter(own.values()))
        unknown = [name for name in open_names if name not in own]
        if unknown and any(lens != first for lens in own.values()):
            raise SurveyError(
                f"{path} has no lens for {unknown[0]}, and the photographs of the run have several; give poses with "
                "lenses, as of a COLMAP model"
            )
        lenses = {name: own.get(name, first) for name in open_names}
    placed = zip(file.poses, *poses_in_local(file, path, frame, given.gps_height), strict=True)
    return {pose.name: (pose.lens or lenses[pose.name]).camera(centre, rotation) for pose, centre, rotation in placed}


def _pictures(stem: Path) -> list[Path]:
    return [stem.with_name(stem.name + ending) for ending in _ENDINGS]


def write_view(stem: Path, view: NovelView) -> Path:
    """Write the pictures of a view under names that begin with `stem`; the path of the colours."""
    with reporting_disk_errors(stem.parent):
        stem.parent.mkdir(parents=True, exist_ok=True)
    alpha, of_bed = (255 * shown.astype(np.uint8) for shown in (view.coloured, view.seen))
    tilt = np.nan_to_num(np.round(127.5 * (view.normal + 1.0)), nan=0.0).astype(np.uint8)
    layers = (np.dstack([view.rgb, alpha]), np.dstack([tilt, of_bed]), view.bed_height, view.distance)
    mark = PngInfo()
    mark.add_text("Software", _SOFTWARE)
    paths = _pictures(stem)
    for path, pixels in zip(paths, layers, strict=True):
        with write_whole(path) as stream:
            if path.suffix == ".png":
                Image.fromarray(pixels).save(stream, "PNG", pnginfo=mark)
            else:
                tags = {_GDAL_METADATA: _METADATA.format(next(_BANDS[e] for e in _BANDS if path.name.endswith(e)))}
                tags[_GDAL_NODATA] = "nan"
                Image.fromarray(pixels).save(stream, "TIFF", software=_SOFTWARE, tiffinfo=tags)
    return paths[0]


def flown(keys: Sequence[PinholeCamera], seconds: float) -> list[PinholeCamera]:
    """Cameras of a flight of so many seconds along key cameras, with equal times from key to key.

    Places lie on a curve through those of the keys that does not overshoot, rotations on a spline without jumps of
    the angular velocity. All have the lens of the first key. Raises SurveyError for fewer than two keys.
    """
    if len(keys) < 2:
        raise SurveyError(f"a video needs two cameras at least, got {len(keys)}; give more in --cameras")
    times = np.linspace(0.0, seconds, max(round(seconds * FRAMES_PER_S), 2))
    of_keys = np.linspace(0.0, seconds, len(keys))
    centres = PchipInterpolator(of_keys, [key.centre for key in keys])(times)
    rotations = RotationSpline(of_keys, Rotation.from_matrix([key.cam_from_local for key in keys]))(times).as_matrix()
    # Codecs halve the resolution of colours: sides are even.
    first = replace(keys[0], motion=None, width=keys[0].width // 2 * 2, height=keys[0].height // 2 * 2)
    poses = zip(centres, rotations, strict=True)
    return [replace(first, centre=centre, cam_from_local=rotation) for centre, rotation in poses]


def write_video(path: Path, cameras: Sequence[PinholeCamera], view_of: Callable[[PinholeCamera], NovelView]) -> Path:
    """Render cameras into an MP4 (MPEG-4 part 2), whole or not at all; black where nothing is seen."""
    with TemporaryDirectory(prefix="bathynerf-video-") as scratch, current().stage("Render", len(cameras)) as stage:
        part = Path(scratch) / path.name
        size = cameras[0].width, cameras[0].height
        video = cv2.VideoWriter(str(part), cv2.VideoWriter.fourcc(*"mp4v"), FRAMES_PER_S, size)
        for camera in cameras:
            view = view_of(camera)
            video.write(np.where(view.coloured[..., None], view.rgb, 0).astype(np.uint8)[..., ::-1])
            stage.advance()
        video.release()
        # OpenCV says neither that it cannot encode nor that a disk is full.
        written = cv2.VideoCapture(str(part)).get(cv2.CAP_PROP_FRAME_COUNT)
        if written != len(cameras):
            raise OutputError(f"OpenCV put {written:.0f} of {len(cameras)} pictures into {scratch}; free space there")
        path.parent.mkdir(parents=True, exist_ok=True)
        with write_whole(path) as stream:
            stream.write(part.read_bytes())
    return path
