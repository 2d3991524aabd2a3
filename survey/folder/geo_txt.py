"""geo.txt of OpenDroneMap: positions of photographs that replace those in EXIF.

Its first line is the CRS; the others are ``image x y [z] [omega phi kappa] [horizontal accuracy] [vertical accuracy]``,
easting or longitude first. As in OpenDroneMap, angles are not used.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np
from pyproj import CRS, Geod

from geo.compatibility import require_in_area
from geo.crs import has_height, height_unit_m, horizontal_crs, horizontal_unit, is_geographic
from geo.transformation import lon_lat
from survey.display.quantities import named
from survey.errors import Findings, PosesError
from survey.files.crs_lines import odm_lines
from survey.files.csv_table import number_of
from survey.folder.plausible import SAME_PLACE_M
from survey.photos.exif import SUFFIXES, Exif, TablePlace
from survey.photos.names import ImageNames
from survey.words import GEO_TXT

_FORM = "image x y [z] [omega phi kappa] [horizontal accuracy] [vertical accuracy]"
# How many numbers a line may have: x y, z, three angles, accuracies.
_COUNTS = (2, 3, 6, 7, 8)
_MOST_STD_M = 100.0


@dataclass(frozen=True)
class _Line:
    """A photograph with its position, as one line has it."""

    image: str
    where: str
    place: tuple[float, float, float]
    std_m: tuple[float, float, float] | None
    lacks_vertical: bool


def find_geo_txt(folder: Path, images: Path) -> Path | None:
    """The geo.txt in the survey folder or next to the photographs; None where there is none."""
    places = [place for place in dict.fromkeys((folder, images)) if place.is_dir()]
    named_so = (path for place in places for path in sorted(place.iterdir()) if path.name.casefold() == GEO_TXT)
    found = [path for path in named_so if path.is_file()]
    if len(found) > 1:
        raise PosesError(f"{found[0]} and {found[1]} both have positions of the photographs; remove one of them")
    return found[0] if found else None


def with_positions(path: Path, headers: Mapping[str, Exif]) -> tuple[dict[str, Exif], Findings]:
    """Heads of photographs with the positions of a geo.txt; those that it does not name keep the ones in EXIF."""
    crs, lines = _read(path)
    names, line_of = ImageNames(headers), {}
    unknown = []
    for line in lines:
        name = names.find(line.image, line.where)
        if name is None:
            unknown.append(line.image)
        elif name in line_of:
            raise PosesError(f"{line.where}: {name} has a second position; remove one of the two lines")
        else:
            line_of[name] = line
    if not line_of:
        raise PosesError(
            f'{path} names none of the photographs: "{lines[0].image}" for "{next(iter(headers))}"; correct its '
            "names, or remove the file where it is of another flight"
        )
    done = dict(headers) | _placed(headers, line_of, crs)
    warnings = named(unknown, "image", f"of {path.name} not among the photographs")
    warnings += named(
        [n for n in headers if n not in line_of], "image", f"not in {path.name}, which keep what EXIF has"
    )
    lacking = [name for name, line in line_of.items() if line.lacks_vertical]
    warnings += named(lacking, "image", f"with a horizontal accuracy alone in {path.name}, which is not used")
    return done, _replaced(path, crs, headers, line_of) + Findings(warnings=tuple(warnings))


def _placed(headers: Mapping[str, Exif], line_of: Mapping[str, _Line], crs: CRS) -> dict[str, Exif]:
    """The headers of photographs at the places of their lines."""
    places = np.array([line.place for line in line_of.values()])
    where = lon_lat(crs, places)
    on_map = np.isfinite(where).all(axis=1) & (np.abs(where) <= [180.0, 90.0]).all(axis=1)
    for line, is_known in zip(line_of.values(), on_map, strict=True):
        if not is_known:
            raise PosesError(
                f"{line.where}: {line.place[0]:.10g}, {line.place[1]:.10g} is not on the map of {crs.name}; correct "
                "the coordinates, their order (easting or longitude first) or the CRS in the first line"
            )
    require_in_area(crs, places, f"the positions in {GEO_TXT}", f"in the first line of {GEO_TXT}")
    done = {}
    for (name, line), (lon, lat) in zip(line_of.items(), where.tolist(), strict=True):
        header = headers[name]
        own, (x, y, height) = crs, line.place
        if math.isnan(height) and header.lat_lon_height is not None:
            # The height in EXIF has the datum of all heights in EXIF.
            own = horizontal_crs(crs)
            height = header.lat_lon_height[2] / _unit_m(own)
        done[name] = replace(
            header,
            lat_lon_height=(lat, lon, height * _unit_m(own)),
            table_place=TablePlace(GEO_TXT, own, (x, y, height), line.std_m),
            rtk=None,
            std_m=None,
            height_datum=header.height_datum if math.isnan(line.place[2]) else None,
            gps_fault="",
            is_void=False,
        )
    return done


def _unit_m(crs: CRS) -> float:
    """Unit [m] of the heights beside places in a CRS, which may have none of its own."""
    if has_height(crs):
        return height_unit_m(crs)
    return 1.0 if is_geographic(crs) else horizontal_unit(crs)


def _replaced(path: Path, crs: CRS, headers: Mapping[str, Exif], line_of: Mapping[str, _Line]) -> Findings:
    """Note on the replaced positions and their distance from the file's."""
    in_exif = {name: headers[name].lat_lon_height for name in line_of}
    replaced = {name: position for name, position in in_exif.items() if position is not None}
    message = f"positions of {len(line_of)} of {len(headers)} images are those in {path.name} ({crs.name})"
    if not replaced:
        return Findings((f"{message}; EXIF has none of them",))
    lat, lon = np.array([position[:2] for position in replaced.values()]).T
    own_lon, own_lat = lon_lat(crs, np.array([line_of[name].place for name in replaced])).T
    distance = float(np.median(Geod(ellps="WGS84").inv(lon, lat, own_lon, own_lat)[2]))
    message = f"{message}, instead of those in EXIF of {len(replaced)}, {distance:.2g} m away (median)"
    if not distance > SAME_PLACE_M:
        return Findings((message,))
    warning = (
        f"the positions in {path.name} lie {distance:.0f} m (median) from those in EXIF: check the CRS in its first "
        "line, and that easting or longitude comes first"
    )
    return Findings((message,), (warning,))


