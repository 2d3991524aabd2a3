"""XML of other programs as a tree; document types and entities are refused.

defusedxml does not bound the depth, and forbids no more than what stands here.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from pyproj import CRS

from survey.errors import SurveyError
from survey.files.crs_lines import crs_of_text

# No file of a program is nested further; a tree is walked by recursion.
_DEEPEST = 100


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
