"""The report as PDF, A4, printed by the Chromium, Chrome or Edge of the machine."""

import os
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

from geo.errors import UnwritableFile
from geo.files import write_whole
from survey.export.loaded import LoadedRun
from survey.export.registry import ExportOptions

BROWSERS = (
    "chromium-headless-shell", "chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome",
    "microsoft-edge", "msedge",
    # Where it is no program of the path.
    "/Applications/Google Chrome.app/Contents/MacOS/Google Chrome",
    "/Applications/Microsoft Edge.app/Contents/MacOS/Microsoft Edge",
    "C:/Program Files/Google/Chrome/Application/chrome.exe",
    "C:/Program Files (x86)/Microsoft/Edge/Application/msedge.exe",
)  # fmt: skip
_MOST_S = 300.0


def write_pdf(path: Path, run: LoadedRun, _options: ExportOptions) -> None:
    """report.html, printed by a browser."""
    print_page(run.folder.report_html_path, path)


def check_pdf(path: Path, _run: LoadedRun, _options: ExportOptions) -> None:
    """Raise UnwritableFile without a browser."""
    _browser_for(path, BROWSERS)


def print_page(html: Path, path: Path, *, browsers: Sequence[str] = BROWSERS) -> None:
    """Write a page as PDF, whole or not at all, by the first of the browsers that is there: a name or a path."""
    browser = _browser_for(path, browsers)
    with tempfile.TemporaryDirectory(prefix="bathynerf-pdf-") as work:
        printed = Path(work, "report.pdf")
        options = ["--headless", "--disable-gpu", "--no-first-run", "--no-pdf-header-footer", f"--user-data-dir={work}"]
        if getattr(os, "geteuid", lambda: 1)() == 0:
            # Chromium refuses its sandbox to root; the page is bathynerf's own and has no scripts.
            options.append("--no-sandbox")
        command = [browser, *options, f"--print-to-pdf={printed}", html.resolve().as_uri()]
        try:
            done = subprocess.run(command, capture_output=True, timeout=_MOST_S, check=False)
            reason = done.stderr.decode("utf-8", "replace").strip().splitlines()[-1:]
        except (OSError, subprocess.TimeoutExpired) as error:
            reason = [str(error)]
        if not printed.is_file():
            raise UnwritableFile(
                f"{path}: {browser} did not print {html} ({' '.join(reason)[:200]}); open it in a browser and print it "
                "there."
            )
        content = printed.read_bytes()
    with write_whole(path) as stream:
        stream.write(content)


def _browser_for(path: Path, browsers: Sequence[str]) -> str:
    found = next((place for name in browsers if (place := shutil.which(name)) is not None), None)
    if found is None:
        raise UnwritableFile(
            f"{path} is printed by Chromium, Chrome or Edge, and none was found; install one (Debian, Ubuntu: apt-get "
            "install chromium), or print report.html from another browser."
        )
    return found
