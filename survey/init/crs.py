"""The CRS, the datum of heights in EXIF and the origin of poses for a new survey.toml, its keys and questions."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from textwrap import shorten
from typing import Any

import numpy as np
import tomli_w
from pyproj import CRS
from pyproj.database import query_crs_info
from pyproj.enums import PJType

import geo.crs
from geo.compatibility import height_systems_at, likely_crs, require_at
from geo.transformation import lon_lat
from survey.control.points import GivenPoint
from survey.errors import ConfigError, PosesError
from survey.folder.found import Found
from survey.folder.gps_placement import place_poses
from survey.folder.headers import SAME_PLACE_M
from survey.folder.local_frame import geodetic, points_in_crs
from survey.folder.pairing import pair
from survey.folder.plausible import distances_to_exif
from survey.photos.exif import Exif, middle_of, position_sources, utm_code_of
from survey.photos.poses import ImageNames, PoseFile, PoseFrame
from survey.photos.xmp import ELLIPSOIDAL
from survey.settings.tables import InitOptions
from survey.sfm.gps import area_at, height_transformer
from survey.words import GEO_TXT, printable

_WGS84_3D = 4979
# Control points of a survey lie this near to its photographs [m].
_NEAR_CONTROL_M = 3000.0


@dataclass
class SettingsTable:
    """A table of survey.toml."""

    name: str  # Empty for the keys before the first table
    lines: list[str] = field(default_factory=list)

    def set(self, key: str, value: Any, comment: str = "", more: tuple[str, ...] = ()) -> None:
        """Add a key with a comment behind it, and lines of comment below."""
        line = f"{key} = {_toml(value)}"
        self.lines.append(f"{line}    # {printable(comment)}" if comment else line)
        self.add_comments(*more)

    def add_comments(self, *comments: str) -> None:
        """Add lines of comment."""
        self.lines += [f"# {printable(text)}" for text in comments]

    def text(self) -> str:
        """The table in TOML; empty where it has no line."""
        head = f"[{self.name}]\n" if self.name else ""
        return head + "\n".join(self.lines) + "\n" if self.lines else ""


def _toml(value: Any) -> str:
    if isinstance(value, list | tuple):
        return f"[{', '.join(_toml(item) for item in value)}]"
    return tomli_w.dumps({"key": value}).partition(" = ")[2].strip()


@dataclass(frozen=True)
class FolderPhotographs:
    """Photographs of a folder, and the poses found with them."""

    headers: Mapping[str, Exif]  # By name
    poses_path: Path | None
    file: PoseFile | None  # What `poses_path` holds
    control: tuple[GivenPoint, ...] = ()  # Of the control file that was found

    @property
    def lat_lon(self) -> tuple[float, float] | None:
        """Latitude and longitude of the survey [deg], by EXIF, else by geocentric poses, else by control points."""
        if (middle := middle_of(self.headers)) is not None:
            return middle
        if self.file is not None and self.file.frame is PoseFrame.GEOCENTRIC:
            lon, lat, _ = geodetic(self.file, np.median([pose.centre for pose in self.file.poses], axis=0))
            return float(lat), float(lon)
        if self.control and (crs := self.control[0].crs) is not None:
            places = np.array([point.place[:2] for point in self.control])
            lon, lat = geo.crs.middle_lon_lat(lon_lat(geo.crs.horizontal_crs(crs), places)).tolist()
            return lat, lon
        return None

    @property
    def says_ellipsoidal(self) -> bool:
        """Whether XMP says of most photographs that their heights count from the ellipsoid."""
        datums = [header.height_datum for header in self.headers.values() if header.height_datum is not None]
        return 2 * datums.count(ELLIPSOIDAL) > len(datums)


def write_crs(photographs: FolderPhotographs, options: InitOptions, top: SettingsTable, cameras: SettingsTable) -> CRS:
    """Add crs, and gps_height where heights in EXIF are ellipsoidal; returns the CRS."""
    horizontal, by = (None, "") if options.crs is not None else _horizontal(photographs)
    if horizontal is None:

        def read(given: str) -> tuple[str, CRS]:
            if not given:
                raise ConfigError(f'{by}; init and process take it as --crs "EPSG:25832+7837"')
            crs = geo.crs.parse_crs(given, where="--crs")
            at = np.array([] if photographs.lat_lon is None else [photographs.lat_lon[::-1]]).reshape(-1, 2)
            require_at(crs, at, "the photographs", "--crs")
            return given, crs

        if options.crs is None and options.ask is not None:
            given, crs = options.ask(f"{by}. EPSG code with a vertical part, e.g. EPSG:25832+7837", read)
        else:
            given, crs = read(options.crs or "")
        top.set("crs", given, crs.name)
        if photographs.says_ellipsoidal and geo.crs.vertical_crs(crs) is not None:
            cameras.set("gps_height", "ellipsoidal", "XMP says so")
        return crs
    if geo.crs.has_height(CRS(horizontal)):
        top.set("crs", horizontal, by)
        return geo.crs.parse_crs(horizontal)
    vertical, comment, more = _vertical(photographs, horizontal, options, cameras)
    code = f"{horizontal}+{vertical}"
    top.set("crs", code, f"{by}, with {comment}", more)
    return geo.crs.parse_crs(code)


def _horizontal(photographs: FolderPhotographs) -> tuple[str | None, str]:
    """The CRS of the poses, else the UTM zone of the photographs, and what says so; or None and what is missing."""
    file, place = photographs.file, photographs.lat_lon
    is_on_map = file is not None and file.frame in (PoseFrame.GRID, PoseFrame.ENU)
    if (
        file is not None
        and is_on_map
        and file.crs is not None
        and file.crs.is_projected
        and (code := geo.crs.crs_code(file.crs))
    ):
        return code, f"that of the poses, {file.crs.name}"
    if file is None:
        tables = [header.table_place.crs for header in photographs.headers.values() if header.table_place is not None]
        if tables and tables[0].is_projected and (code := geo.crs.crs_code(tables[0])) is not None:
            return code, f"that of {GEO_TXT}"
        if (by_control := _of_control(photographs)) is not None:
            return by_control
    zone = utm_code_of(dict(photographs.headers))
    by = f"the UTM zone of the GPS positions in {position_sources(photographs.headers)}"
    if zone is None and place is not None:
        zone, by = geo.crs.utm_code(*place), f"the UTM zone of the {'control points' if file is None else 'poses'}"
    if zone is None and file is None and not photographs.control:
        raise ConfigError(
            "nothing tells where the photographs lie: they have no GPS positions, and there are neither poses nor "
            "control points with marks; add cameras.csv, geo.txt, gcp_list.txt or others of docs/formats.md"
        )
    if zone is None:
        return None, "neither the photographs nor their poses tell the coordinate reference system (crs)"
    if file is not None and file.crs is None and is_on_map:
        crs, names = CRS(f"EPSG:{zone}+{geo.crs.EGM96_HEIGHT}"), ImageNames(photographs.headers)
        centres = points_in_crs(file, np.array([pose.centre for pose in file.poses]), crs, "crs")
        images = [names.find(pose.name, str(photographs.poses_path)) for pose in file.poses]
        known = {name: centre for name, centre in zip(images, centres, strict=True) if name is not None}
        distances = distances_to_exif(crs, known, photographs.headers)
        if not distances.size or np.median(distances) > SAME_PLACE_M:
            return None, f"{photographs.poses_path} is not in {geo.crs.horizontal_crs(crs).name}, nor says its crs"
    return f"EPSG:{zone}", by


def _of_control(photographs: FolderPhotographs) -> tuple[str, str] | None:
    """The projected CRS of control points, as their file states it or by where they lie; None where neither tells."""
    points, place = photographs.control, photographs.lat_lon
    stated = points[0].crs if points else None
    if stated is not None:
        # Of a CRS without a code, as OpenDroneMap has them, EPSG's that is nearly the same.
        plan = geo.crs.horizontal_crs(stated)
        code = geo.crs.crs_code(stated) or (f"EPSG:{epsg}" if (epsg := plan.to_epsg()) is not None else None)
        return (code, "that of the control points") if code is not None and plan.is_projected else None
    if not points or place is None:
        return None
    zone = CRS(f"EPSG:{geo.crs.utm_code(*place)}")
    fitting = likely_crs(np.array([point.place for point in points]), place[::-1], _NEAR_CONTROL_M, zone)
    if not fitting or zone in fitting:
        return None
    return f"EPSG:{fitting[0].to_epsg()}", f"not certain: {fitting[0].name}, in which the control points lie here"


def _vertical(
    photographs: FolderPhotographs, horizontal: str, options: InitOptions, cameras: SettingsTable
) -> tuple[int | None, str, tuple[str, ...]]:
    """EPSG code of the heights, what they are, and what else they might be.

    Where XMP says that heights in EXIF are ellipsoidal, a national system is taken where the grid of its geoid is
    installed, which turns those heights into it; `check` names the grid where it is missing.
    """
    place, source = photographs.lat_lon, position_sources(photographs.headers)
    systems = () if place is None else height_systems_at(*place)
    listed = tuple(f"{system.to_epsg()} {system.name} ({_area(system)})" for system in systems)
    chosen = systems[0] if len(systems) == 1 else None
    if len(systems) > 1:
        # The one that EPSG combines with the horizontal one, as a country uses them.
        names, plan = {info.name for info in query_crs_info("EPSG", PJType.COMPOUND_CRS)}, CRS(horizontal).name
        chosen = next((system for system in systems if f"{plan} + {system.name}" in names), None)
    if chosen is None and systems and options.ask is not None:
        lines = [
            "In which heights are the water and control known?",
            *listed,
            "Code, or empty for mean sea level (EGM96)",
        ]
        by_code = {"": None, **{str(system.to_epsg()): system for system in systems}}

        def read(choice: str) -> CRS | None:
            if (code := choice.removeprefix("EPSG:")) not in by_code:
                raise ConfigError(f'the answer is "{choice}", expected one of the codes {"; ".join(listed)}')
            return by_code[code]

        chosen = options.ask("\n".join(lines), read)
    national = "" if chosen is None else f"the heights of {_area(chosen)} ({chosen.name})"
    if photographs.says_ellipsoidal:
        if chosen is not None and _has_geoid(photographs, geo.crs.parse_crs(f"{horizontal}+{chosen.to_epsg()}")):
            cameras.set("gps_height", "ellipsoidal", "XMP says so")
            return chosen.to_epsg(), national, ()
        return (
            _WGS84_3D,
            "heights above the ellipsoid",
            (
                "XMP says that heights in EXIF count from the ellipsoid: the level of the water has to count from "
                "there too.",
                *(f'For levels in {one}, put this code and [cameras] gps_height = "ellipsoidal"' for one in listed),
            ),
        )
    if chosen is not None:
        warning = f"Not certain: that the level, all other heights and those in {source} count from there."
        return chosen.to_epsg(), national, (warning,)
    hint = "Not certain: levels of water may be in the heights of a country; then put its code here:"
    more = (hint, *(f"    {system}" for system in listed)) if listed else ()
    return geo.crs.EGM96_HEIGHT, f"heights above mean sea level (EGM96), as in {source}", more


def _has_geoid(photographs: FolderPhotographs, crs: CRS) -> bool:
    places = [h.lat_lon_height[:2] for h in photographs.headers.values() if h.lat_lon_height is not None]
    if not places:
        return False
    lat, lon = np.array(places).T
    try:
        height_transformer(crs, area_at(lon, lat))
    except ConfigError:
        return False
    return True


def _area(system: CRS) -> str:
    name = "" if system.area_of_use is None else system.area_of_use.name
    return shorten(name.rstrip("."), 48, placeholder=" ...")


def write_origin(photographs: FolderPhotographs, options: InitOptions, found: Found, local: SettingsTable) -> None:
    """Add the origin of poses in a local frame, as given, else by GPS; raises where poses have no place in crs."""
    file = photographs.file
    if file is None:
        return
    if file.frame is not PoseFrame.LOCAL:
        points_in_crs(file, np.array([pose.centre for pose in file.poses]), found.crs, "crs")
        return
    if options.origin is not None:
        local.set("origin", list(options.origin))
        return
    try:
        placed, findings = place_poses(found, file, list(pair(found, file.poses)[0].values()))
    except (ConfigError, PosesError) as error:
        raise ConfigError(f"{error}; or give --origin EASTING NORTHING HEIGHT, the zero point in crs") from error
    if placed.by_gps is None or not np.array_equal(placed.by_gps[0].rotation, np.eye(3)):
        local.add_comments(*(f"No origin: {sentence}." for sentence in findings.assumptions + findings.warnings))
        return
    similarity, frame = placed.by_gps
    local.set(
        "origin",
        [round(float(v), 3) for v in frame.crs_from_local(similarity(np.zeros((1, 3))))[0]],
        "zero point of the poses in crs",
        ("Not certain: by GPS positions in EXIF, a few metres. Better the numbers given to model_aligner.",),
    )
