"""Merging of tiles: height maps of whole photographs, solved maps, and the bed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fields.solver.solver import SolvedMap
from fields.sweep.maps import HeightMap
from fields.sweep.photo_consistency import Consistency
from survey.files.json_values import read_json_object, write_json
from survey.plan.sweep_block import cameras_of_block
from survey.run.stage_bed import finish_bed
from survey.run.stage_of_tile import gather_points
from survey.run.stage_solver import SIGHTINGS, SOLVED
from survey.run.stage_sweep import BOUND, CONSISTENCY, MAPS, SATURATED
from survey.run.stored_maps import Stored, save_maps
from survey.run.tile_job import MASKS, OWN, StoredMasks, TileJob

if TYPE_CHECKING:
    from survey.run.job import Job
    from survey.run.windows import Window

# In the folder of the stage, while it lasts: the points of all tiles.
GATHERED = "points.npz"


def merge_sweeps(
    job: Job, folder: Path, tiles: Sequence[TileJob], of_tiles: Mapping[str, list[Path]], _needs: Mapping[str, Path]
) -> None:
    """Height maps of whole photographs: each pixel from the tile that has its point."""
    swept = of_tiles["sweep"]
    views = sorted({tile.windows[view].view for tile, place in _found(tiles, swept) for view in _maps(place).views})
    save_maps(folder / MAPS, HeightMap, _whole_maps(job, tiles, swept, views))
    low, high = zip(*(tile.bound_over_survey for tile in tiles), strict=True)
    write_json(folder / BOUND, {"low_m": min(low), "high_m": max(high)})
    names = [view.name for view in job.survey.views]
    write_json(folder / SATURATED, dict(zip(names, job.block.saturated, strict=True)))
    found = [read_json_object(place / CONSISTENCY) for place in swept]
    write_json(folder / CONSISTENCY, {name: asdict(_together(found, name)) for name in names})


def merge_solved(
    job: Job, folder: Path, tiles: Sequence[TileJob], of_tiles: Mapping[str, list[Path]], _needs: Mapping[str, Path]
) -> None:
    """Solved maps of whole photographs, in the order of `merge_sweeps`, and how often each photograph was seen."""
    swept, solved = of_tiles["sweep"], of_tiles["solver"]
    views = sorted({tile.windows[view].view for tile, place in _found(tiles, swept) for view in _maps(place).views})
    save_maps(folder / SOLVED, SolvedMap, _whole_solved(job, tiles, swept, solved, views))
    found = [read_json_object(place / SIGHTINGS) for place in solved]
    names = [view.name for view in job.survey.views]
    write_json(
        folder / SIGHTINGS,
        {name: np.sum([each.get(name, (0, 0)) for each in found], axis=0).tolist() for name in names},
    )


def merge_points(
    job: Job, folder: Path, _tiles: Sequence[TileJob], of_tiles: Mapping[str, list[Path]], needs: Mapping[str, Path]
) -> None:
    """The bed of all tiles."""
    with job.progress.stage("Bed"):
        points_path = folder / GATHERED
        finish_bed(job, folder, needs, *gather_points(of_tiles["bed"], points_path))
        points_path.unlink()


def _found(tiles: Sequence[TileJob], swept: Sequence[Path]) -> Iterator[tuple[TileJob, Path]]:
    return zip(tiles, swept, strict=True)


def _maps(place: Path) -> Stored[HeightMap]:
    return Stored(place / MAPS, HeightMap)


def _by_view(tiles: Sequence[TileJob], swept: Sequence[Path]) -> dict[int, list[tuple[int, int, Window]]]:
    """Tile, number of the map in it, and window, for each view of the survey."""
    found: dict[int, list[tuple[int, int, Window]]] = {}
    for tile, (job, place) in enumerate(_found(tiles, swept)):
        for number, view in enumerate(_maps(place).views):
            window = job.windows[view]
            found.setdefault(window.view, []).append((tile, number, window))
    return found


def _whole_maps(job: Job, tiles: Sequence[TileJob], swept: Sequence[Path], views: list[int]) -> Iterator[HeightMap]:
    camera = cameras_of_block(job.survey, job.plan)[0]
    shape, maps = (camera.height, camera.width), [_maps(place) for place in swept]
    own, of_view = [StoredMasks(place / MASKS, OWN) for place in swept], _by_view(tiles, swept)
    for view in views:
        height, known = np.zeros(shape, dtype=np.float32), np.zeros(shape, dtype=bool)
        score, spread = np.full(shape, -1.0, dtype=np.float16), np.zeros(shape, dtype=np.float16)
        agreeing = np.zeros(shape, dtype=np.uint8)
        for tile, number, window in of_view[view]:
            m, mask = maps[tile][number], own[tile][number] & ~known[window.part]
            row, column = np.nonzero(mask)
            height[window.part][mask] = tiles[tile].over_whole(m.view, row, column, m.height[mask])
            for target, each in ((score, m.score), (agreeing, m.agreeing), (spread, m.spread)):
                target[window.part][mask] = each[mask]
            known[window.part] |= mask
        # Where no tile looked, no other view confirms the height.
        height[~known] = np.median(height[known]) if known.any() else np.float32(0.0)
        yield HeightMap(view, height, score, agreeing, spread)


def _whole_solved(
    job: Job, tiles: Sequence[TileJob], swept: Sequence[Path], solved: Sequence[Path], views: list[int]
) -> Iterator[SolvedMap]:
    width = cameras_of_block(job.survey, job.plan)[0].width
    found, of_view = [Stored(place / SOLVED, SolvedMap) for place in solved], _by_view(tiles, swept)
    own, maps = [StoredMasks(place / MASKS, OWN) for place in swept], [_maps(place) for place in swept]
    for view in views:
        parts = []
        for tile, number, window in of_view[view]:
            each, mask = found[tile][number], own[tile][number].ravel()
            keep = mask[each.pixels]
            row, column = np.divmod(each.pixels[keep], window.width)
            pixels = (row + window.row) * width + column + window.column
            height = tiles[tile].over_whole(maps[tile].views[number], row, column, each.height[keep])
            parts.append((pixels, height, each.std[keep]))
        pixels, height, std = (np.concatenate(column) for column in zip(*parts, strict=True))
        # A pixel whose heights in two tiles lie on either side of the line between them is in both.
        pixels, first = np.unique(pixels, return_index=True)
        yield SolvedMap(pixels, height[first], std[first])


def _together(found: Sequence[Mapping[str, dict]], name: str) -> Consistency:
    """Consistency of a photograph in several tiles: means by the number of points."""
    parts = [Consistency(**each[name]) for each in found if name in each]
    count = np.array([part.num_points for part in parts], dtype=float)
    known = [part.correlation is not None for part in parts]
    if not any(known):
        return Consistency(int(count.sum()), None, max((part.contrast for part in parts), default=0.0))
    values = [0.0 if part.correlation is None else part.correlation for part in parts]
    correlation = float(np.average(values, weights=count * known))
    contrast = float(np.sqrt(np.average([part.contrast**2 for part in parts], weights=np.maximum(count, 1.0))))
    return Consistency(int(count.sum()), correlation, contrast)
