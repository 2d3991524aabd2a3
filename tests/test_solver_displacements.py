"""Displacements of photographs in cells of solved tiles."""

from dataclasses import replace

import numpy as np
from scipy import ndimage
from solved_tiles import plain_tile, residuals, white

from fields.solver.displacements import CELL_PX, TileDisplacements, displacements_of, waves_of
from fields.solver.gauss_newton import TileSolution
from fields.solver.tile import SolverTile, brightness_of
from fields.solver.visibility import Ground, TileProjection
from fields.waves.waves import Waves

VIEWS, PIXEL_M, SHIFT_PX = 8, 0.02, 0.2


def measured(tile: SolverTile, solved: TileSolution, height: float) -> TileDisplacements:
    """Displacements in a tile of 96 x 96 pixels whose rows run south, over the plane of the water by a height [m]."""
    rows, columns = plain_tile(96).places
    points = np.stack([PIXEL_M * columns, -PIXEL_M * rows, np.full(len(rows), height)]).astype(np.float32)
    per_pixel = np.tile(np.array([[PIXEL_M, 0.0], [0.0, -PIXEL_M]], np.float32)[..., None], (1, 1, len(rows)))
    nothing, seen = np.zeros_like(solved.motion), solved.brightness.weight > 0.0
    ground = Ground(points, per_pixel)
    projected = TileProjection(list(range(VIEWS)), nothing, nothing, solved.motion, seen, ground)
    return displacements_of(tile, projected, solved.brightness)


def cell_means(values: np.ndarray) -> np.ndarray:
    """Means (..., cells) of values (..., 96 * 96) over cells."""
    side = 96 // CELL_PX
    return (
        values.reshape(*values.shape[:-1], side, CELL_PX, side, CELL_PX)
        .mean(axis=(-3, -1))
        .reshape(*values.shape[:-1], side * side)
    )


def test_displacements_are_those_of_the_photographs_against_their_mean():
    tile, solved = residuals(0.2 * white(VIEWS), shift_px=SHIFT_PX)
    found = measured(tile, solved, -2.0)
    random = np.random.default_rng(8)
    random.standard_normal((96, 96))
    phase = random.uniform(0.0, 2.0 * np.pi, (VIEWS, 2, 1)) + 0.08 * tile.places[0]
    shift = np.sqrt(2.0) * SHIFT_PX * np.sin(phase)
    # Grey that grows with the gradient shows what lies ahead: the texture is displaced the other way.
    expected = -cell_means(shift) * np.array([PIXEL_M, -PIXEL_M])[:, None]
    assert len(found.cell) == VIEWS * (96 // CELL_PX) ** 2
    missed = (found.measured - expected[found.view, :, found.cell]).reshape(VIEWS, -1, 2)
    # What all photographs have in common is free.
    missed -= missed.mean(axis=0)
    assert np.sqrt(np.mean(missed**2)) < 0.15 * SHIFT_PX * PIXEL_M


def test_cells_in_which_a_step_leads_nowhere_tell_little(rng):
    tile, solved = residuals(0.2 * white(VIEWS), shift_px=SHIFT_PX)
    lost = np.zeros(solved.brightness.residual.shape, dtype=np.float32)
    west = tile.places[1] < 48
    # Another texture, as where a photograph is displaced by more than the texture is alike.
    lost[2, west] = 2.0 * solved.brightness.noise[2] * rng.standard_normal(np.count_nonzero(west))
    brightness = replace(solved.brightness, residual=solved.brightness.residual + lost)
    before, found = measured(tile, solved, -2.0), measured(tile, replace(solved, brightness=brightness), -2.0)
    ratio = np.trace(found.information, axis1=1, axis2=2) / np.trace(before.information, axis1=1, axis2=2)
    is_lost = (found.view == 2) & (found.point[:, 0] < 48 * PIXEL_M)
    assert np.median(ratio[is_lost]) < 0.2
    assert np.median(ratio[~is_lost]) > 0.9


def test_where_most_of_a_tile_is_black_the_rest_tells_as_much(rng):
    _, solved = residuals(0.2 * white(VIEWS))
    grey = 128.0 + 40.0 * ndimage.gaussian_filter(rng.standard_normal((96, 96)), 1.5)
    grey = np.rint(grey + 0.6 * rng.standard_normal((VIEWS, 96, 96)))
    tile, found = plain_tile(96), []
    for black in (0, 57):
        grey[:, :, :black] = 0.0
        brightness = brightness_of(grey.reshape(VIEWS, -1).astype(np.float32))
        information = measured(tile, replace(solved, brightness=brightness), -2.0)
        trace = np.trace(information.information, axis1=1, axis2=2)
        assert np.isfinite(trace).all()
        found.append(np.median(trace[information.point[:, 0] > 65 * PIXEL_M]))
    assert found[1] > 0.4 * found[0]


def test_the_parallax_is_what_a_metre_of_height_displaces():
    relief = np.full((96, 96), 0.01)
    tile, solved = residuals(0.2 * white(VIEWS), relief=relief)
    found = measured(tile, solved, -2.0)
    # The heights are too low by the relief; what all photographs have in common is free.
    missed = (found.measured + 0.01 * found.parallax).reshape(VIEWS, -1, 2)
    missed -= missed.mean(axis=0)
    assert np.sqrt(np.mean(missed**2)) < 0.15 * 0.01 * np.sqrt(np.mean(found.parallax**2))


def test_dry_pixels_have_no_displacements():
    tile, solved = residuals(0.2 * white(VIEWS), shift_px=SHIFT_PX)
    assert len(measured(tile, solved, 0.5).cell) == 0


def test_surfaces_explain_displacements_of_several_tiles():
    centres = np.random.default_rng(4).uniform(-5.0, 5.0, (VIEWS, 3)) + np.array([0.0, 0.0, 30.0])
    still, parts = Waves.still(centres, np.zeros(VIEWS), 1.34), []
    for _ in range(2):
        tile, solved = residuals(0.2 * white(VIEWS), shift_px=SHIFT_PX)
        parts.append(measured(tile, solved, -2.0))
    waves = waves_of(parts, still, CELL_PX * PIXEL_M)
    points = parts[0].point.T.astype(np.float32)
    height, place = waves.variances(points)
    assert np.isfinite(waves.displacement(0, points)).all()
    assert waves.displacement(0, points).any()
    assert (height > 0.0).all()
    assert (place > 0.0).all()
