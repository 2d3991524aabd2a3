"""Headers of the photographs of a survey, with the positions of a geo.txt, and what in them is more likely a mistake.

A geo.txt of OpenDroneMap replaces positions in EXIF. Its first line is the CRS; the others are ``image x y [z] [omega
phi kappa] [horizontal accuracy] [vertical accuracy]``, easting or longitude first. As there, angles are not used.
"""

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path, PurePosixPath

import numpy as np
from pyproj import CRS, Geod
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from geo.compatibility import require_in_area
from geo.crs import EARTH_RADIUS_M, has_height, height_unit_m, horizontal_crs, horizontal_unit, is_geographic
from geo.transformation import lon_lat
from survey.display.quantities import listed, named
from survey.errors import Findings, PosesError
from survey.files.csv_table import number_of
from survey.files.foreign_text import odm_lines
from survey.photos.exif import SUFFIXES, Exif, TablePlace, read_exif, without_void_fixes
from survey.photos.images import bands_beside
from survey.photos.poses import ImageNames
from survey.settings.config import SurveyConfig
from survey.words import GEO_TXT

_FORM = "image x y [z] [omega phi kappa] [horizontal accuracy] [vertical accuracy]"
# How many numbers a line may have: x y, z, three angles, accuracies.
_COUNTS = (2, 3, 6, 7, 8)
_MOST_STD_M = 100.0
# GPS positions without corrections are within 10 m: beyond this they are of another zone or datum.
SAME_PLACE_M = 100.0
# A position is far from the others beyond this many times their usual spread, and these lengths [m]. If more than this
# share of positions is far, they are another part of the flight.
_FAR, _FAR_HEIGHT_M, _FAR_PLAN_M, _MOST_FAR = 10.0, 10.0, 50.0, 0.1
_FEWEST = 4
# Gap beyond which positions are of another survey [m].
_ELSEWHERE_M = 5000.0
# Receivers give one position per second, and camera clocks have whole seconds.
_BETWEEN_FIXES_S = 2.0
# Cameras of one payload are released within this.
_ONE_SHOT_S = 1.0
# Photographs of a burst, as of a hover, are as close together, and as soon after the first of them.
_BURST_M, _BURST_TIME = 0.3, timedelta(seconds=10)
# Longer gaps than that of a night lie between days.
_NEXT_DAY = timedelta(hours=8)


def read_headers(folder: Path, place: Path, images: Mapping[str, Path]) -> tuple[dict[str, Exif], Findings]:
    """EXIF of the photographs in a place of a survey folder, with the positions of a geo.txt where there is one."""
    headers, findings = {name: read_exif(path) for name, path in images.items()}, Findings()
    if (table := find_geo_txt(folder, place)) is not None:
        headers, findings = with_positions(table, headers)
    headers = without_void_fixes(headers)
    names = bands_beside(images)
    bands = f"{len(names)} images of single bands beside photographs, left out: {listed(names, 2)}"
    return headers, findings + Findings(assumptions=(*[bands] * bool(names), *burst_notes(headers)))


def find_geo_txt(folder: Path, images: Path) -> Path | None:
    """The geo.txt in the survey folder or next to the photographs; None where there is none."""
    places = [place for place in dict.fromkeys((folder, images)) if place.is_dir()]
    paths = [path for place in places for path in sorted(place.iterdir()) if path.name.casefold() == GEO_TXT]
    paths = [path for path in paths if path.is_file()]
    if len(paths) > 1:
        raise PosesError(f"{paths[0]} and {paths[1]} both have positions of the photographs; remove one of them")
    return paths[0] if paths else None


@dataclass(frozen=True)
class _Line:
    """A photograph with its position, as one line of a geo.txt has it."""

    image: str
    where: str
    place: tuple[float, float, float]
    std_m: tuple[float, float, float] | None
    lacks_vertical: bool


