"""The pictures of a report, drawn one after the other into PNG files."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from survey.adjust.parts import part_numbers
from survey.compare import bands as compare_bands
from survey.compare import pictures as compare_report
from survey.display.plan_grid import PlanGrid
from survey.report import adjustment_pictures, control_picture, flight, graphs, maps, profile
from survey.report.checkpoints import CheckpointFigures
from survey.report.cut import choose_cut
from survey.report.facts import ReportFacts, distances_of
from survey.report.shading import Picture

if TYPE_CHECKING:
    from survey.adjust.adjustment import Adjustment
    from survey.compare.result import Comparison

# Cells of the orthophoto and of the maps along the longer side, at most.
_ORTHO_CELLS, _MAP_CELLS = 2000, 900
_CELL_GSD = 2.0


def draw_pictures(
    folder: Path,
    facts: ReportFacts,
    advance: Callable[[], None] = lambda: None,
    *,
    checkpoints: CheckpointFigures | None = None,
) -> list[Picture]:
    """Draw all pictures that the facts allow, as PNG files, each whole or not at all.

    Parameters
    ----------
    folder : Path
        Has to exist.
    facts : ReportFacts
    advance : callable
        Called after each picture.
    checkpoints : CheckpointFigures, optional
        The cloud at the check points.

    Returns
    -------
    list of Picture, in the order of the report

    Raises
    ------
    UnwritableFile
        If a picture cannot be written.
    ImageError
        If the photograph beside the depth map can no longer be read.
    """
    drawings: dict[str, Callable[[Path], Picture]] = {}
    if len(facts.bed):
        grid, fine_grid = _grid(facts, _MAP_CELLS), _grid(facts, _ORTHO_CELLS)
        line = choose_cut(facts)
        cut = line if profile.has_profile(facts, line) else None
        drawings["depth"] = partial(maps.draw_surface, facts=facts, grid=grid, cut=cut)
        drawings["orthophoto"] = partial(maps.draw_orthophoto, facts=facts, grid=fine_grid)
        if cut is not None:
            drawings["profile"] = partial(profile.draw_profile, facts=facts, cut=cut)
    if facts.comparison is not None:
        drawings |= _of_comparison(facts, facts.comparison)
    if facts.depth_maps:
        drawings["view"] = partial(maps.draw_view, facts=facts, depth_maps=facts.depth_maps)
    if len(facts.bed):
        drawings["views"] = partial(maps.draw_num_views, facts=facts, grid=grid)
        drawings["std"] = partial(maps.draw_std, facts=facts, grid=grid)
        drawings["histograms"] = partial(graphs.draw_histograms, facts=facts)
    if facts.adjustment is not None:
        drawings |= _of_adjustment(facts, facts.adjustment)
    residuals = control_picture.residuals_of(facts.survey, facts.adjustment, checkpoints)
    if residuals:
        drawings["control"] = partial(control_picture.draw_residuals, survey=facts.survey, residuals=residuals)
    drawings["plan"] = partial(flight.draw_plan, facts=facts)
    pictures = []
    for name, draw in drawings.items():
        pictures.append(draw(folder / f"{name}.png"))
        advance()
    return pictures


def _grid(facts: ReportFacts, max_cells: int) -> PlanGrid:
    cell_m = _CELL_GSD * facts.plan.gsd_m
    return PlanGrid.over(facts.points_crs, facts.survey.frame.crs, cell_m=cell_m, max_cells=max_cells)


def _of_adjustment(facts: ReportFacts, found: Adjustment) -> dict[str, Callable[[Path], Picture]]:
    drawings: dict[str, Callable[[Path], Picture]] = {}
    if part_numbers(found).max() > 0:
        drawings["parts"] = partial(adjustment_pictures.draw_parts, survey=facts.survey, found=found)
    drawings |= {
        "residuals_ground": partial(adjustment_pictures.draw_ground_residuals, survey=facts.survey, found=found),
        "residuals_image": partial(adjustment_pictures.draw_image_residuals, found=found),
    }
    if adjustment_pictures.has_correlation(found):
        drawings["correlation"] = partial(adjustment_pictures.draw_correlation, found=found)
    return drawings


def _of_comparison(facts: ReportFacts, comparison: Comparison) -> dict[str, Callable[[Path], Picture]]:
    crs = facts.survey.frame.crs
    tolerance_m = comparison.figures.summary.scores.tolerance_m

    def error_map(path: Path) -> Picture:
        compare_report.error_map(comparison.points, comparison.distances, path, crs=crs)
        return Picture(path, "Distance to the reference", "Red lies above the reference, blue below it.")

    def histogram(path: Path) -> Picture:
        compare_report.histogram(comparison.distances, path, tolerance_m=tolerance_m)
        words = "Nothing was aligned or shifted before."
        return Picture(path, "Distribution of the distance to the reference", words)

    def completeness(path: Path) -> Picture:
        compare_report.completeness_map(comparison.targets, comparison.is_reached, path, crs=crs)
        words = f"Red: no point of the cloud within {tolerance_m:g} m."
        return Picture(path, "What the cloud does not reach", words)

    def bands(path: Path) -> Picture:
        compare_bands.draw_bands(comparison.figures.parts, path)
        words = "Mean and spread of the distances in each band, with the number of its points above it."
        return Picture(path, "Bias and spread by depth, incidence and number of views", words)

    drawings: dict[str, Callable[[Path], Picture]] = {
        "error": error_map,
        "error_histogram": histogram,
        "completeness": completeness,
    }
    distances = distances_of(facts)
    if distances is not None and np.isfinite(distances).any():
        drawings["error_depth"] = partial(graphs.draw_error_over_depth, facts=facts, distances=distances)
    if compare_bands.has_bands(comparison.figures.parts):
        drawings["error_bands"] = bands
    return drawings
