"""The stages of the solver: heights of the points by least squares over all photographs, with their std.

What the solver has to know of a survey is learned from a sample of all its tiles, before each is solved.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from fields.solver.noise import NoiseShares, Shifts
from fields.solver.solver import SolvedMap, SolverFigures, figures_of, solve_maps, solve_sample, spread
from fields.solver.views import Views
from fields.sweep.maps import HeightMap
from fields.waves.waves import Waves
from survey.display.quantities import length
from survey.files.json_values import read_json_object, write_json
from survey.folder.survey import Survey
from survey.progress import shares
from survey.run import stage_sweep
from survey.run.flight import Flight
from survey.run.job import Job
from survey.run.stored import load_arrays, save_arrays
from survey.run.stored_maps import Stored, StoredMasks, load_masks, map_store, save_maps
from survey.water.wave_surfaces import WaveSurfaces

FIGURES, SOLVED, SIGHTINGS, WAVES = "figures.json", "solved.npz", "sightings.json", "waves.json"
# Where the water is not still.
SURFACES = "surfaces.npz"
_OF_SURFACES = ("corner", "spacing", "coefficients", "shown", "shifts")


def learn_figures(job: Job, folder: Path, needs: Mapping[str, Path]) -> None:
    """Parameters of the solver for the survey, estimated from a sample of the pixels of all its parts."""
    places = [needs[part.stage_name("sweep")] for part in job.parts]
    with job.progress.stage("Sample of the solver"):
        squares = [read_json_object(place / stage_sweep.SQUARES)["pixels"] for place in places]
        filled = [each for of_part in squares for each in of_part]
        maps_of = [(part, number) for part, each in enumerate(squares) for number in range(len(each))]
        figures = None
        if any(map(sum, filled)):
            chosen = [(*maps_of[number], square) for number, square in spread(filled)]
            sample = []
            for part, (each, place) in enumerate(zip(job.parts, places, strict=True)):
                of_part = [(number, square) for of, number, square in chosen if of == part]
                if of_part:
                    views = Views.of(
                        each.block, Stored(place / stage_sweep.MAPS, HeightMap), stage_sweep.load_rough_water(place)[0]
                    )
                    sample += solve_sample(views, stage_sweep.learned_from(each, place), of_part, each.plan.gsd_m)
                    each.release()
            figures = figures_of(sample, job.plan.gsd_m, is_wet=job.survey.water is not None)
            job.progress.detail(f"solver: {figures}")
    save_figures(folder, figures)


def save_figures(folder: Path, figures: SolverFigures | None) -> None:
    """Write what `load_figures` reads."""
    write_json(folder / FIGURES, {"figures": None if figures is None else asdict(figures)})


def load_figures(folder: Path) -> SolverFigures | None:
    """Figures of `learn_figures`; None where there was nothing to learn from."""
    figures = read_json_object(folder / FIGURES)["figures"]
    if figures is None:
        return None
    shifts, noise = Shifts(**_known(figures["shifts"])), NoiseShares(**_known(figures["noise"]))
    return SolverFigures(**_known(figures) | {"shifts": shifts, "noise": noise})


def _known(numbers: Mapping[str, Any]) -> dict[str, Any]:
    """Numbers as they were: JSON has null for NaN."""
    return {name: math.nan if value is None else value for name, value in numbers.items()}


def solve_heights(job: Job, folder: Path, needs: Mapping[str, Path]) -> None:
    """Solve the heights of the points with what the solver has learned of the whole survey."""
    from survey.report.facts import WaveFigures  # Imports matplotlib

    swept = needs["sweep"]
    maps, figures = Stored(swept / stage_sweep.MAPS, HeightMap), load_figures(needs["figures"])
    if not len(maps):
        save_maps(folder / SOLVED, SolvedMap, [])
        write_json(folder / SIGHTINGS, {})
        write_json(folder / WAVES, asdict(WaveFigures(0.0, None)))
        return
    kept, (before, moved_px) = (
        stage_sweep.solvable(job.block, maps, load_masks(swept / stage_sweep.KEPT)),
        stage_sweep.load_rough_water(swept),
    )
    with job.progress.stage("Solver", 1.0) as stage, map_store(folder / stage_sweep.SCRATCH, SolvedMap) as make_store:
        solved, visibility, waves = solve_maps(
            Views.of(job.block, maps, before), kept, figures, job.plan.gsd_m, shares(stage), make_store
        )
        save_maps(folder / SOLVED, SolvedMap, solved)
    _save_waves(job, folder, moved_px if figures is None else max(moved_px, figures.moved_px), waves)
    names = [view.name for view in job.survey.views]
    counts = zip(names, *visibility.tolist(), strict=True)
    write_json(folder / SIGHTINGS, {name: pair for name, *pair in counts})


def _save_waves(job: Job, folder: Path, moved_px: float, waves: Waves | None) -> None:
    """What the waves of the survey are like, and the surface of each photograph, in the frame of the water."""
    from survey.report.facts import WaveFigures  # Imports matplotlib

    sea, moved = None if waves is None else waves.sea, f"photographs shifted by {moved_px:.2f} px"
    if waves is None or sea is None:
        write_json(folder / WAVES, asdict(WaveFigures(moved_px, None)))
        if job.survey.water is not None:
            job.progress.detail(f"waves: off, {moved}")
        return
    figures = WaveFigures(moved_px, asdict(sea), waves.common_std, waves.still_std, waves.left_std)
    write_json(folder / WAVES, asdict(figures))
    job.progress.detail(
        f"waves: {moved}; a surface for each: significant wave height {length(sea.significant_height_m)}, slope "
        f"{sea.slope_rms:.3f} rms, peak at a wavelength of {length(sea.peak_length_m)}"
    )
    names = np.array([view.name for view in job.survey.views])
    parts = {name: np.asarray(getattr(waves, name)) for name in _OF_SURFACES}
    save_arrays(folder / SURFACES, names=names, **parts)


def join_solved(job: Job, folder: Path, needs: Mapping[str, Path]) -> None:
    """Solved maps of whole photographs, in the order of `join_sweeps`, and how often each photograph was seen."""
    swept, solved = (stage_sweep.places_of_tiles(job, needs, name) for name in ("sweep", "solver"))
    save_maps(folder / SOLVED, SolvedMap, _whole_solved(job, swept, solved))
    sightings = [read_json_object(place / SIGHTINGS) for place in solved]
    names = [view.name for view in job.survey.views]
    counts = {name: np.sum([of_tile.get(name, (0, 0)) for of_tile in sightings], axis=0).tolist() for name in names}
    write_json(folder / SIGHTINGS, counts)
    # Of the tile with the highest waves: the others are shallow, or dry.
    seas = [read_json_object(place / WAVES) for place in solved]
    write_json(folder / WAVES, max(seas, key=lambda waves: (waves["sea"] or {}).get("significant_height_m", 0.0)))


def _whole_solved(job: Job, swept: Sequence[Path], solved: Sequence[Path]) -> Iterator[SolvedMap]:
    width, maps = job.cameras[0].width, [Stored(place / SOLVED, SolvedMap) for place in solved]
    own, views = (
        [StoredMasks(place / stage_sweep.OWN) for place in swept],
        [Stored(place / stage_sweep.MAPS, HeightMap).views for place in swept],
    )
    for of_view in stage_sweep.maps_by_view(job, swept).values():
        parts = []
        for tile, number, window in of_view:
            of_tile, mask = maps[tile.number][number], own[tile.number][number].ravel()
            keep = mask[of_tile.pixels]
            row, column = np.divmod(of_tile.pixels[keep], window.width)
            pixels = (row + window.row) * width + column + window.column
            height = tile.over_whole(views[tile.number][number], row, column, of_tile.height[keep])
            parts.append((pixels, height, of_tile.std[keep]))
        pixels, height, std = (np.concatenate(column) for column in zip(*parts, strict=True))
        # A pixel whose heights in two tiles lie on either side of the line between them is in both.
        pixels, first = np.unique(pixels, return_index=True)
        yield SolvedMap(pixels, height[first], std[first])


def load_surfaces(folder: Path, flight: Flight | Survey) -> WaveSurfaces | None:
    """The surface of each photograph of a flight; None where none were found, or the folder is that of many tiles."""
    path = folder / SURFACES
    if flight.water is None or not path.is_file():
        return None
    arrays, cameras = load_arrays(path), {view.name: view.camera for view in flight.views}
    names = arrays["names"].tolist()
    return WaveSurfaces(
        names, arrays["corner"], float(arrays["spacing"]), arrays["coefficients"], [cameras[name] for name in names],
        flight.water, flight.frame, names[int(arrays.get("shown", 0))], arrays.get("shifts", np.empty((0, 6))),
    )  # fmt: skip
