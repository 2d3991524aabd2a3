"""The truth of a drawn block as a state of the adjustment, and its derivatives against differences."""

from __future__ import annotations

import numpy as np

from survey.adjust.block.prediction import Prediction, apparent_rise_design, design_matrix, linearise, predict
from survey.adjust.block.state import NUM_LENS, NUM_RELIEF, Layout, State
from survey.photos.poses import TiePoints
from tests.drawn_block import DrawnBlock

STEP = 1e-5


def state_of(
    block: DrawnBlock, *, rolls: bool = False, finds_readouts: bool = False
) -> tuple[Layout, State, TiePoints]:
    """The truth of a block as taken through two lenses that are alike, with its rolling shutter if ``rolls``."""
    lens = block.lens
    parameters = np.array([lens.focal[0], lens["cx"], lens["cy"], lens["k1"], lens["k2"], 0.0, lens["p1"], lens["p2"]])
    velocity_per_row = block.velocities / (lens.height - 1) if rolls else None
    layout = Layout(np.arange(len(block.cameras)) % 2, np.ones(2), velocity_per_row, finds_readouts=finds_readouts)
    state = State(
        block.plane,
        np.zeros(NUM_RELIEF),
        np.tile(parameters, (2, 1)),
        np.array([camera.centre for camera in block.cameras]),
        np.array([camera.cam_from_local for camera in block.cameras]),
        block.points,
        *([np.full(2, block.readout)] if rolls else []),
    )
    return layout, state, TiePoints(block.points, block.point, block.view, block.pixel)


def require_derivatives(layout: Layout, state: State, ties: TiePoints) -> Prediction:
    """Assert that predictions are those of `predict`, and their derivatives by all parameters differences of it."""
    rise_design = apparent_rise_design(state, ties)
    linear = linearise(layout, state, ties, rise_design)
    np.testing.assert_array_equal(linear.pixels, predict(layout, state, ties, rise_design))
    still, dense = np.zeros((len(ties), 3)), design_matrix(layout, ties.view, linear.by_parameters).toarray()
    assert dense.shape[1] == len(layout)
    # Steps that move pixels by some hundredths.
    steps = np.full(len(layout), STEP)
    steps[layout.first_lens : layout.first_readout] = np.tile([0.01, 0.01, 0.01, *np.full(NUM_LENS - 3, STEP)], 2)
    for number in range(len(layout)):
        step = np.zeros(len(layout))
        step[number] = steps[number]
        ahead, behind = (
            predict(layout, state.moved(layout, sign * step, still), ties, rise_design) for sign in (1.0, -1.0)
        )
        difference = (ahead - behind).ravel() / (2.0 * steps[number])
        scale = max(np.abs(difference).max(), 1.0)
        np.testing.assert_allclose(dense[:, number] / scale, difference / scale, atol=1e-6, err_msg=str(number))
    return linear
