"""The stage of the sweep: a height map of each view that is needed to cover the bed, and its pixels that become points.

A survey in tiles has a sweep for each; their maps are joined to those of whole photographs. From these the absorption
of the water is estimated where survey.toml does not say it.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from fields.image_store import Masks
from fields.solver.moving_water import without_waves
from fields.solver.solver import count_in_squares, sampled, spread
from fields.solver.views import Views
from fields.sweep.bed import unique_pixels
from fields.sweep.block import Block
from fields.sweep.fusion import remove_free_space_violations
from fields.sweep.map_points import places_in_plan
from fields.sweep.maps import HeightMap, views_of
from fields.sweep.matching import PASSES, before_solver, in_area
from fields.sweep.photo_consistency import Consistency, photo_consistency
from fields.sweep.sweep import sweep
from fields.sweep.view_pass import SweepSettings
from fields.sweep.wide_windows import wet_pairs, with_wide_windows
from fields.waves.waves import Waves
from survey.errors import Findings, SurveyError
from survey.files.json_values import read_json_object, write_json
from survey.plan.area import grown, inside, plane_name
from survey.progress import shares
from survey.run.job import Job, Window
from survey.run.stored import load_arrays, save_arrays
from survey.run.stored_maps import IN_MEMORY, Stored, StoredMasks, load_masks, map_store, save_maps, save_masks
from survey.run.tile_job import TileJob

MAPS = "maps.npz"
# Of each photograph by its name: the share of white pixels, and whether it shows the bed that was found.
SATURATED, CONSISTENCY = "saturated.json", "consistency.json"
# Masks of each map: pixels that become points, of a tile also those beside it; and in tiles all that show the tile.
KEPT, OWN = "kept.npz", "own.npz"
# Pixels that the solver may learn from, in squares of each map.
SQUARES = "squares.json"
FILES = (MAPS, KEPT, SQUARES, SATURATED, CONSISTENCY)
# Where photographs were swept as over still water.
ROUGH_WATER = "rough_water.npz"
_OF_WAVES = (
    *("centres", "tides", "n_water", "corner", "spacing", "coefficients"),
    *("variance", "variance_corner", "deep"),
)
# In the folder of the stage, while it lasts: maps that are worked on.
SCRATCH = "scratch"
# The absorption of the water, of a survey that does not state it.
COLOUR_FILE = "water_colour.json"
# Points so far beyond a tile count as neighbours of its own [ground sampling distances].
_BESIDE_GSD = 6.0


def sweep_views(job: Job, folder: Path, _needs: Mapping[str, Path]) -> None:
    """Sweep the views that cover the bed, and choose the pixels that become points."""
    job.waits_for_kernels.set()
    if job.is_void:
        save_maps(folder / MAPS, HeightMap, [])
        for name in (KEPT, OWN):
            save_masks(folder / name, [])
        _save_of_photographs(folder, {}, {}, [])
        return
    squares = _sweep_block(job, folder, job.block, "Sweep")
    low, high = job.bound
    job.progress.detail(f"bound: bed between {low:.2f} and {high:.2f} m over the {plane_name(job.survey)}")
    water = job.survey.water
    if water is None or water.n_water == 1.0 or not job.plan.solves or not any(map(sum, squares)):
        return
    views, kept = Views.of(job.block, Stored(folder / MAPS, HeightMap)), learned_from(job, folder)
    found = without_waves(job.block, views, kept, sampled(views, kept, spread(squares)), job.plan.gsd_m)
    if found is not None:
        still, waves, moved_px = found
        job.progress.note(f"waves: photographs shifted by {moved_px:.2f} px; swept again as over still water")
        _sweep_block(job, folder, still, "Sweep without waves")
        save_rough_water(folder, waves, moved_px)


def save_rough_water(folder: Path, waves: Waves, moved_px: float) -> None:
    """Write what `load_rough_water` reads."""
    arrays = {name: np.asarray(getattr(waves, name)) for name in _OF_WAVES}
    save_arrays(folder / ROUGH_WATER, moved_px=np.array(moved_px), **arrays)


def load_rough_water(folder: Path) -> tuple[Waves | None, float]:
    """Surfaces of rough water that the sweep found, and how far they displace photographs [px]; None and 0 without."""
    if not (folder / ROUGH_WATER).is_file():
        return None, 0.0
    found = load_arrays(folder / ROUGH_WATER)
    arrays: dict[str, Any] = {name: found[name] if found[name].ndim else float(found[name]) for name in _OF_WAVES}
    return Waves(**arrays), float(found["moved_px"])


def _sweep_block(job: Job, folder: Path, block: Block, title: str) -> list[list[int]]:
    """Sweep photographs and write what is found; the pixels that the solver may learn from, in squares of each map."""
    bound = job.bound
    with job.progress.stage(title, 1.0) as stage:
        passes = before_solver(PASSES) if job.plan.solves else PASSES
        passes = passes if job.cell is None else in_area(passes)
        with map_store(folder / SCRATCH, HeightMap) as make_store:
            settings = SweepSettings(bound, passes, job.ground)
            swept = sweep(block, job.views_to_match, settings, shares(stage), make_store=make_store)
            if not swept and job.cell is None:
                raise SurveyError("no two photographs overlap; check that the poses belong to the images")
            finished = remove_free_space_violations(block, swept, make_store)
            swept.clear()
            finished = with_wide_windows(block, finished, bound, job.ground, make_store)
            save_maps(folder / MAPS, HeightMap, finished)
            consistency = photo_consistency(block, finished, job.whole_camera)
    names, squares = [view.name for view in job.survey.views], _choose_pixels(job, folder)
    _save_of_photographs(
        folder,
        dict(zip(names, block.saturated, strict=True)),
        {name: asdict(each) for name, each in zip(names, consistency, strict=False)},
        squares,
    )
    return squares


def _choose_pixels(job: Job, folder: Path) -> list[list[int]]:
    """Write the pixels of the maps that become points; those of them that the solver may learn from, in squares."""
    block, maps = job.block, Stored(folder / MAPS, HeightMap, IN_MEMORY)
    kept = unique_pixels(block, maps, job.plan.gsd_m)
    save_masks(folder / KEPT, kept)
    if job.cell is not None:
        own, around = kept.copy(), grown(job.cell, _BESIDE_GSD * job.plan.gsd_m)
        for number, m in enumerate(maps):
            places = places_in_plan(block, m)
            kept[number] = kept[number] & inside(places, around)
            own[number] = inside(places, job.cell)
        save_masks(folder / KEPT, kept)
        save_masks(folder / OWN, own)
    return count_in_squares([block.neighbours(view, 1) for view in maps.views], learned_from(job, folder))


def learned_from(job: Job, folder: Path) -> Masks:
    """Pixels of the maps that are solved, of a tile its own."""
    kept = load_masks(folder / KEPT)
    if job.cell is not None:
        for number, own in enumerate(load_masks(folder / OWN)):
            kept[number] = kept[number] & own
    return solvable(job.block, Stored(folder / MAPS, HeightMap), kept)


def solvable(block: Block, maps: Sequence[HeightMap], kept: Masks) -> Masks:
    """The kept pixels of maps that are solved: single pixels of two photographs show ripples, which moved."""
    found, views = kept.copy(), views_of(maps)
    pairs = wet_pairs(block, views)
    for number, view in enumerate(views):
        if view in pairs:
            found[number] = found[number] & (maps[number].height >= 0.0)
    return found


def _save_of_photographs(
    folder: Path, saturated: Mapping[str, float], consistency: Mapping[str, dict], squares: list[list[int]]
) -> None:
    write_json(folder / SATURATED, saturated)
    write_json(folder / CONSISTENCY, consistency)
    write_json(folder / SQUARES, {"pixels": squares})


def places_of_tiles(job: Job, needs: Mapping[str, Path], name: str) -> list[Path]:
    """Folders of a stage of all tiles."""
    return [needs[part.stage_name(name)] for part in job.parts]


def maps_by_view(job: Job, swept: Sequence[Path]) -> dict[int, list[tuple[TileJob, int, Window]]]:
    """Tile, number of the map in it, and window, for each view of the survey that has a map, by rising number."""
    by_view: dict[int, list[tuple[TileJob, int, Window]]] = {}
    for tile, place in zip(cast("Sequence[TileJob]", job.parts), swept, strict=True):
        for number, view in enumerate(Stored(place / MAPS, HeightMap).views):
            window = tile.windows[view]
            by_view.setdefault(window.view, []).append((tile, number, window))
    return dict(sorted(by_view.items()))


def join_sweeps(job: Job, folder: Path, needs: Mapping[str, Path]) -> None:
    """Height maps of whole photographs: each pixel from the tile that has its point."""
    swept = places_of_tiles(job, needs, "sweep")
    save_maps(folder / MAPS, HeightMap, _whole_maps(job, swept))
    names = [view.name for view in job.survey.views]
    write_json(folder / SATURATED, dict(zip(names, job.block.saturated, strict=True)))
    of_tiles = [read_json_object(place / CONSISTENCY) for place in swept]
    write_json(folder / CONSISTENCY, {name: asdict(_joined_consistency(of_tiles, name)) for name in names})


def _whole_maps(job: Job, swept: Sequence[Path]) -> Iterator[HeightMap]:
    shape = job.cameras[0].height, job.cameras[0].width
    maps, own = [Stored(place / MAPS, HeightMap) for place in swept], [StoredMasks(place / OWN) for place in swept]
    for view, of_view in maps_by_view(job, swept).items():
        height, known = np.zeros(shape, dtype=np.float32), np.zeros(shape, dtype=bool)
        score, spread = np.full(shape, -1.0, dtype=np.float16), np.zeros(shape, dtype=np.float16)
        agreeing = np.zeros(shape, dtype=np.uint8)
        for tile, number, window in of_view:
            m, mask = maps[tile.number][number], own[tile.number][number] & ~known[window.part]
            row, column = np.nonzero(mask)
            height[window.part][mask] = tile.over_whole(m.view, row, column, m.height[mask])
            for target, values in ((score, m.score), (agreeing, m.agreeing), (spread, m.spread)):
                target[window.part][mask] = values[mask]
            known[window.part] |= mask
        # Where no tile looked, no other view confirms the height.
        height[~known] = np.median(height[known]) if known.any() else np.float32(0.0)
        yield HeightMap(view, height, score, agreeing, spread)


def _joined_consistency(of_tiles: Sequence[Mapping[str, dict]], name: str) -> Consistency:
    """Consistency of a photograph in several tiles: means by the number of points."""
    parts = [Consistency(**values[name]) for values in of_tiles if name in values]
    count = np.array([part.num_points for part in parts], dtype=float)
    known = [part.correlation is not None for part in parts]
    if not any(known):
        return Consistency(int(count.sum()), None, max((part.contrast for part in parts), default=0.0))
    correlation = float(np.average([part.correlation or 0.0 for part in parts], weights=count * known))
    contrast = float(np.sqrt(np.average([part.contrast**2 for part in parts], weights=np.maximum(count, 1.0))))
    return Consistency(int(count.sum()), correlation, contrast)


def estimate_colour(job: Job, folder: Path, needs: Mapping[str, Path]) -> None:
    """Estimate the absorption of the water from the photographs that have a height map."""
    # Imported where it is needed: it takes torch, whose import takes seconds.
    from fields.colour.true_colour import estimate_absorption

    with job.progress.stage("Water colour"):
        try:
            absorption = estimate_absorption(job.sources(Stored(needs["sweep"] / MAPS, HeightMap)))
        except ValueError as error:
            raise SurveyError(
                f"the absorption of the water cannot be estimated from the photographs: {error}; give [water] "
                "absorption_per_m and veiling_light in survey.toml, or leave --true-colour out"
            ) from error
        write_json(folder / COLOUR_FILE, {"absorption_per_m": absorption})


def use_colour(job: Job, folder: Path) -> None:
    """Give the job's survey the absorption that was found, and no veiling light."""
    red, green, blue = read_json_object(folder / COLOUR_FILE)["absorption_per_m"]
    _, given = job.survey.require_water()
    water = replace(given, absorption_per_m=(red, green, blue), veiling_light=(0.0, 0.0, 0.0))
    listed = ", ".join(f"{a:.3f}" for a in (red, green, blue))
    note = f"absorption_per_m = [{listed}], from the photographs, and no veiling_light"
    findings = job.survey.findings + Findings(assumptions=(note,))
    job.survey = replace(job.survey, config=replace(job.survey.config, water=water), findings=findings)
    job.progress.detail(f"water colour: {note}")
