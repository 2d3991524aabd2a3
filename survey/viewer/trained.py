"""The field that `process --field slab` trained, as a browser's camera would see it."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from refract import PinholeCamera
from survey.viewer.detail import viewpoint_of
from survey.viewer.tree import Viewpoint

if TYPE_CHECKING:
    import viser

    from fields.slab.tensor_field import TensorField
    from refract import FlatWater

# Rows of a picture: a second or two of one core.
_ROWS = 200
_PAPER = 255


class TrainedField:
    """A field on the disk, loaded when it is first rendered.

    Parameters
    ----------
    folder : Path
        Of its stage.
    """

    def __init__(self, folder: Path):
        self._folder = folder

    @cached_property
    def _loaded(self) -> tuple[TensorField, FlatWater | None]:
        # They take torch.
        from fields.device import choose_device
        from survey.run.stored_field import load_field, load_place

        return load_field(self._folder, choose_device("auto")), load_place(self._folder)[1]

    def picture(self, view: Viewpoint, *, dry: bool) -> np.ndarray:
        """What a viewpoint sees (rows, columns, 3) uint8, white where there is no bed; ``dry``: along straight rays.

        Raises
        ------
        SurveyError
            If the file of the field is damaged.
        """
        from fields.slab.novel_view import render_view

        field, water = self._loaded
        seen = render_view(field, camera_of(view, _ROWS), water, dry=dry)
        return np.where(seen.seen[..., None], seen.rgb, np.uint8(_PAPER))


def camera_of(view: Viewpoint, rows: int) -> PinholeCamera:
    """The camera of a viewpoint with so many rows of pixels."""
    focal = view.focal_px * rows / view.height_px
    columns = max(round(rows * view.aspect), 1)
    return PinholeCamera(
        view.position, view.cam_from_local, focal, focal, 0.5 * columns, 0.5 * rows, columns, rows
    )  # fmt: skip


def add_field(server: viser.ViserServer, field: TrainedField, show: Callable[[np.ndarray], None]) -> None:
    """A button in the panel that renders a field from where a browser looks; ``show`` gets the picture."""
    with server.gui.add_folder("trained field"):
        wet = server.gui.add_checkbox("through the water", False)
        button = server.gui.add_button("render from here")

    @button.on_click
    def render(event: viser.GuiEvent) -> None:
        if event.client is None:
            return
        said = event.client.add_notification("trained field", "is being rendered", loading=True)
        try:
            show(field.picture(viewpoint_of(event.client.camera), dry=not wet.value))
        finally:
            said.remove()
