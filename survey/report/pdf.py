"""report.html as PDF, by the Chromium, Chrome or Edge of the machine, which prints the page as it shows it."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

from geo.errors import UnwritableFile
from geo.files import write_whole

# After the end of the document, where readers look no further.
MARK = b"% bathynerf\n"
BROWSERS = (
    *("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome", "microsoft-edge", "msedge"),
    # Where it is no program of the path.
    "/Applications/Google Chrome.app/Contents/MacOS/Google Chrome",
    "/Applications/Microsoft Edge.app/Contents/MacOS/Microsoft Edge",
    "C:/Program Files/Google/Chrome/Application/chrome.exe",
    "C:/Program Files (x86)/Microsoft/Edge/Application/msedge.exe",
)
_MOST_S = 300.0


def write_pdf(html: Path, path: Path, *, browsers: Sequence[str] = BROWSERS) -> None:
    """Write a page as PDF, A4, whole or not at all, by the first of the browsers that is there: a name or a path.

    Raises
    ------
    UnwritableFile
        If the file cannot be written, or there is no browser, or it does not print.
    """
    browser = _first_of(browsers, path)
    with tempfile.TemporaryDirectory(prefix="bathynerf-pdf-") as work:
        printed = Path(work, "report.pdf")
        options = ["--headless", "--disable-gpu", "--no-first-run", "--no-pdf-header-footer", f"--user-data-dir={work}"]
        if getattr(os, "geteuid", lambda: 1)() == 0:
            # Chromium refuses its sandbox to root; the page is bathynerf's own and has no scripts.
            options.append("--no-sandbox")
        command = [browser, *options, f"--print-to-pdf={printed}", html.resolve().as_uri()]
        try:
            done = subprocess.run(command, capture_output=True, timeout=_MOST_S, check=False)
            said = done.stderr.decode("utf-8", "replace").strip().splitlines()[-1:]
        except (OSError, subprocess.TimeoutExpired) as error:
            said = [str(error)]
        if not printed.is_file():
            raise UnwritableFile(
                f"{path}: {browser} did not print {html} ({' '.join(said)[:200]}); open it in a browser and print it "
                "there."
            )
        content = printed.read_bytes()
    with write_whole(path) as stream:
        stream.write(content.rstrip(b"\n") + b"\n" + MARK)


def _first_of(browsers: Sequence[str], path: Path) -> str:
    found = next((place for name in browsers if (place := shutil.which(name)) is not None), None)
    if found is None:
        raise UnwritableFile(
            f"{path} is printed by Chromium, Chrome or Edge, and none was found; install one (Debian, Ubuntu: apt-get "
            "install chromium), or print report.html from another browser."
        )
    return found


def is_our_pdf(path: Path) -> bool:
    """Whether a file is a PDF that `write_pdf` wrote."""
    content = path.read_bytes()
    return content.startswith(b"%PDF") and content.endswith(MARK)
