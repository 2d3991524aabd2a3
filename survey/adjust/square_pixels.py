"""Square pixels in place of a ratio of focal lengths that a program found with straight rays through water.

The adjustment holds the ratio of both focal lengths. A program that adjusts its lens with straight rays takes some of
the bend at the water into that ratio: on the block of examples/exports.py, 20 m over 2 m of water, 0.1 %, which moved
the focal length that was found by 0.5 % and the bed by 15 cm.
"""

from __future__ import annotations

from dataclasses import replace

from refract.lens import MODELS, Lens
from survey.folder.survey import Survey

# Photographs that were scaled differently along their sides are further from square than any bend makes them.
_MOST_BEND = 0.01


def with_square_pixels(survey: Survey) -> tuple[Survey, str | None]:
    """The survey with one focal length for both axes, with a note, where straight rays gave two; else unchanged."""
    tool = survey.provenance.tool
    if tool is None or survey.water is None:
        return survey, None
    square = {view.lens: _square(view.lens) for view in survey.views}
    changed = [lens for lens, other in square.items() if other != lens]
    if not changed:
        return survey, None
    views = []
    for view in survey.views:
        fx, fy = square[view.lens].focal
        views.append(replace(view, lens=square[view.lens], camera=replace(view.camera, fx=fx, fy=fy)))
    fx, fy = changed[0].focal
    note = (
        f"pixels are taken as square: {tool} found focal lengths of {fx:.2f} and {fy:.2f} px with straight "
        "rays, which water bends"
    )
    return replace(survey, views=tuple(views)), note


def _square(lens: Lens) -> Lens:
    fx, fy = lens.focal
    if fx == fy or abs(fy / fx - 1.0) > _MOST_BEND:
        return lens
    at = [MODELS[lens.model][1].index(name) for name in ("fx", "fy")]
    params = list(lens.params)
    for place in at:
        params[place] = 0.5 * (fx + fy)
    return replace(lens, params=tuple(params))
