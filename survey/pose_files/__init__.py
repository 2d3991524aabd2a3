"""Poses files, one module per format: each reads a file into a `survey.photos.poses.PoseFile`.

Installed packages add formats of their own by entry points of the group `PLUGINS`, each a `Format`.
"""

from functools import cache
from importlib.metadata import entry_points
from pathlib import Path

from survey.errors import PosesError
from survey.files.paths import instead_of
from survey.photos.poses import DuplicatePose, FileTies, PoseFile
from survey.pose_files import colmap, metashape, nerfstudio, opensfm, pix4d, tables
from survey.pose_files.format import Format

# Files of other programs that have no poses that can be read, and what to do instead.
_POSITIONS = (
    "it has positions and no rotations; positions in EXIF or in geo.txt are used without being named, and poses are "
    "then found from the photographs"
)
_NOT_READ = {
    "*.nvm": "export a COLMAP model instead",
    "bundle.out": "export a COLMAP model instead",
    "*.psx": "export the cameras from Metashape (File > Export > Export Cameras)",
    "*.psz": "export the cameras from Metashape (File > Export > Export Cameras)",
    "*.p4d": "give the files in 1_initial/params of the Pix4D project",
    "*.opf": "export the calibrated cameras from Pix4D (*_calibrated_external_camera_parameters.txt)",
    "*pmatrix*.txt": "give *_calibrated_external_camera_parameters.txt beside it, which has positions and angles",
    "*.rcproj": "export the registration as a COLMAP model",
    "*.rsproj": "export the registration as a COLMAP model",
    "*.ori": "which way the matrices of PATB turn is not certain; export omega, phi, kappa as lines of text",
    "*.kml": _POSITIONS, "*.kmz": _POSITIONS, "*.gpx": _POSITIONS, "*.mrk": _POSITIONS, "*.pos": _POSITIONS,
    "*.geojson": _POSITIONS,
}  # fmt: skip
PLUGINS = "bathynerf.pose_formats"
# Asked in this order which of them a path is of, after those of other packages.
FORMATS = (
    pix4d.FORMAT, tables.LINES, tables.TABLE, colmap.FORMAT, opensfm.FORMAT, metashape.FORMAT, nerfstudio.FORMAT,
)  # fmt: skip


@cache
def formats() -> tuple[Format, ...]:
    """All formats, those of other packages first."""
    return (*(entry.load() for entry in entry_points(group=PLUGINS)), *FORMATS)


def find_poses(folder: Path) -> list[Path]:
    """Poses files and model folders of a known format, in their usual places in a survey folder."""
    found = (path for known in formats() for path in known.find(folder))
    return [path for path in found if instead_of(path, _NOT_READ) is None]


def find_unread(folder: Path) -> list[str]:
    """Sentences on poses files in a survey folder whose format is not read: their name, and what to do instead."""
    return [
        f"{path.name} is not read: {instead}"
        for path in sorted(folder.iterdir())
        if (instead := instead_of(path, _NOT_READ)) is not None and instead is not _POSITIONS
    ]


def read_poses(path: Path) -> PoseFile:
    """Contents of a poses file, or of the folder of a model."""
    if not path.exists():
        raise PosesError(f"the poses file {path} does not exist; correct [cameras] poses in survey.toml")
    expected = "; ".join(known.name for known in formats())
    instead = instead_of(path, _NOT_READ)
    if instead is not None:
        raise PosesError(f"{path} is not read: {instead}; expected one of: {expected}")
    known = _format_of(path)
    if known is None:
        raise PosesError(f"{path} is not a known kind of poses file; expected one of: {expected}")
    file = known.read(path)
    if not file.poses:
        raise PosesError(f"{path} has no poses, expected those of the photographs; correct it or give another file")
    names = set[str]()
    for pose in file.poses:
        if pose.name in names:
            raise DuplicatePose(pose.name, pose.where or str(path))
        names.add(pose.name)
    return file


def pose_files(path: Path) -> list[Path]:
    """The files that are read for the poses in a path, none of which a result may replace."""
    if path.is_dir():
        return [file for file in path.iterdir() if file.is_file()]
    known = _format_of(path) if path.exists() else None
    companions = [] if known is None or known.files is None else known.files(path)
    return [path, *(file for file in companions if file.is_file())]


def read_ties(path: Path) -> FileTies | None:
    """Tie points that came with poses, in the frame of these; None where none came."""
    known = _format_of(path)
    return None if known is None or known.read_ties is None else known.read_ties(path)


def _format_of(path: Path) -> Format | None:
    return next((known for known in formats() if known.recognises(path)), None)
