"""A run as one HTML file that opens without a server: `bathynerf view --export`."""

from __future__ import annotations

import html
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from geo.files import write_whole
from survey.display.quantities import number
from survey.errors import OutputError
from survey.files.outputs import ReadFiles, require_file
from survey.viewer.browser import close_server, open_server
from survey.viewer.layers import add_cameras, add_water, look_from
from survey.viewer.shown import SCALES, Shown
from survey.viewer.tree import CloudTree

if TYPE_CHECKING:
    import viser

# Points of a page: some 20 MB.
MOST_POINTS = 1_000_000
_SUFFIX, _MARK, _TITLE = ".html", b"Viser client", "<title>Viser</title>"


def require_page(path: Path, inputs: ReadFiles) -> None:
    """Raise OutputError where a page must not or cannot be written."""
    if path.suffix.lower() != _SUFFIX:
        raise OutputError(f"--export names {path}, expected a name that ends in {_SUFFIX}")
    require_file("--export", path, inputs, kind="a page that view wrote", is_of_kind=lambda head: _MARK in head)


def write_page(path: Path, shown: Shown) -> None:
    """Write water, cameras and the cloud by all that is known of it; of a large cloud a thinned part.

    Raises
    ------
    SurveyError
        If viser is not installed.
    UnwritableFile
        If the system refuses.
    """
    server = open_server("localhost", 0, shown.name)
    try:
        look_from(server, shown)
        add_water(server, shown)
        _, thumbnails = add_cameras(server, shown)
        _add_points(server, shown, thinned(shown.tree, MOST_POINTS))
        if thumbnails is not None:
            thumbnails.wait()
        page = server.scene.as_html().replace(_TITLE, f"<title>{html.escape(shown.name)}</title>", 1)
    finally:
        close_server(server)
    with write_whole(path) as stream:
        stream.write(page.encode())


def thinned(tree: CloudTree, most: int) -> np.ndarray:
    """Rows (K,) of at most so many points, evenly over the cloud: coarse nodes whole, of the next level every n-th."""
    level = np.round(np.log2(tree.side[0] / tree.side)).astype(np.int64)
    ends = np.cumsum(np.bincount(level, weights=tree.counts)).astype(np.int64)
    whole = int(np.searchsorted(ends, most, side="right"))
    done = int(ends[whole - 1]) if whole else 0
    rows = tree.order[:done]
    if whole == len(ends):
        return rows
    step = -((done - int(ends[whole])) // max(most - done, 1))
    return np.concatenate([rows, tree.order[done : ends[whole] : step]])[:most]


def _add_points(server: viser.ViserServer, shown: Shown, rows: np.ndarray) -> None:
    """The points once for each way to colour them, that of the photographs shown."""
    points = shown.tree.points[rows] - shown.middle
    size = shown.gsd_m * float(np.sqrt(len(shown.tree.points) / len(rows)))
    for kind in ("colour", *(kind for kind in SCALES if kind in shown.columns)):
        limits = shown.limits(kind)
        server.scene.add_point_cloud(
            f"/points by/{_name(kind, limits)}", points, shown.colours(kind, rows, limits), position=shown.middle,
            precision="float32", point_size=size, point_shape="circle", point_shading="flat",
            visible=kind == "colour",
        )  # fmt: skip


def _name(kind: str, limits: tuple[float, float] | None) -> str:
    """A name in the list of what is shown; it is the only legend of a page."""
    if limits is None:
        return "colour"
    scale = SCALES[kind]
    low, high = (number(value, 0 if kind == "num_views" else 3) for value in limits)
    return f"{scale.label}: {low} to {high} {scale.unit}".rstrip()
