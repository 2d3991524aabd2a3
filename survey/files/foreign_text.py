"""Text files of other programs: JSON, XML as a tree, and the CRS in comments, first lines and XML.

In XML document types and entities are refused; defusedxml does not bound the depth, and forbids no more.
"""

import csv
import itertools
import json
import math
import re
from pathlib import Path
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from pyproj import CRS
from pyproj.exceptions import CRSError

from geo.crs import crs_of
from survey.errors import SurveyError
from survey.files.csv_table import number_of, text_lines
from survey.words import LARGEST

# No file of a program is nested further; a tree is walked by recursion.
_DEEPEST = 100
_COMMENT = re.compile(r"#\s*CoordinateSystem:\s*(.+)", re.IGNORECASE)
# A comment that is nothing but a code, under one of the names that people have for it.
_CODE = re.compile(
    r"(?:#|//)\s*(?:(?:crs|srs|srid|projection|coordinates?(?: reference)?(?: system)?)(?: in| is)?\s*[:=]?\s*)?"
    r"(EPSG\s*[:=]\s*\d+(?:\+\d+)?)",
    re.IGNORECASE,
)
_SRID = re.compile(r"(?:#|//)\s*SRID\s*[:=]\s*(\d+)", re.IGNORECASE)
_UTM = re.compile(r"WGS\s*84\s+UTM\s+(\d{1,2})\s*([NS])", re.IGNORECASE)
# OpenSfM's word for longitude and latitude.
_WGS84 = re.compile(r"WGS\s*84", re.IGNORECASE)
_EPSG = re.compile(r"EPSG:\s*(\d{1,9}(?:\+\d{1,9})?)", re.IGNORECASE)
_FORM = 'e.g. "EPSG:25832", "WGS84 UTM 32N" or "+proj=utm +zone=32 +datum=WGS84"'


def crs_of_comment(path: Path, error: type[SurveyError]) -> CRS | None:
    """The CRS in a line ``# CoordinateSystem: WKT or code``, ``# EPSG:code`` or ``# crs = EPSG:code``, or a column crs.

    The column has it in the first row, as `bathynerf export` writes tables. None where there is none, one of the site,
    or a datum of heights alone; ``error`` where it is not known.
    """
    lines = (line.strip() for _, line in text_lines(path, error))
    found = next((named for line in lines if (named := _crs_named(line)) is not None), None)
    if found is None:
        head, *rows = csv.reader(line for _, line in itertools.islice(text_lines(path, error), 2))
        found = dict(zip(head, rows[0], strict=False)).get("crs") if rows else None
    remedy = "correct the comment, or remove it where coordinates are in the crs of survey.toml"
    crs = crs_of_text(found, str(path), remedy, error)
    # A comment on what heights count from does not tell where places are.
    return None if crs is None or (crs.is_vertical and not crs.is_compound) else crs


def crs_of_text(text: str | None, where: str, remedy: str, error: type[SurveyError]) -> CRS | None:
    """The CRS that a file names at a place; None where it names none, or one of the site alone."""
    text = (text or "").strip()
    if not text or any(local in text for local in ("LOCAL_CS", "ENGCRS")):
        return None
    try:
        return crs_of(text)
    except CRSError as wrong:
        raise error(f'{where}: "{text}" is not a known CRS; {remedy}') from wrong


def _crs_named(line: str) -> str | None:
    """CRS that a line of a file names."""
    if match := _COMMENT.match(line):
        return match[1]
    if match := _SRID.fullmatch(line):
        return f"EPSG:{match[1]}"
    match = _CODE.fullmatch(line)
    return None if match is None else re.sub(r"\s*[:=]\s*", ":", match[1])


def is_odm_crs(line: str) -> bool:
    """Whether a line has the form of one that names a CRS."""
    return "+proj" in line or any(known.fullmatch(line) for known in (_UTM, _EPSG, _WGS84))


def odm_lines(path: Path, name: str, form: str, error: type[SurveyError]) -> tuple[CRS, list[tuple[str, str]]]:
    """The CRS in the first line of a file of OpenDroneMap, and the lines after it, each behind its place in the file.

    Lines that are empty or comments (#) are left out; ``name`` and ``form`` are those of the file, for errors.
    """
    every = ((f"{path}, line {number}", line.strip()) for number, line in text_lines(path, error))
    lines = [(where, line) for where, line in every if line and not line.startswith("#")]
    if not lines:
        raise error(f"{path} is empty, expected a line with its CRS, then lines {form}; write it again")
    (where, first), *others = lines
    return odm_crs(first, where, name, error), others


