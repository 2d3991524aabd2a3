"""Height maps and solved maps of whole photographs, joined of those of tiles."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np

from fields.solver.solver import SolvedMap
from fields.sweep.maps import HeightMap
from fields.sweep.photo_consistency import Consistency
from survey.files.json_values import read_json_object, write_json
from survey.run.stage_solver import SIGHTINGS, SOLVED, WAVES
from survey.run.stage_sweep import CONSISTENCY, MAPS, OWN, SATURATED
from survey.run.stored_maps import Stored, StoredMasks, save_maps
from survey.run.tile_job import TileJob

if TYPE_CHECKING:
    from survey.run.job import Job
    from survey.run.windows import Window


def join_sweeps(job: Job, folder: Path, needs: Mapping[str, Path]) -> None:
    """Height maps of whole photographs: each pixel from the tile that has its point."""
    tiles, swept = _tiles(job), _places(job, needs, "sweep")
    save_maps(folder / MAPS, HeightMap, _whole_maps(job, tiles, swept))
    names = [view.name for view in job.survey.views]
    write_json(folder / SATURATED, dict(zip(names, job.block.saturated, strict=True)))
    found = [read_json_object(place / CONSISTENCY) for place in swept]
    write_json(folder / CONSISTENCY, {name: asdict(_together(found, name)) for name in names})


def join_solved(job: Job, folder: Path, needs: Mapping[str, Path]) -> None:
    """Solved maps of whole photographs, in the order of `join_sweeps`, and how often each photograph was seen."""
    swept, solved = _places(job, needs, "sweep"), _places(job, needs, "solver")
    save_maps(folder / SOLVED, SolvedMap, _whole_solved(job, _tiles(job), swept, solved))
    found = [read_json_object(place / SIGHTINGS) for place in solved]
    names = [view.name for view in job.survey.views]
    write_json(
        folder / SIGHTINGS,
        {name: np.sum([each.get(name, (0, 0)) for each in found], axis=0).tolist() for name in names},
    )
    # Of the tile with the highest waves: the others are shallow, or dry.
    seas = [read_json_object(place / WAVES) for place in solved]
    write_json(folder / WAVES, max(seas, key=lambda each: (each["sea"] or {}).get("significant_height_m", 0.0)))


def _tiles(job: Job) -> Sequence[TileJob]:
    return cast("Sequence[TileJob]", job.parts)


def _places(job: Job, needs: Mapping[str, Path], name: str) -> list[Path]:
    """Folders of a stage of all tiles."""
    return [needs[part.stage_name(name)] for part in job.parts]


def _maps(place: Path) -> Stored[HeightMap]:
    return Stored(place / MAPS, HeightMap)


def _by_view(tiles: Sequence[TileJob], swept: Sequence[Path]) -> dict[int, list[tuple[int, int, Window]]]:
    """Tile, number of the map in it, and window, for each view of the survey that has a map, by rising number."""
    found: dict[int, list[tuple[int, int, Window]]] = {}
    for tile, (job, place) in enumerate(zip(tiles, swept, strict=True)):
        for number, view in enumerate(_maps(place).views):
            window = job.windows[view]
            found.setdefault(window.view, []).append((tile, number, window))
    return dict(sorted(found.items()))


def _whole_maps(job: Job, tiles: Sequence[TileJob], swept: Sequence[Path]) -> Iterator[HeightMap]:
    camera = job.cameras[0]
    shape, maps = (camera.height, camera.width), [_maps(place) for place in swept]
    own = [StoredMasks(place / OWN) for place in swept]
    for view, of_view in _by_view(tiles, swept).items():
        height, known = np.zeros(shape, dtype=np.float32), np.zeros(shape, dtype=bool)
        score, spread = np.full(shape, -1.0, dtype=np.float16), np.zeros(shape, dtype=np.float16)
        agreeing = np.zeros(shape, dtype=np.uint8)
        for tile, number, window in of_view:
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
    job: Job, tiles: Sequence[TileJob], swept: Sequence[Path], solved: Sequence[Path]
) -> Iterator[SolvedMap]:
    width, found = job.cameras[0].width, [Stored(place / SOLVED, SolvedMap) for place in solved]
    own, maps = [StoredMasks(place / OWN) for place in swept], [_maps(place) for place in swept]
    for of_view in _by_view(tiles, swept).values():
        parts = []
        for tile, number, window in of_view:
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