def with_positions(path: Path, headers: Mapping[str, Exif]) -> tuple[dict[str, Exif], Findings]:
    """Heads of photographs with the positions of a geo.txt; those that it does not name keep the ones in EXIF."""
    crs, texts = odm_lines(path, GEO_TXT, _FORM, PosesError)
    if not texts:
        raise PosesError(f"{path} has no line after its CRS, expected lines {_FORM}; complete it, or remove it")
    names, lines, unknown = ImageNames(headers), dict[str, _Line](), []
    parsed = [_line(text, where) for where, text in texts]
    for line in parsed:
        name = names.find(line.image, line.where)
        if name is None:
            unknown.append(line.image)
        elif name in lines:
            raise PosesError(f"{line.where}: {name} has a second position; remove one of the two lines")
        else:
            lines[name] = line
    if not lines:
        raise PosesError(
            f'{path} names none of the photographs: "{parsed[0].image}" for "{next(iter(headers))}"; correct its '
            "names, or remove the file where it is of another flight"
        )
    lacking = [name for name, line in lines.items() if line.lacks_vertical]
    warnings = [
        *named(unknown, "image", f"of {path.name} not among the photographs"),
        *named([n for n in headers if n not in lines], "image", f"not in {path.name}, which keep what EXIF has"),
        *named(lacking, "image", f"with a horizontal accuracy alone in {path.name}, which is not used"),
    ]
    places = dict(zip(lines, _lon_lat(lines.values(), crs), strict=True))
    placed = {name: _placed(headers[name], line, crs, *places[name]) for name, line in lines.items()}
    note = f"positions of {len(lines)} of {len(headers)} images are those in {path.name} ({crs.name})"
    in_exif = {name: position for name in lines if (position := headers[name].lat_lon_height) is not None}
    if in_exif:
        lat, lon = np.array([position[:2] for position in in_exif.values()]).T
        away_m = float(np.median(Geod(ellps="WGS84").inv(lon, lat, *np.array([places[n] for n in in_exif]).T)[2]))
        note += f", instead of those in EXIF of {len(in_exif)}, {away_m:.2g} m away (median)"
        if away_m > SAME_PLACE_M:
            warnings.append(
                f"the positions in {path.name} lie {away_m:.0f} m (median) from those in EXIF: check the CRS in its "
                "first line, and that easting or longitude comes first"
            )
    else:
        note += "; EXIF has none of them"
    return dict(headers) | placed, Findings((note,), tuple(warnings))


def _lon_lat(lines: Iterable[_Line], crs: CRS) -> list[list[float]]:
    """Longitude and latitude [deg] of the places of lines; raises where one is not on the map."""
    lines = list(lines)
    in_crs = np.array([line.place for line in lines])
    places = lon_lat(crs, in_crs)
    on_map = np.isfinite(places).all(axis=1) & (np.abs(places) <= [180.0, 90.0]).all(axis=1)
    if not on_map.all():
        line = lines[int(np.argmin(on_map))]
        raise PosesError(
            f"{line.where}: {line.place[0]:.10g}, {line.place[1]:.10g} is not on the map of {crs.name}; correct "
            "the coordinates, their order (easting or longitude first) or the CRS in the first line"
        )
    require_in_area(crs, in_crs, f"the positions in {GEO_TXT}", f"in the first line of {GEO_TXT}")
    return places.tolist()


def _placed(header: Exif, line: _Line, crs: CRS, lon: float, lat: float) -> Exif:
    """The header of a photograph at the place of its line; without a height there, that in EXIF, and its datum."""
    x, y, height = line.place
    if keeps_height := math.isnan(height) and header.lat_lon_height is not None:
        crs = horizontal_crs(crs)
    # A CRS without heights of its own has them in the unit of its plan.
    unit_m = height_unit_m(crs) if has_height(crs) else 1.0 if is_geographic(crs) else horizontal_unit(crs)
    if keeps_height and header.lat_lon_height is not None:
        height = header.lat_lon_height[2] / unit_m
    return replace(
        header,
        lat_lon_height=(lat, lon, height * unit_m),
        table_place=TablePlace(GEO_TXT, crs, (x, y, height), line.std_m),
        rtk=None,
        std_m=None,
        height_datum=header.height_datum if math.isnan(line.place[2]) else None,
        gps_fault="",
        is_void=False,
    )


