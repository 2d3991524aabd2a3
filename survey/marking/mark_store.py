"""Points and marks of a survey, edited one at a time in the files that hold them.

The files are the state: a file is read again if it has changed, the mark is changed in its content, and the whole file
is replaced, so that changes by other programs are kept.
"""

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from geo.atl24 import SUFFIXES as ATL24
from geo.files import write_text
from survey.control.formats import is_gcp_list, read_checkpoints, read_gcp_list
from survey.control.points import Content, GivenPoint, Mark
from survey.control.reading import in_crs, read_control
from survey.errors import SurveyError
from survey.folder.found import Found
from survey.marking.gcp_file import ControlMark, points_without_mark, read_clicks, with_click, with_marks
from survey.photos.poses import ImageNames
from survey.settings.config import SurveyConfig

GCP_LIST, CLICKS = "gcp_list.txt", "clicks.csv"
# Kinds of points: control and check points, and points of the waterline.
GROUND, WATER = "ground", "water"
# Characters that files use as separators, comments and quotes.
_NOT_IN_NAMES = set('\t\r\n,;"#')

Pixel = tuple[float, float]
_Read = TypeVar("_Read")


class PointKey(NamedTuple):
    """A point by its kind, `GROUND` or `WATER`, and name."""

    kind: str
    name: str


class Edit(NamedTuple):
    """A change of a mark, for undo: the pixel that it had before, None where there was no mark."""

    key: PointKey
    image: str
    before: Pixel | None


