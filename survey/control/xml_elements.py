"""XML of other programs as a tree, without what XML can be made to do: no document types, no entities of its own."""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from survey.errors import ControlError

# No file of a program is nested further; a tree is walked by recursion.
_DEEPEST = 100


def read_xml(path: Path) -> Element:
    """The root of an XML file.

    Raises
    ------
    ControlError
        If the file cannot be read, is no XML, declares a document type, or is nested more than 100 deep. Entities are
        declared in document types only, so that none grows, and none reads another file.
    """
    builder, depth = TreeBuilder(), 0
    parser = expat.ParserCreate()

    def refuse(*_):
        raise ControlError(
            f"{path}, line {parser.CurrentLineNumber}: a document type (<!DOCTYPE>) was found, expected none, as "
            "Metashape writes it; remove it, or export the markers again"
        )

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        if depth > _DEEPEST:
            raise ControlError(
                f"{path}, line {parser.CurrentLineNumber}: elements are nested more than {_DEEPEST} deep, expected the "
                "markers of Metashape; export them again"
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
    except (expat.ExpatError, ValueError, LookupError) as error:
        if isinstance(error, ControlError):
            raise
        raise ControlError(f"{path} is not whole XML ({error}); export the markers again") from error
    except OSError as error:
        raise ControlError(f"{path} cannot be read ({error.strerror}); correct its name or its permissions") from error
    return builder.close()