def _line(text: str, where: str) -> _Line:
    cells = [cell.strip() for cell in text.split("\t") if cell.strip()] if text.count("\t") > 1 else text.split()
    if len(cells) < 3 and "," in text:
        raise PosesError(f"{where}: values are separated by commas, expected spaces or tabs: {_FORM}; replace them")
    # A name may have spaces: it ends with the suffix of a photograph.
    end = next((i for i, cell in enumerate(cells, 1) if PurePosixPath(cell).suffix.lower() in SUFFIXES), 1)
    values = [number_of(cell) for cell in cells[end:]]
    count = next((count for count in reversed(_COUNTS) if count <= len(values)), 0)
    # What follows both accuracies has no meaning.
    if not count or (len(values) > count < _COUNTS[-1]) or not all(map(math.isfinite, values[:count])):
        raise PosesError(f'{where}: "{text}" was found, expected {_FORM}; correct or remove the line')
    std, has_stds = None, count == _COUNTS[-1]
    # Programs write 0 for unknown.
    if has_stds and values[6:8] != [0.0, 0.0]:
        if not all(0.0 < value <= _MOST_STD_M for value in values[6:8]):
            raise PosesError(
                f"{where}: the accuracy is {values[6:8]}, expected a standard deviation above 0 and at most "
                f"{_MOST_STD_M:g} metres; leave both out if they are not known"
            )
        std = (values[6], values[6], values[7])
    height = values[2] if count > 2 else math.nan
    return _Line(" ".join(cells[:end]), where, (values[0], values[1], height), std, count == _COUNTS[-2])


def header_warnings(config: SurveyConfig, headers: Mapping[str, Exif]) -> list[str]:
    """Warnings about EXIF of the photographs."""
    faults, datums, focals = defaultdict(list), defaultdict(list), defaultdict(list)
    for name, header in headers.items():
        faults[header.gps_fault].append(name)
        datums["" if header.table_place is not None else header.gps_datum].append(name)
        focals[header.focal_warning].append(name)
    warnings = []
    for names, noun in (
        *((faults[fault], f"without {fault} in EXIF, whose GPS position is not used") for fault in faults if fault),
        (
            [name for name, header in headers.items() if header.is_void and header.lat_lon_height is not None],
            "whose receiver had no fix by EXIF (GPSStatus is V), and whose position is used",
        ),
        *((datums[d], f"with a GPS position on {d} by EXIF or XMP, which is taken as WGS 84") for d in datums if d),
        *((focals[f], f"with {f}; give [cameras] focal_px if it is known") for f in focals if f),
    ):
        warnings += named(names, "image", noun)
    num = len(headers)
    if rotated := sum(header.orientation != 1 for header in headers.values()):
        warnings.append(f"EXIF marks {rotated} of {num} images as rotated; pixels and poses are taken as stored")
    if paged := sum(header.has_pages for header in headers.values()):
        warnings.append(f"{paged} of {num} images have several pages, of which the first is used; split files of bands")
    return [*warnings, *position_warnings(headers), *_several_cameras(headers), *_several_days(config, headers)]


