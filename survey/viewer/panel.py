"""The panel beside the scene: what the points' colours mean, and what is shown."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from survey.display.quantities import count, number
from survey.errors import SurveyError
from survey.viewer.detail import Style, viewpoint_of
from survey.viewer.shown import SCALES, Shown, TrainedField

if TYPE_CHECKING:
    import viser

PHOTOGRAPHED = "colour of the photographs"
_BAR_PX = (256, 14)
_MOST_SIZE = 4.0


class Panel:
    """Controls of all browsers together.

    Parameters
    ----------
    restyle : callable
        Called with the style that has been chosen.
    """

    def __init__(self, server: viser.ViserServer, shown: Shown, restyle: Callable[[Style], None]):
        self._server, self._shown, self._restyle = server, shown, restyle
        self.style = Style()
        gui = server.gui
        points = count(len(shown.tree.points))
        gui.add_markdown(f"**{shown.name}**  \n{points} points, {len(shown.views)} photographs")
        # viser's properties have setters that type checkers do not see.
        self._kinds: Any = gui.add_dropdown("points by", self._labels())
        with gui.add_folder("colours", visible=False) as self._legend:
            self._bar = gui.add_image(SCALES["height"].bar(*_BAR_PX))
            self._range = gui.add_markdown("")
            self._limits: Any = gui.add_vector2("range", (0.0, 1.0), step=0.001, hint="of the first and last colour")
        with gui.add_folder("show"):
            self._points = gui.add_checkbox("points", True)
            self._size = gui.add_slider("size of points", 0.25, _MOST_SIZE, 0.25, 1.0)
            self.layers = gui.add_folder("layers")
        self._kinds.on_update(lambda _: self._choose())
        self._limits.on_update(self._set_limits)
        for control in (self._points, self._size):
            control.on_update(lambda _: self._apply(is_shown=self._points.value, size=self._size.value))

    def add_layer(self, label: str, *, is_on: bool, show: Callable[[bool], None]) -> None:
        """A box that shows and hides a part of the scene; ``show`` is called with the new state, not at first."""
        with self.layers:
            box = self._server.gui.add_checkbox(label, is_on)
        box.on_update(lambda _: show(box.value))

    def offer_kinds(self) -> None:
        """Offer all columns that `Shown` has by now."""
        chosen = self._kinds.value
        self._kinds.options = self._labels()
        self._kinds.value = chosen

    def _labels(self) -> list[str]:
        return [PHOTOGRAPHED, *(scale.label for kind, scale in SCALES.items() if kind in self._shown.columns)]

    def _choose(self) -> None:
        """Colours by another column, over its own range."""
        kind = next((kind for kind, scale in SCALES.items() if scale.label == self._kinds.value), "colour")
        limits = self._shown.limits(kind)
        self._legend.visible = limits is not None
        if limits is not None:
            self._bar.image = SCALES[kind].bar(*_BAR_PX)
            self._limits.value = limits
            self._say_range(kind, limits)
        self._apply(kind=kind, limits=limits)

    def _set_limits(self, event: viser.GuiEvent) -> None:
        """A range that somebody typed; where the program set it, all is done already."""
        low, high = self._limits.value
        if event.client is None or not low < high or self.style.limits is None:
            return
        self._say_range(self.style.kind, (low, high))
        self._apply(limits=(low, high))

    def _say_range(self, kind: str, limits: tuple[float, float]) -> None:
        scale = SCALES[kind]
        low, high = (number(value, 0 if kind == "num_views" else 3) for value in limits)
        self._range.content = f"{scale.label}: {low} to {high} {scale.unit}; grey where it is not known"

    def _apply(self, **changes: Any) -> None:
        self.style = replace(self.style, **changes)
        self._restyle(self.style)


def add_field(server: viser.ViserServer, field: TrainedField, show: Callable[[np.ndarray], None]) -> None:
    """A button in the panel that renders a field from where a browser looks; ``show`` gets the picture."""
    with server.gui.add_folder(f"trained field: {field.name}"):
        wet = server.gui.add_checkbox("through the water", False)
        button = server.gui.add_button("render from here")

    @button.on_click
    def render(event: viser.GuiEvent) -> None:
        if event.client is None:
            return
        said = event.client.add_notification("trained field", "is being rendered", loading=True)
        try:
            show(field.picture(viewpoint_of(event.client.camera), dry=not wet.value))
            for note in field.notes:
                event.client.add_notification("trained field", note)
        # Torch raises RuntimeError where a device has too little memory.
        except (SurveyError, RuntimeError) as error:
            event.client.add_notification("trained field", str(error), color="red")
        finally:
            said.remove()
