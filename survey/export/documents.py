"""The report of a run as PDF."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from survey.export.product import ExportOptions, Product

if TYPE_CHECKING:
    from survey.export.loaded import LoadedRun


def _is_our_pdf(path: Path) -> bool:
    from survey.report.pdf import is_our_pdf

    return is_our_pdf(path)


def _write(path: Path, run: LoadedRun, _options: ExportOptions) -> None:
    from survey.report.pdf import write_pdf

    write_pdf(run.folder.report_html_path, path)


DOCUMENTS = (
    Product(
        option="pdf",
        suffixes=(".pdf",),
        kind="a report that bathynerf wrote",
        help="report.html as PDF, A4 (by Chromium, Chrome or Edge).",
        example="--pdf report.pdf",
        takes=(),
        is_ours=_is_our_pdf,
        write=_write,
    ),
)