class MarkStore:
    """Points and their marks in gcp_list.txt and the table of clicks, with undo."""

    def __init__(self, config: SurveyConfig, found: Found, points: Path | None = None):
        self._config, self._found, self._points_path = config, found, points
        self._sizes = {name: header.size_px for name, header in found.headers.items()}
        # The gcp_list.txt that [control] names, whether or not it exists; else the usual name.
        self.control_path = found.folder / GCP_LIST
        for path in (found.folder / name for name in config.control.gcp_files):
            if is_gcp_list(path) if path.is_file() else path.suffix.lower() == ".txt":
                self.control_path = path
                break
        water = config.water
        named = None if water is None else water.clicks
        self.clicks_path = found.folder / (CLICKS if named is None else named)
        self._cache: dict[Path, tuple[object, Any]] = {}
        self._done: list[Edit] = []
        control, files = config.control, self._files()
        # Those that state the accuracy of points, or have points without marks.
        self._accuracy_files = [
            name
            for name, content in files.items()
            if not content.marks and (name in control.gcp_files or any(point.std_m for point in content.points))
        ]
        contents = [*files.values()]
        if control.marks is not None:
            contents.append(Content(marks=read_control(found.folder / control.marks).marks))
        # No photograph shows where photons of a lidar were reflected.
        if control.checkpoints is not None and Path(control.checkpoints).suffix.lower() not in ATL24:
            contents.append(Content(points=read_checkpoints(found.folder / control.checkpoints)))
        self._fixed = self._in_survey_crs([point for content in contents for point in content.points])
        # Marks of other files go into gcp_list.txt when it is written first.
        self._foreign = self._of_photographs([mark for content in contents for mark in content.marks])
        self._added: dict[str, GivenPoint] = {}
        self._waterline: dict[str, None] = {}

    @property
    def can_undo(self) -> bool:
        return bool(self._done)

    def points(self) -> dict[PointKey, GivenPoint | None]:
        """All points with their coordinates in the crs of the survey; points of the waterline have none."""
        _, ground = self._control()
        # In the order of the files, those of gcp_list.txt alone after the others.
        known = {**self._fixed, **{name: point for name, point in ground.items() if name not in self._fixed}}
        points: dict[PointKey, GivenPoint | None] = {
            PointKey(GROUND, name): point for name, point in {**self._added, **known}.items()
        }
        names = dict.fromkeys(row.name for row in self._clicks()) | self._waterline
        return points | {PointKey(WATER, name): None for name in names}

    def marks(self) -> dict[PointKey, dict[str, Pixel]]:
        """Marks by point and photograph."""
        control, _ = self._control()
        marks: dict[PointKey, dict[str, Pixel]] = {}
        for (name, image), pixel in control.items():
            marks.setdefault(PointKey(GROUND, name), {})[image] = pixel
        for row in self._clicks():
            if row.image is not None:
                marks.setdefault(PointKey(WATER, row.name), {})[row.image] = row.pixel
        return marks

    def add(self, kind: str, name: str, place: tuple[float, float, float] | None) -> PointKey:
        """Add a point, which is written into a file with its first mark."""
        name = name.strip()
        key = PointKey(kind, name)
        if not name or not name.isprintable() or _NOT_IN_NAMES & set(name):
            raise SurveyError(
                "the name of a point needs a letter or digit, and no comma, semicolon, quote or #; give another name"
            )
        if key in self.points():
            raise SurveyError(f"there is a point {name} already; give another name")
        if kind == WATER:
            self._waterline[name] = None
        elif place is None:
            raise SurveyError(f"the control point {name} has no coordinates, expected easting, northing and height")
        else:
            self._added[name] = GivenPoint(name, "entered by hand", place)
        return key

    def set(self, key: PointKey, image: str, pixel: Pixel | None) -> None:
        """Set or move the mark of a point in a photograph, or remove it, and write the file."""
        if key not in self.points() or image not in self._sizes:
            raise SurveyError(f"there is no point {key.name}, or no photograph {image}; load the page again")
        width, height = self._sizes[image]
        if pixel is not None and not (0.0 <= pixel[0] <= width and 0.0 <= pixel[1] <= height):
            raise SurveyError(f"{pixel[0]:g}, {pixel[1]:g} is outside of {image}, which has {width} x {height} pixels")
        before = self.marks().get(key, {}).get(image)
        if pixel is None and before is None:
            return
        self._write(key, image, pixel)
        self._done.append(Edit(key, image, before))

    def undo(self) -> Edit:
        """Undo the last edit, and return it."""
        if not self._done:
            raise SurveyError("there is nothing to undo")
        edit = self._done[-1]
        if edit.key.kind == GROUND and edit.key not in self.points():
            self._done.pop()
            raise SurveyError(f"the mark of {edit.key.name} cannot be put back: the point is in no file any more")
        if edit.key.kind == WATER:
            self._waterline[edit.key.name] = None
        self._write(edit.key, edit.image, edit.before)
        self._done.pop()
        return edit

    def settings(self) -> list[str]:
        """Lines that survey.toml lacks for `process` to use what was written."""
        control, lines = self._config.control, []
        if self.control_path.is_file():
            gcp_files = [*self._accuracy_files, self.control_path.relative_to(self._found.folder).as_posix()]
            if list(control.gcp_files) != gcp_files or control.marks is not None:
                named = ", ".join(f'"{name}"' for name in gcp_files)
                without = ", without marks" if control.marks is not None else ""
                lines.append(f"[control] gcps = {named if len(gcp_files) == 1 else f'[{named}]'}{without}")
        water = self._config.water
        if self.clicks_path.is_file() and (water is None or water.clicks is None):
            instead = "" if water is None else ", in place of the level that is there"
            lines.append(f'[water] clicks = "{self.clicks_path.name}"{instead}')
        return lines

    def _write(self, key: PointKey, image: str, pixel: Pixel | None) -> None:
        path = self.clicks_path if key.kind == WATER else self.control_path
        if key.kind == WATER:
            text = with_click(path, key.name, image, pixel, self._sizes)
        else:
            points = self.points()
            foreign = {} if path.is_file() else self._foreign
            marks = [
                ControlMark(name, point.place, point.is_check, photo, at)
                for (name, photo), at in {**foreign, (key.name, image): pixel}.items()
                if (point := points.get(PointKey(GROUND, name))) is not None
            ]
            text = with_marks(path, marks, self._found.crs, self._sizes)
        write_text(path, text)

    def _control(self) -> tuple[Mapping[tuple[str, str], Pixel], Mapping[str, GivenPoint]]:
        """Marks by name and photograph, and points, of gcp_list.txt; of other files before there is one."""

        def read(path: Path) -> tuple[Mapping[tuple[str, str], Pixel], Mapping[str, GivenPoint]]:
            content = read_gcp_list(path)
            return self._of_photographs(content.marks), self._in_survey_crs(
                [*content.points, *points_without_mark(path)]
            )

        if not self.control_path.is_file():
            return self._foreign, {}
        return self._read_if_changed(self.control_path, read)

    def _clicks(self):
        return self._read_if_changed(self.clicks_path, lambda path: read_clicks(path, self._sizes))

    def _read_if_changed(self, path: Path, read: Callable[[Path], _Read]) -> _Read:
        """Content of a file, from the cache unless the file has changed."""
        status = path.stat() if path.is_file() else None
        stamp = None if status is None else (status.st_mtime_ns, status.st_size, status.st_ino)
        if path not in self._cache or self._cache[path][0] != stamp:
            self._cache[path] = stamp, read(path)
        return self._cache[path][1]

    def _files(self) -> dict[str, Content]:
        """Contents of the other files of control points, and of that of --points, by their names in [control]."""
        folder = self._found.folder
        paths = {name: folder / name for name in self._config.control.gcp_files}
        if self._points_path is not None:
            paths.setdefault(Path(os.path.relpath(self._points_path, folder)).as_posix(), self._points_path)
        own = self.control_path.resolve()
        return {name: read_control(path) for name, path in paths.items() if path.resolve() != own}

    def _in_survey_crs(self, points: list[GivenPoint]) -> dict[str, GivenPoint]:
        found: dict[str, GivenPoint] = {}
        for point in in_crs(points, self._found.crs)[0]:
            found.setdefault(point.name, point)
        return found

    def _of_photographs(self, marks: list[Mark] | tuple[Mark, ...]) -> dict[tuple[str, str], Pixel]:
        names = ImageNames(self._sizes)
        images = [names.find(mark.view, mark.where) for mark in marks]
        return {(mark.point, image): mark.pixel for mark, image in zip(marks, images, strict=True) if image is not None}