def position_warnings(headers: Mapping[str, Exif]) -> list[str]:
    """Warnings that name the photographs whose GPS position or height lies far from all others, or is that of one."""
    known = {name: header for name, header in headers.items() if header.lat_lon_height is not None}
    if len(known) < _FEWEST:
        return []
    names, places = np.array(list(known)), _metres(known)
    clocks = [header.clock for header in known.values() if header.clock is not None]
    seconds = None
    if len(clocks) == len(known):
        seconds = np.array([(clock - clocks[0]).total_seconds() for clock in clocks])
    # Poses that also share their rotation are reported where poses are read.
    repeated = _repeated_positions(names, places, seconds)
    return [*far_from_others(names, places[:, :2], places[:, 2], "GPS"), *repeated]


def _metres(known: Mapping[str, Exif]) -> np.ndarray:
    """Northings, eastings and heights (N, 3) [m] of photographs with a GPS position, about the first."""
    places = np.array([header.lat_lon_height for header in known.values()])
    # Longitudes are unwrapped across the antimeridian.
    east_deg = places[:, 1] - places[0, 1]
    metres = EARTH_RADIUS_M * np.radians(np.column_stack([places[:, 0], (east_deg + 180.0) % 360.0 - 180.0]))
    metres[:, 1] *= np.cos(np.radians(np.median(places[:, 0])))
    return np.column_stack([metres, places[:, 2]])


def burst_notes(headers: Mapping[str, Exif]) -> tuple[str, ...]:
    """A sentence on bursts, as of a hover, and what is made of them; none where there are none."""
    known = sorted((header.clock, name) for name, header in headers.items() if header.clock and header.lat_lon_height)
    if not known or len({headers[name].lat_lon_height for _, name in known}) == 1:
        return ()
    clocks, places = [clock for clock, _ in known], _metres({name: headers[name] for _, name in known})
    first, sizes = 0, [0]
    for number, clock in enumerate(clocks):
        # Heights may be unknown.
        apart_m = np.linalg.norm(np.nan_to_num(places[number] - places[first]))
        if clock - clocks[first] > _BURST_TIME or apart_m > _BURST_M:
            first = number
            sizes.append(0)
        # Cameras of a rig share the time, and photographs between two fixes the position.
        between_s = _ONE_SHOT_S if apart_m else _BETWEEN_FIXES_S
        sizes[-1] += number == first or (clock - clocks[number - 1]).total_seconds() > between_s
    if not (bursts := [size for size in sizes if size > 1]):
        return ()
    some = f"{len(bursts)} bursts of up to {max(bursts)}" if len(bursts) > 1 else f"a burst of {bursts[0]}"
    return (f"{some} images, each of one place within 10 s: they are matched with images of other places",)


def far_from_others(names: np.ndarray, plan: np.ndarray, height: np.ndarray, by: str) -> list[str]:
    """Warnings that name the photographs whose place (N, 2) or height (N,) [m], NaN where unknown, is far from all.

    ``by`` is their source, "GPS" or "pose".
    """
    if len(names) < _FEWEST:
        return []
    main = _largest_group(plan)
    warnings = named(names[~main].tolist(), "image", f"kilometres away from the others by {by}: of another survey?")
    nearest = KDTree(plan).query(plan, k=2)[0][:, 1]
    alone = main & (nearest > max(_FAR * float(np.median(nearest)), _FAR_PLAN_M))
    warnings += named(_few(names, alone), "image", f"far from all others by its {by} position")
    names, height = names[np.isfinite(height)], height[np.isfinite(height)]
    if len(height) < _FEWEST:
        return warnings
    deviation = np.abs(height - np.median(height))
    far = deviation > max(_FAR * float(np.median(deviation)), _FAR_HEIGHT_M)
    # Exactly 0 is what receivers write without a height: no other flight, however many have it.
    no_height = far & (height == 0.0)
    low, high = height[~far].min(), height[~far].max()
    labels = np.array([f"{name} ({metres:.1f} m)" for name, metres in zip(names, height, strict=True)])
    labels = labels[no_height].tolist() + _few(labels, far & ~no_height)
    why = f"far from the others by its {by} height, which are at {low:.1f} to {high:.1f} m"
    return warnings + named(labels, "image", why)


