"""Sweep, solver and bed of one tile of a survey, for `survey.run.execution`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np

from fields.solver.noise import NoiseShares, Shifts
from fields.solver.solver import SolvedMap, SolverFigures, count_in_squares, figures_of, solve_sample, spread
from fields.sweep.bed import BedPoints, unique_pixels
from fields.sweep.map_points import places_in_plan
from fields.sweep.maps import HeightMap
from survey.files.json_values import read_json_object, write_json
from survey.plan.area import grown
from survey.plan.tiling import inside
from survey.run.stage_bed import in_crs, points_of_bed
from survey.run.stage_solver import SIGHTINGS, SOLVED, solve_with
from survey.run.stage_sweep import BOUND, CONSISTENCY, MAPS, SATURATED, restore_overlap_height, sweep_views
from survey.run.stored import Column, mapped_arrays, save_arrays, write_arrays
from survey.run.stored_maps import IN_MEMORY, Stored, save_maps
from survey.run.tile_job import KEPT, MASKS, OWN, StoredMasks, TileJob, pack_masks

if TYPE_CHECKING:
    from survey.run.job import Job

POINTS, FIGURES, SQUARES = "points.npz", "figures.json", "squares.json"
# Points so far beyond a tile count as neighbours of its own [ground sampling distances].
_BESIDE_GSD = 6.0


def sweep_tile(job: Job, folder: Path, _needs: Mapping[str, Path]) -> None:
    """Sweep the views of a tile, and choose the pixels that become points."""
    tile = cast(TileJob, job)
    if tile.is_void:
        save_maps(folder / MAPS, HeightMap, [])
        for name in (SATURATED, CONSISTENCY):
            write_json(folder / name, {})
        write_json(folder / BOUND, {"low_m": tile.bound[0], "high_m": tile.bound[1]})
        save_arrays(folder / MASKS, **pack_masks({KEPT: [], OWN: []}))
        write_json(folder / SQUARES, {"pixels": []})
        return
    sweep_views(tile, folder, {})
    maps = Stored(folder / MAPS, HeightMap, IN_MEMORY)
    kept, own = [], []
    around = grown(tile.cell, _BESIDE_GSD * tile.plan.gsd_m)
    for m, unique in zip(maps, unique_pixels(tile.block, maps, tile.plan.gsd_m), strict=True):
        places = places_in_plan(tile.block, m, tile.in_survey if tile.has_frame else None)
        kept.append(unique & inside(places, around))
        own.append(inside(places, tile.cell))
    save_arrays(folder / MASKS, **pack_masks({KEPT: kept, OWN: own}))
    restore_overlap_height(tile, folder)
    write_json(folder / SQUARES, {"pixels": count_in_squares(tile.block, maps, _own(folder))})


def solve_tile(job: Job, folder: Path, needs: Mapping[str, Path]) -> None:
    """Solve the points of a tile with what the solver has learned of the whole survey."""
    tile, maps = cast(TileJob, job), Stored(needs["sweep"] / MAPS, HeightMap)
    if not len(maps):
        save_maps(folder / SOLVED, SolvedMap, [])
        write_json(folder / SIGHTINGS, {})
        return
    solve_with(tile, folder, needs, read_figures(needs["figures"]))


def find_points(job: Job, folder: Path, needs: Mapping[str, Path]) -> None:
    """Points of the bed in a tile, by the places of the points."""
    tile = cast(TileJob, job)
    bed = points_of_bed(tile, needs) if len(Stored(needs["sweep"] / MAPS, HeightMap)) else BedPoints.empty()
    bed = replace(bed, xyz=tile.in_survey(bed.xyz))
    bed = bed[inside(bed.xyz, tile.cell)]
    columns: dict[str, np.ndarray | Column] = {each.name: getattr(bed, each.name) for each in fields(BedPoints)}
    write_arrays(folder / POINTS, (columns | {"points_crs": in_crs(tile.survey_job.survey, bed.xyz)}).items())


def gather_points(folders: Sequence[Path], path: Path) -> tuple[BedPoints, np.ndarray]:
    """Points of `find_points` in all tiles, local and (N, 3) in crs, gathered in a file, where they stay."""
    names = [*(each.name for each in fields(BedPoints)), "points_crs"]

    def column(name: str) -> Column:
        found = [mapped_arrays(folder / POINTS, (name,))[name] for folder in folders]
        count = sum(map(len, found))
        return Column(found[0].dtype, (count, *found[0].shape[1:]), found)

    write_arrays(path, ((name, column(name)) for name in names))
    columns = mapped_arrays(path)
    points_crs = columns.pop("points_crs")
    return BedPoints(**columns), points_crs


def learn_figures(
    job: Job,
    folder: Path,
    tiles: Sequence[TileJob],
    of_tiles: Mapping[str, list[Path]],
    _needs: Mapping[str, Path],
) -> None:
    """Parameters of the solver for the survey, estimated from a sample of the pixels of all tiles."""
    swept = of_tiles["sweep"]
    with job.progress.stage("Sample of the solver"):
        squares = [read_json_object(place / SQUARES)["pixels"] for place in swept]
        filled = [each for of_tile in squares for each in of_tile]
        maps_of = [
            (tile.number, number) for tile, each in zip(tiles, squares, strict=True) for number in range(len(each))
        ]
        figures = None
        if any(map(sum, filled)):
            chosen = [(*maps_of[number], square) for number, square in spread(filled)]
            sample = []
            for tile, place in zip(tiles, swept, strict=True):
                places = [(number, square) for of_tile, number, square in chosen if of_tile == tile.number]
                if places:
                    restore_overlap_height(tile, place)
                    sample += solve_sample(
                        tile.block, Stored(place / MAPS, HeightMap), _own(place), places, tile.plan.gsd_m
                    )
                    tile.drop()
            figures = figures_of(sample, job.plan.gsd_m, is_wet=job.survey.water is not None)
            job.progress.detail(f"solver: {figures}")
    stored = None if figures is None else asdict(replace(figures, visibility=None))
    write_json(folder / FIGURES, {"figures": stored})


def read_figures(folder: Path) -> SolverFigures | None:
    """Figures of `learn_figures`; None where there was nothing to learn from."""
    figures = read_json_object(folder / FIGURES)["figures"]
    if figures is None:
        return None
    return SolverFigures(**figures | {"shifts": Shifts(**figures["shifts"]), "noise": NoiseShares(**figures["noise"])})


def _own(place: Path) -> list[np.ndarray]:
    """Pixels of each map that become points of the tile itself."""
    masks = (StoredMasks(place / MASKS, name) for name in (KEPT, OWN))
    return [kept & own for kept, own in zip(*masks, strict=True)]
