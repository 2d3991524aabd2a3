"""A survey with the poses, lenses and water that an adjustment found, or is at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from refract.lens import Lens
from survey.adjust.adjustment import Adjustment
from survey.adjust.assembling import lens_with
from survey.adjust.priors import Known
from survey.adjust.state import Layout, State
from survey.folder.place import water_plane
from survey.folder.survey import Survey, View
from survey.folder.tides import with_shift


def apply_adjustment(survey: Survey, found: Adjustment) -> Survey:
    """The survey with the poses, lenses and water that an adjustment found."""
    views = _views(survey, found.lenses, found.layout, found.centres, found.rotations, found.readouts_s, found.tides)
    survey = replace(survey, views=views, points=found.points, ties=None, is_adjusted=True)
    if found.hours is not None and survey.tide is not None and found.water is not None:
        over = {view.name: view.camera.tide for view in views}
        survey = replace(survey, tide=with_shift(replace(survey.tide, over=over), views, survey.require_water()[0]))
    if found.layout.finds_readouts and found.readouts_s is not None and len(found.readouts_s) == 1:
        readout = max(found.readouts_s[0], 0.0)
        cameras = replace(survey.config.cameras, rolling_shutter_s=readout, rolling_shutter_std_s=None)
        survey = replace(survey, config=replace(survey.config, cameras=cameras))
    if found.water is None:
        return survey
    config = replace(survey.config, water=found.water)
    return replace(survey, config=config, water=water_plane(survey.frame, found.water))


def at_state(survey: Survey, known: Known, state: State) -> Survey:
    """The survey at a state of its adjustment."""
    lenses = [lens_with(lens, state.lenses[i]) for i, lens in enumerate(known.lenses)]
    views = _views(
        survey, lenses, known.layout, state.centres, state.rotations, state.readouts, state.tides(known.layout)
    )
    return replace(survey, views=views, water=state.water, points=state.points, is_adjusted=True)


def _views(
    survey: Survey,
    lenses: Sequence[Lens],
    layout: Layout,
    centres: np.ndarray,
    rotations: np.ndarray,
    readouts,
    tides: np.ndarray | None,
) -> tuple[View, ...]:
    """The views with other lenses, poses, readouts of their shutters (L,) [s], and tides (V,) [m]."""
    views = []
    for number, view in enumerate(survey.views):
        lens = lenses[layout.lens_of[number]]
        tide = 0.0 if tides is None else float(tides[number])
        camera = replace(lens.camera(centres[number], rotations[number]), tide=tide)
        if layout.flow is not None and layout.flow[number].any():
            camera = replace(camera, motion=layout.flow[number] * readouts[layout.lens_of[number]])
        views.append(replace(view, camera=camera, lens=lens))
    return tuple(views)