def _few(names: np.ndarray, far: np.ndarray) -> list[str]:
    """Names of the far photographs, where these are few enough to be wrong."""
    return names[far].tolist() if far.sum() <= max(1, int(_MOST_FAR * len(names))) else []


def _repeated_positions(names: np.ndarray, places: np.ndarray, seconds: np.ndarray | None) -> list[str]:
    """Warnings about photographs (N,) of one position (N, 3), not taken at once as bands, brackets, rigs and bursts.

    Heights may differ: rounding to whole seconds leaves one latitude and longitude.
    """
    alike = defaultdict(list)
    for number, place in enumerate(places[:, :2]):
        alike[place.tobytes()].append(number)
    if len(alike) == 1:
        return [f"all {len(names)} images have the same latitude and longitude to the last digit: no positions"]
    repeated = [
        number
        for first, *others in alike.values()
        for number in others
        if seconds is None or abs(seconds[number] - seconds[first]) > _BETWEEN_FIXES_S
    ]
    return named(names[repeated].tolist(), "image", "with the GPS position of an earlier one to the last digit")


def _largest_group(plan: np.ndarray) -> np.ndarray:
    """Mask (N,) bool of the places (N, 2) [m] of the largest group. Groups are at least `_ELSEWHERE_M` apart."""
    squares, square = np.unique(np.floor(plan / _ELSEWHERE_M), axis=0, return_inverse=True)
    adjacent = np.array(list(KDTree(squares).query_pairs(1.0, p=np.inf))).reshape(-1, 2)
    linked = coo_array((np.ones(len(adjacent)), tuple(adjacent.T)), shape=(len(squares), len(squares)))
    group = connected_components(linked, directed=False)[1][square.ravel()]
    return group == np.bincount(group).argmax()


def _several_cameras(headers: Mapping[str, Exif]) -> list[str]:
    """A warning where most shots have photographs of several sizes: of a thermal or multispectral camera, too."""
    shots, stems = defaultdict[tuple, set](set), defaultdict[tuple[int, int], list[str]](list)
    for name, header in headers.items():
        stem = PurePosixPath(name).stem
        # Photographs of one shot share the last number in their names.
        numbers = "".join(letter if letter.isdigit() else " " for letter in stem).split()
        clock = None if header.clock is None else round(header.clock.timestamp() / _ONE_SHOT_S)
        shots[clock, name.rpartition("/")[0] if clock is None else "", *numbers[-1:]].add(header.size_px)
        stems[header.size_px].append(stem)
    if len(stems) < 2 or 2 * sum(len(sizes) > 1 for sizes in shots.values()) < len(shots):
        return []
    kinds = []
    for (width, height), own in sorted(stems.items(), key=lambda item: -len(item[1])):
        endings = {stem.rpartition("_")[2] for stem in own}
        kinds.append(f"{len(own)} of {width} x {height} px" + (f" (*_{endings.pop()})" if len(endings) == 1 else ""))
    return [f"each shot has photographs of several cameras: {' and '.join(kinds)}; keep one, as others do not match"]


def _several_days(config: SurveyConfig, headers: Mapping[str, Exif]) -> list[str]:
    """A warning where one level is given for photographs of several days."""
    water = config.water
    if water is None or not water.gives_level or water.level_rate_m_per_h is not None:
        return []
    if water.gauge is not None or water.image_levels is not None:
        return []
    days: list[list[datetime]] = []
    for time in sorted(clock for header in headers.values() if (clock := header.clock) is not None):
        if not days or time - days[-1][-1] > _NEXT_DAY:
            days.append([])
        days[-1].append(time)
    if len(days) < 2:
        return []
    said = ", ".join(f"{day[0]:%Y-%m-%d}: {len(day)}" for day in days[:5])
    return [f"photographs of {len(days)} days ({said}) have one level: give image_levels or gauge, or split the survey"]