def _read(path: Path) -> tuple[CRS, list[_Line]]:
    crs, lines = odm_lines(path, GEO_TXT, _FORM, PosesError)
    if not lines:
        raise PosesError(f"{path} has no line after its CRS, expected lines {_FORM}; complete it, or remove it")
    return crs, [_line(line, where) for where, line in lines]


def _line(text: str, where: str) -> _Line:
    cells = [cell.strip() for cell in text.split("\t") if cell.strip()] if text.count("\t") > 1 else text.split()
    if len(cells) < 3 and "," in text:
        raise PosesError(f"{where}: values are separated by commas, expected spaces or tabs: {_FORM}; replace them")
    # A name may have spaces: it ends with the suffix of a photograph.
    ends = [i for i, cell in enumerate(cells, 1) if PurePosixPath(cell).suffix.lower() in SUFFIXES]
    end = ends[0] if ends else 1
    values = [number_of(cell) for cell in cells[end:]]
    count = next((count for count in reversed(_COUNTS) if count <= len(values)), 0)
    # What follows both accuracies has no meaning.
    if not count or (len(values) > count < _COUNTS[-1]) or not all(math.isfinite(value) for value in values[:count]):
        raise PosesError(f'{where}: "{text}" was found, expected {_FORM}; correct or remove the line')
    x, y, *heights = values[:count]
    return _Line(
        " ".join(cells[:end]),
        where,
        (x, y, heights[0] if heights else math.nan),
        _std(values[6:8], where) if count == _COUNTS[-1] else None,
        count == _COUNTS[-2],
    )


def _std(accuracies: list[float], where: str) -> tuple[float, float, float] | None:
    """Standard deviations [m]; None where both accuracies are 0, which programs write for unknown."""
    across, up = accuracies
    if across == up == 0.0:
        return None
    if not (0.0 < across <= _MOST_STD_M and 0.0 < up <= _MOST_STD_M):
        raise PosesError(
            f"{where}: the accuracy is {accuracies}, expected a standard deviation above 0 and at most {_MOST_STD_M:g} "
            "metres; leave both out if they are not known"
        )
    return across, across, up