def odm_crs(line: str, where: str, name: str, error: type[SurveyError]) -> CRS:
    """The CRS that a line names, without blanks around it; ``where`` and ``name`` tell line and file in an error."""
    if _WGS84.fullmatch(line):
        return CRS.from_epsg(4326)
    utm, epsg = _UTM.fullmatch(line), _EPSG.fullmatch(line)
    message = f'{where}: "{line}"'
    if utm is not None:
        zone = int(utm[1])
        if not 1 <= zone <= 60:
            raise error(f"{message} is not a UTM zone, expected 1 to 60; correct it")
        return CRS.from_epsg((32600 if utm[2].upper() == "N" else 32700) + zone)
    if not is_odm_crs(line):
        if sum(math.isfinite(number_of(word)) for word in line.split()) > 1:
            raise error(f"{message} is a line of a point, expected the CRS before it, {_FORM}; add it")
        raise error(f"{message} is not a CRS that {name} may begin with, expected {_FORM}; correct it")
    try:
        crs = crs_of(f"EPSG:{epsg[1]}" if epsg is not None else line.strip("'\""))
    except CRSError as wrong:
        raise error(f"{message} is not a known CRS, expected {_FORM}; correct it") from wrong
    if not (crs.is_projected or crs.is_geographic):
        raise error(f"{message} is {crs.name}, expected a CRS of a map or of degrees, {_FORM}; correct it")
    return crs


def read_xml(path: Path, content: str, error: type[SurveyError]) -> Element:
    """The root of an XML file of Metashape; ``content`` is what to export again, e.g. "the markers"."""
    builder, depth = TreeBuilder(), 0
    parser = expat.ParserCreate()

    def refuse(*_):
        raise error(
            f"{path}, line {parser.CurrentLineNumber}: a document type (<!DOCTYPE>) was found, expected none, as "
            f"Metashape writes it; remove it, or export {content} again"
        )

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        if depth > _DEEPEST:
            raise error(
                f"{path}, line {parser.CurrentLineNumber}: elements are nested more than {_DEEPEST} deep, expected "
                f"{content} of Metashape; export them again"
            )
        builder.start(tag, attributes)

    def end(tag: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(tag)

    parser.StartDoctypeDeclHandler = refuse
    parser.StartElementHandler, parser.EndElementHandler, parser.CharacterDataHandler = start, end, builder.data
    try:
        parser.Parse(path.read_bytes(), True)
    except SurveyError:
        raise
    except (expat.ExpatError, ValueError, LookupError) as problem:
        raise error(f"{path} is not well-formed XML ({problem}); export {content} again") from problem
    except OSError as problem:
        raise error(f"{path} cannot be read ({problem.strerror}); correct its name or its permissions") from problem
    return builder.close()


def read_chunk(path: Path, inner: str, content: str, error: type[SurveyError]) -> Element:
    """The one chunk of an XML file of Metashape that has elements of this path in it; its root if that alone has."""
    root = read_xml(path, f"the {content}", error)
    chunks = [chunk for chunk in root.iter("chunk") if chunk.find(f".//{inner}") is not None]
    if not chunks and root.find(f".//{inner}") is not None:
        return root
    if not chunks:
        raise error(f"{path} has no {content}, expected those of Metashape; export them again")
    if len(chunks) > 1:
        raise error(f"{path} has {content} of {len(chunks)} chunks, expected one; export one of them alone")
    return chunks[0]


def crs_of_chunk(chunk: Element, content: str, path: Path, error: type[SurveyError]) -> CRS | None:
    """The CRS of the reference of the cameras or markers of a chunk, or of the chunk; None without one on Earth."""
    places = (chunk.find(f"{content}/reference"), chunk.find("reference"))
    text = next((tag.text for tag in places if tag is not None), None)
    return crs_of_text(text, f"{path}: the reference", f"set one in Metashape and export the {content} again", error)


def read_foreign_json(path: Path, error: type[SurveyError]):
    """The value in a JSON file of another program, in UTF-8 with or without a byte order mark.

    Numbers of more digits than any has become what float makes of them, infinity included.
    """
    try:
        text = path.read_bytes().decode("utf-8-sig")
        return json.loads(text, parse_int=lambda digits: int(digits) if len(digits) < 20 else float(digits))
    except OSError as problem:
        raise error(f"{path} cannot be read ({problem.strerror}); correct its name or its permissions") from problem
    except RecursionError as problem:
        raise error(f"{path} is nested too deeply for a file of poses or control points; export it again") from problem
    except ValueError as problem:
        raise error(f"{path} is not valid JSON ({problem}); export it again") from problem


def finite_numbers(value, count: int) -> list[float] | None:
    """A list of so many finite numbers from JSON; None if it is anything else."""
    if not isinstance(value, list | tuple) or len(value) != count:
        return None
    found = [finite_number(item) for item in value]
    return None if None in found else [number for number in found if number is not None]


def finite_number(value) -> float | None:
    """A finite number from JSON of at most `LARGEST` in size; None if it is anything else."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= LARGEST:
        return None
    return float(value)
