"""A trained field of a run, as a browser's camera would see it."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING

import numpy as np

from refract import PinholeCamera
from survey.viewer.tree import Viewpoint

if TYPE_CHECKING:
    from fields.views.novel_view import NovelView
    from survey.export.loaded import LoadedRun

# Rows of a picture: a second or two of one core.
_ROWS = 200
_PAPER = 255
# What a camera sees of a field, with the water or (True) without it.
Render = Callable[[PinholeCamera, bool], "NovelView"]


class TrainedField:
    """A field on the disk, loaded when it is first rendered.

    Parameters
    ----------
    name : str
        As the panel has it.
    load : callable
        Gives what renders it; gets a function that is told what there is to note.

    Attributes
    ----------
    notes : list of str
        What there was to note when it was loaded.
    """

    def __init__(self, name: str, load: Callable[[Callable[[str], None]], Render]):
        self.name, self.notes, self._load = name, list[str](), load
        # Every click has a thread of its own.
        self._lock = Lock()

    @staticmethod
    def slab(folder: Path) -> TrainedField:
        """The field that `process --field slab` left in the folder of its stage."""
        return TrainedField("slab", lambda _note: _slab(folder))

    @staticmethod
    def volume(folder: Path, run: LoadedRun) -> TrainedField:
        """The field that `bathynerf field` left in a folder; see `survey.volume.stored.StoredVolume`.

        Raises
        ------
        SurveyError
            If the folder has none, or one of another run.
        """
        # It takes torch.
        from survey.volume.stored import StoredVolume

        stored = StoredVolume.of_run(folder, run)
        return TrainedField(stored.recipe.model, lambda note: stored.load(note=note))

    @cached_property
    def _render(self) -> Render:
        return self._load(self.notes.append)

    def picture(self, view: Viewpoint, *, dry: bool) -> np.ndarray:
        """Rendering from a viewpoint (rows, columns, 3) uint8, white where no bed is; ``dry``: along straight rays.

        Raises
        ------
        SurveyError
            If the file of the field is damaged.
        """
        with self._lock:
            seen = self._render(camera_of(view, _ROWS), dry)
        return np.where(seen.seen[..., None], seen.rgb, np.uint8(_PAPER))


def _slab(folder: Path) -> Render:
    from fields.device import choose_device
    from fields.slab.novel_view import render_view
    from survey.run.stored_field import load_field, load_place

    field, water = load_field(folder, choose_device("auto")), load_place(folder)[1]
    return lambda camera, dry: render_view(field, camera, water, dry=dry)


def camera_of(view: Viewpoint, rows: int) -> PinholeCamera:
    """The camera of a viewpoint with so many rows of pixels."""
    focal = view.focal_px * rows / view.height_px
    columns = max(round(rows * view.aspect), 1)
    return PinholeCamera(
        view.position, view.cam_from_local, focal, focal, 0.5 * columns, 0.5 * rows, columns, rows
    )  # fmt: skip
