"""Submodules of `bathynerf field`: a field for each cell on the ground, one trained after the other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from fields.device import choose_device
from fields.sweep.kernels.arrays import free_unused
from fields.volume.photographs import Photographs
from fields.volume.submodules import RIM, Grid, counts_of, match_submodule, matching_pairs, single_vector, vectors_of
from fields.volume.surface import Surface
from fields.volume.visibility import train_visibility
from geo.files import write_whole
from survey.errors import SurveyError
from survey.export.loaded import LoadedRun
from survey.files.json_values import write_json
from survey.progress import current
from survey.run.flight import Flight
from survey.volume.folder import SUBMODULES
from survey.volume.options import VolumeOptions
from survey.volume.scene import (
    BedBox,
    TooFewPhotographs,
    VolumeFolder,
    held_photographs,
    photographs_of,
    training_photographs,
)
from survey.volume.submodule_views import VECTORS, VISIBILITY, SubmoduleViews
from survey.volume.training import FieldResult, Trained, surface_in, train
from survey.words import Drop

# Steps of the training of a network of visibility, of those of the field.
VISIBILITY_STEPS = 0.1
# A pixel of the photographs is at most so many cells of a volume wide: finer ones show nothing more.
MOST_CELLS_PER_PIXEL = 4


def train_submodules(run: LoadedRun, flight: Flight, options: VolumeOptions, folder: VolumeFolder) -> FieldResult:
    """A field for each cell on the ground that has a bed and photographs, each in a folder of its own.

    A cell is read, trained and made a surface of before the next, so that one of them is in memory; a training that was
    stopped goes on with the cell it was at. Cells of which too little is known are named and left out.
    """
    ground = BedBox.of_run(run, flight, options)
    grid = _grid_of(ground, options)
    # Photographs are as large as the largest cell needs them.
    ground = ground.read_for(max(grid.box_of(number).size[:2].max() for number in range(len(grid))), options)
    held = held_photographs(ground, flight, options)
    surfaces: list[Surface] = []
    reports, left_out = {}, {}
    for number, name in enumerate(grid.names()):
        part = ground.within(grid.box_of(number), options.cells)
        message = f"{name}, {number + 1} of {len(grid)}"
        try:
            trained = _trained(part, flight, options, partial(folder.part, f"{SUBMODULES}/{name}"), held, message)
        except TooFewPhotographs as error:
            left_out[name] = str(error)
            current().note(f"submodule {name} is left out: {error}")
            continue
        surface = surface_in(trained)
        free_unused(choose_device(options.device))
        own = grid.owner(surface.xyz) == number
        surfaces.append(Surface(*(getattr(surface, column.name)[own] for column in fields(Surface))))
        reports[name] = trained.report() | {"points": len(surfaces[-1].xyz)}
    if not reports:
        raise SurveyError(f"none of {len(grid)} submodules has enough photographs; ask for fewer --submodules")
    views = SubmoduleViews(
        folder.path, options.recipe, ground, grid.counts, options.device, options.drop or Drop.geometry
    )
    if options.appearance and not (folder.path / SUBMODULES / VECTORS).is_file():
        write_json(folder.path / SUBMODULES / VECTORS, _matched_vectors(views, flight, ground))
    report = _summary(reports, ground) | {"left_out": left_out, "submodules": reports}
    named = zip(held.names, held.cameras, strict=True)
    report["dropped"] = {name: views.dropped(camera) for name, camera in named}
    held_views = (views.view(camera) for camera in held.cameras)
    joined = Surface(*(np.concatenate([getattr(e, column.name) for e in surfaces]) for column in fields(Surface)))
    return FieldResult(joined, ground.scene(held, held).bed, held, views.view, held_views, report)


def _grid_of(ground: BedBox, options: VolumeOptions) -> Grid:
    grid = Grid(ground.box, counts_of(str(options.submodules), ground.box.size))
    least = options.cells * ground.gsd_m / MOST_CELLS_PER_PIXEL / (1 + 2 * RIM)
    if grid.size.min() < least:
        most = "x".join(str(max(int(edge / least), 1)) for edge in ground.box.size[:2])
        raise SurveyError(
            f"--submodules {options.submodules} makes cells of {grid.size[0]:.3g} m x {grid.size[1]:.3g} m on the "
            f"ground, expected at least {least:.3g} m with --cells {options.cells} and pixels of {ground.gsd_m:.3g} m; "
            f"ask for {most} at most, or give smaller --cells"
        )
    return grid


def _trained(
    part: BedBox | None,
    flight: Flight,
    options: VolumeOptions,
    begun: Callable[[], VolumeFolder],
    held: Photographs,
    what: str,
) -> Trained:
    """The field of a cell, by the photographs that show its box and are not held; ``begun`` makes its folder."""
    if part is None:
        raise TooFewPhotographs("the run has no bed there")
    names = set(held.names)
    with current().stage(f"Photographs of {what}", len(flight.views)) as stage:
        shown = photographs_of(part, flight, stage.advance, lambda name: name not in names)
    learned = training_photographs(shown, part, options, len(flight.views))
    folder = begun()
    trained = train(part.scene(learned, held), flight, options, folder)
    if options.drop == Drop.network and not (folder.path / VISIBILITY).is_file():
        _save_visibility(trained, folder.path / VISIBILITY)
    return trained


def _save_visibility(trained: Trained, path: Path) -> None:
    with current().stage("Visibility"):
        of, photographs = trained.options, trained.scene.train
        steps = max(round(VISIBILITY_STEPS * of.steps), 1)
        network = train_visibility(trained.renderer, photographs, trained.cells, steps=steps, seed=of.seed)
    with write_whole(path) as stream:
        torch.save({"network": network.cpu().state_dict(), "occupied": trained.cells.occupied.cpu()}, stream)


def _matched_vectors(views: SubmoduleViews, flight: Flight, ground: BedBox) -> dict[str, list[float]]:
    """Appearance vectors (A,) of all submodules, matched to that of the middle one in its first photograph."""
    numbers, boxes = list(views.boxes), list(views.boxes.values())
    middle = 0.5 * (ground.box.low + ground.box.high)
    root = int(np.argmin([np.linalg.norm(0.5 * (box.low + box.high) - middle) for box in boxes]))
    vectors = {root: vectors_of(views.load(numbers[root]))[0]}
    cameras = [view.camera for view in flight.views]
    with current().stage("Appearance", len(numbers) - 1) as stage:
        # Two are in memory at a time.
        for m, n in matching_pairs(boxes, root, ground.bed):
            source, target = views.load(numbers[n]), views.load(numbers[m])
            source.renderer.appearance = single_vector(vectors[n])
            match_submodule(target, source, cameras, ground.bed, ground.bent)
            vectors[m] = vectors_of(target)[0]
            del source, target
            free_unused(choose_device(views.device))
            stage.advance()
    return {views.folders[number].name: vectors[k].tolist() for k, number in enumerate(numbers)}


def _summary(reports: dict[str, dict[str, Any]], ground: BedBox) -> dict[str, Any]:
    """Figures of all submodules together, with the keys of those of one field."""
    trainings = [each["training"] for each in reports.values()]
    return {
        "training": {
            "steps": sum(each["steps"] for each in trainings),
            "psnr_db": float(np.mean([each["psnr_db"] for each in trainings])),
            "parameters": sum(each["parameters"] for each in trainings),
        },
        "box_m": ground.box.size.tolist(),
        "photographs": max(each["photographs"] for each in reports.values()),
        "pixel_m": ground.pixel_m,
    }
