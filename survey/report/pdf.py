"""report.html as PDF, by WeasyPrint: a page for print without a browser."""

from __future__ import annotations

import logging
from pathlib import Path

from geo.errors import UnwritableFile
from geo.files import write_whole
from geo.optional import library_for

# Near the end of a PDF, where its metadata are.
MARK = b"bathynerf"
_TAIL_BYTES = 1 << 16


def write_pdf(html: Path, path: Path) -> None:
    """Write a page as PDF, A4, whole or not at all.

    Raises
    ------
    UnwritableFile
        If the file cannot be written, or WeasyPrint or Pango is not installed.
    """
    # It names each rule of the page that print does not need.
    logging.getLogger("weasyprint").setLevel(logging.ERROR)
    logging.getLogger("fontTools").setLevel(logging.ERROR)
    try:
        weasyprint = library_for(path, "weasyprint", "pdf", to_write=True)
    except OSError as error:
        raise UnwritableFile(
            f"{path} is set by WeasyPrint, which needs Pango, and that cannot be loaded. Debian, Ubuntu: apt-get "
            "install libpango-1.0-0 libpangoft2-1.0-0; macOS: brew install pango; or print report.html from a browser."
        ) from error
    content = weasyprint.HTML(filename=str(html)).write_pdf()
    with write_whole(path) as stream:
        stream.write(content)


def is_our_pdf(path: Path) -> bool:
    """Whether a file is a PDF that `write_pdf` wrote."""
    content = path.read_bytes()
    return content.startswith(b"%PDF") and MARK in content[-_TAIL_BYTES:]
