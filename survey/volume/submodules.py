"""Submodules of `bathynerf field`: a field for each cell on the ground, trained one after the other, and their views.

A view reads them from their folders when it needs them. And the folder of a whole field, read back to be rendered.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cache, lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from fields.device import choose_device
from fields.image_based import NovelView
from fields.sweep.kernels.arrays import free_unused
from fields.volume import submodules
from fields.volume.fitted import Visibility, train_visibility
from fields.volume.paths import Box
from fields.volume.photographs import Photographs
from fields.volume.sampling import Cells
from fields.volume.surface import Surface
from geo.files import write_whole
from refract import FlatWater, PinholeCamera
from survey.errors import SurveyError
from survey.export.loaded import LoadedRun
from survey.export.render import targets_of, write_seen
from survey.files.json_values import read_json_object, write_json
from survey.progress import current
from survey.run.flight import Flight
from survey.run.stored import FIELD_SETTINGS, FIELD_STATE, SUBMODULES, is_field, run_of
from survey.run.trained_field import VolumeRecipe, novel_view, read_state
from survey.volume import scene
from survey.volume.options import VolumeOptions
from survey.volume.training import FieldResult, Trained, surface_in, train
from survey.words import Drop

# Folder of the submodules in that of their field; file of their matched appearance vectors there; visibility of each.
VECTORS, VISIBILITY = "looks.json", "visibility.pt"
IN_MEMORY = 1  # Submodules that are kept in memory: while the next one is read there are two


class SubmoduleViews:
    """Renderer of the trained submodules of the field in a folder, which are loaded when they are needed.

    The ground is that of all, counts are their cells along x and y, ``drop`` is a word of `survey.words.Drop`.
    """

    def __init__(
        self,
        folder: Path,
        recipe: VolumeRecipe,
        ground: scene.BedBox,
        counts: tuple[int, int],
        device: str,
        drop: str = Drop.geometry,
    ):
        self.recipe, self.ground, self.device, self.drop = recipe, ground, device, drop
        self.grid = submodules.Grid(ground.box, counts)
        self.folder = folder
        self._with_bed: list[str] = []
        self.folders: dict[int, Path] = {}
        self.boxes: dict[int, Box] = {}
        for number, name in enumerate(self.grid.names()):
            part = ground.within(self.grid.box_of(number), recipe.cells)
            if part is None:
                continue
            self._with_bed.append(name)
            if (folder / SUBMODULES / name / FIELD_STATE).is_file():
                self.folders[number], self.boxes[number] = folder / SUBMODULES / name, part.box
        if not self.folders:
            raise SurveyError(
                f"nothing of the field in {folder} is trained yet; run bathynerf field again with the same options"
            )
        self.grid = replace(self.grid, trained=tuple(self.folders))
        self._kept = lru_cache(IN_MEMORY)(self.load)
        self._visibility = cache(self._load_visibility)

    def unfinished(self) -> list[str]:
        """Notes on missing training: cells with a bed that have none, and steps."""
        parts, report = [], self.folder / scene.REPORT
        left_out = read_json_object(report).get("left_out", {}) if report.is_file() else {}
        cells = sum(name not in left_out for name in self._with_bed)
        if len(self.folders) < cells:
            parts.append(f"{len(self.folders)} of {cells} cells of {self.folder} are trained so far")
        for folder in self.folders.values():
            if (step := read_state(folder / FIELD_STATE).get("step", 0)) < self.recipe.steps:
                parts.append(f"the training of {folder} has done {step} of {self.recipe.steps} steps so far")
        return parts

    def load(self, number: int) -> submodules.Submodule:
        """A submodule, with the matched appearance where there is one."""
        folder = self.folders[number]
        field = self.recipe.restored(folder / FIELD_STATE, self.boxes[number], self.ground.water, self.device)
        renderer = field.renderer
        vectors = folder.parent / VECTORS
        if self.recipe.appearance and vectors.is_file():
            vector = torch.tensor(read_json_object(vectors)[folder.name], dtype=torch.float32)
            renderer.appearance = submodules.single_vector(vector.to(renderer.model.place))
        return submodules.Submodule(number, renderer, field.cells)

    def _load_visibility(self, number: int) -> tuple[Visibility, Cells]:
        saved = read_state(self.folders[number] / VISIBILITY)
        box = self.boxes[number]
        network = Visibility(box)
        network.load_state_dict(saved["network"])
        return network, Cells(box, saved["occupied"])

    def visible(self, camera: PinholeCamera, water: FlatWater | None) -> np.ndarray:
        """Visibilities (M,) of the submodules to a camera; 1 where none is left out."""
        if self.drop == Drop.geometry:
            return submodules.ground_shares(self.grid, self.ground.bed, camera, water)[list(self.folders)]
        if self.drop == Drop.network:
            each = [self._visibility(number) for number in self.folders]
            return np.array([network.of_view(camera, water, cells) for network, cells in each])
        return np.ones(len(self.folders))

    def dropped(self, camera: PinholeCamera) -> dict[str, float]:
        """Visibilities of the submodules that are left out of the view of a camera, by their names."""
        visible, folders = self.visible(camera, self.ground.bent), list(self.folders.values())
        return {
            folders[k].name: float(visible[k]) for k in np.setdiff1d(np.arange(len(visible)), submodules.kept(visible))
        }

    def view(self, camera: PinholeCamera, dry: bool = False) -> NovelView:
        """View of a camera, with the water or, ``dry``, without it."""
        water = None if dry else self.ground.bent
        weights = submodules.pose_weights(camera.centre, list(self.boxes.values()))
        numbers = list(self.folders)
        chosen = ((weights[k], self._kept(numbers[k])) for k in submodules.kept(self.visible(camera, water)))
        seen = submodules.render_submodules(chosen, self.grid, camera, water, samples=self.recipe.samples, dry=dry)
        return novel_view(seen, self.ground.water, has_background=self.recipe.shell)


@dataclass(frozen=True)
class StoredVolume:
    """The folder of a volume beside the run that it was trained on."""

    folder: Path
    recipe: VolumeRecipe
    ground: scene.BedBox
    counts: tuple[int, int] | None  # submodules along x and y; None: it is one volume
    water: FlatWater | None  # Of the run
    drop: str = Drop.geometry  # A word of `survey.words.Drop`

    @staticmethod
    def of_run(folder: Path, run: LoadedRun) -> StoredVolume:
        """The volume in a folder, if it was trained on this run as it is now."""
        if not is_field(folder):
            raise SurveyError(
                f"{folder} holds no trained field ({FIELD_SETTINGS} and {FIELD_STATE}); train one: bathynerf field "
                f"{run.folder.path} -o {folder}"
            )
        settings = read_json_object(folder / FIELD_SETTINGS)
        if settings.get("result") != run.stages:
            raise SurveyError(
                f"the field in {folder} was trained on another run, or on an earlier result of {run.folder.path}; "
                "train one on this result: bathynerf field, into another folder"
            )
        try:
            recipe = VolumeRecipe.of(settings)
            bounds = None if settings["bounds"] is None else tuple(settings["bounds"])
            options = VolumeOptions(cells=recipe.cells, bounds=bounds, straight=recipe.straight)
            ground = scene.BedBox.of_run(run, run.flight, options)
            counts = settings["submodules"] and submodules.counts_of(settings["submodules"], ground.box.size)
        except (KeyError, TypeError, ValueError) as error:
            raise SurveyError(
                f"{folder / FIELD_SETTINGS} cannot be read ({error!r}); delete the folder, and train the field again"
            ) from error
        return StoredVolume(folder, recipe, ground, counts, run.flight.water)

    def load(
        self, device: str = "auto", note: Callable[[str], None] = lambda text: current().note(text)
    ) -> Callable[[PinholeCamera, bool], NovelView]:
        """Render function of the field, with the water or ``dry``; ``note`` is told of unfinished training."""
        if self.counts is not None:
            views = SubmoduleViews(self.folder, self.recipe, self.ground, self.counts, device, self.drop)
            for text in views.unfinished():
                note(text)
            return views.view
        field = self.recipe.restored(self.folder / FIELD_STATE, self.ground.box, self.water, device)
        if field.step < self.recipe.steps:
            note(f"the training of {self.folder} has done {field.step} of {self.recipe.steps} steps so far")
        return field.view


def render_field(
    folder: str | Path,
    cameras: str | Path,
    output: str | Path,
    *,
    dry: bool = False,
    device: str = "auto",
    video_s: float | None = None,
) -> list[Path]:
    """Render the field in a folder for the cameras of a file; pictures and errors as `survey.export.render.render`."""
    folder = Path(folder)
    with LoadedRun(run_of(folder)) as run:
        view = StoredVolume.of_run(folder, run).load(device)
        targets = targets_of(run.folder, run.flight.frame, Path(cameras), Path(output))
        return write_seen(targets, Path(output), video_s, lambda _cameras: lambda camera: view(camera, dry))


VISIBILITY_STEPS = 0.1  # Steps of the training of a network of visibility, of those of the field
# A pixel of the photographs is at most so many cells of a volume wide: finer ones show nothing more.
MOST_CELLS_PER_PIXEL = 4


def train_submodules(run: LoadedRun, flight: Flight, options: VolumeOptions, folder: scene.VolumeFolder) -> FieldResult:
    """A field for each cell on the ground that has a bed and photographs, each in a folder of its own.

    A cell is read, trained and made a surface of before the next, so that one of them is in memory; a training that was
    stopped goes on with the cell it was at. Cells of which too little is known are named and left out.
    """
    ground = scene.BedBox.of_run(run, flight, options)
    grid = _grid_of(ground, options)
    # Photographs are as large as the largest cell needs them.
    ground = ground.read_for(max(grid.box_of(number).size[:2].max() for number in range(len(grid))), options)
    held = scene.held_photographs(ground, flight, options)
    surfaces: list[Surface] = []
    reports, left_out = {}, {}
    for number, name in enumerate(grid.names()):
        part = ground.within(grid.box_of(number), options.cells)
        message = f"{name}, {number + 1} of {len(grid)}"
        try:
            trained = _trained(part, flight, options, partial(folder.part, f"{SUBMODULES}/{name}"), held, message)
        except scene.TooFewPhotographs as error:
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


def _grid_of(ground: scene.BedBox, options: VolumeOptions) -> submodules.Grid:
    grid = submodules.Grid(ground.box, submodules.counts_of(str(options.submodules), ground.box.size))
    least = options.cells * ground.gsd_m / MOST_CELLS_PER_PIXEL / (1 + 2 * submodules.RIM)
    if grid.size.min() < least:
        most = "x".join(str(max(int(edge / least), 1)) for edge in ground.box.size[:2])
        raise SurveyError(
            f"--submodules {options.submodules} makes cells of {grid.size[0]:.3g} m x {grid.size[1]:.3g} m on the "
            f"ground, expected at least {least:.3g} m with --cells {options.cells} and pixels of {ground.gsd_m:.3g} m; "
            f"ask for {most} at most, or give smaller --cells"
        )
    return grid


def _trained(
    part: scene.BedBox | None,
    flight: Flight,
    options: VolumeOptions,
    begun: Callable[[], scene.VolumeFolder],
    held: Photographs,
    what: str,
) -> Trained:
    """The field of a cell, by the photographs that show its box and are not held; ``begun`` makes its folder."""
    if part is None:
        raise scene.TooFewPhotographs("the run has no bed there")
    with current().stage(f"Photographs of {what}", len(flight.views)) as stage:
        learned = scene.training_photographs(part, flight, options, held, stage.advance)
    folder = begun()
    trained = train(part.scene(learned, held), flight, options, folder)
    if options.drop == Drop.network and not (folder.path / VISIBILITY).is_file():
        with current().stage("Visibility"):
            steps = max(round(VISIBILITY_STEPS * options.steps), 1)
            field = trained.field
            network = train_visibility(field.renderer, learned, field.cells, steps=steps, seed=options.seed)
        with write_whole(folder.path / VISIBILITY) as stream:
            torch.save({"network": network.cpu().state_dict(), "occupied": field.cells.occupied.cpu()}, stream)
    return trained


def _matched_vectors(views: SubmoduleViews, flight: Flight, ground: scene.BedBox) -> dict[str, list[float]]:
    """Appearance vectors (A,) of all submodules, matched to that of the middle one in its first photograph."""
    numbers, boxes = list(views.boxes), list(views.boxes.values())
    middle = 0.5 * (ground.box.low + ground.box.high)
    root = int(np.argmin([np.linalg.norm(0.5 * (box.low + box.high) - middle) for box in boxes]))
    vectors = {root: submodules.vectors_of(views.load(numbers[root]))[0]}
    cameras = [view.camera for view in flight.views]
    with current().stage("Appearance", len(numbers) - 1) as stage:
        # Two are in memory at a time.
        for m, n in submodules.matching_pairs(boxes, root, ground.bed):
            source, target = views.load(numbers[n]), views.load(numbers[m])
            source.renderer.appearance = submodules.single_vector(vectors[n])
            submodules.match_submodule(target, source, cameras, ground.bed, ground.bent)
            vectors[m] = submodules.vectors_of(target)[0]
            del source, target
            free_unused(choose_device(views.device))
            stage.advance()
    return {views.folders[number].name: vectors[k].tolist() for k, number in enumerate(numbers)}


def _summary(reports: dict[str, dict[str, Any]], ground: scene.BedBox) -> dict[str, Any]:
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
