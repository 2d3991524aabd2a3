"""A radiance field trained on the photographs of a run, and its surface."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from itertools import count
from typing import Any

import numpy as np
import psutil

from fields.image_based import NovelView
from fields.volume.fitted import match_appearance
from fields.volume.photographs import Photographs
from fields.volume.surface import Surface, distance_of, points_on_surface, surface_of
from fields.volume.train import Checkpoints, OtherState, Training, VolumeFigures, train_volume
from refract import PinholeCamera
from survey.errors import SurveyError
from survey.progress import current
from survey.run.flight import Flight
from survey.run.trained_field import RestoredField, reporting
from survey.volume.options import VolumeOptions
from survey.volume.scene import Scene

MATCHING_RAYS = 2048  # Rays of a step of the matching of appearances, where a step of the training has no fewer


@dataclass(frozen=True)
class Trained:
    """A trained field with its training data."""

    field: RestoredField
    figures: VolumeFigures
    scene: Scene
    options: VolumeOptions
    # Time of the steps, on the clock of this command's alone, memory after them, and rays/s by that clock, if any
    cost: dict[str, float]

    def held_views(self) -> Iterator[NovelView]:
        """Views of the cameras held out, each in an appearance that fits the left half of its photograph."""
        held, of, own = self.scene.held, self.field, self.field.renderer.appearance
        if own is not None and any(len(pixels) for pixels in held.left_half.pixels):
            rays, seed = min(self.options.rays, MATCHING_RAYS), self.options.seed
            of.renderer.appearance = match_appearance(of.renderer, held.left_half, of.cells, rays=rays, seed=seed)
        try:
            yield from (of.view(camera, False, look) for look, camera in enumerate(held.cameras))
        finally:
            of.renderer.appearance = own

    def report(self) -> dict[str, Any]:
        """Figures of the training."""
        return {
            "training": asdict(self.figures),
            "cost": self.cost,
            "box_m": self.scene.box.size.tolist(),
            "photographs": len(self.scene.train.names),
            "pixel_m": self.scene.pixel_m,
        }


@dataclass(frozen=True)
class FieldResult:
    """A trained field for its products: surface, figures, views, and the photographs held out."""

    surface: Surface
    bed: np.ndarray  # (N, 3) [m], local: of the run
    held: Photographs  # that were left out
    view: Callable[[PinholeCamera, bool], NovelView]  # As `RestoredField.view`
    held_views: Iterable[NovelView]  # Of the photographs that were left out
    report: dict[str, Any]


def train(scene: Scene, flight: Flight, options: VolumeOptions, checkpoints: Checkpoints | None = None) -> Trained:
    """Train the field of the options on a scene of a flight, or continue from a checkpoint."""
    renderer = options.recipe.renderer(scene.box, flight.water, len(scene.train.names), options.device)
    training = Training(
        steps=options.steps,
        rays=options.rays,
        samples=options.samples,
        cells=min(Training.cells, options.cells),
        losses=options.of_losses(),
    )
    start = None if options.from_scratch else scene.cells_about_bed(training.cells, training.margin)
    with current().stage("Training", 1.0) as stage:
        report, held = reporting(stage, training.rays, steps := count(1)), None if options.submodules else scene.held
        try:
            proxy, figures = train_volume(
                renderer, scene.train, training, report, cells=start, seed=options.seed, checkpoints=checkpoints,
                held=held,
            )  # fmt: skip
        except OtherState as error:
            raise SurveyError(
                f"the training in this folder cannot go on: its parameters are others, as of an earlier version "
                f"({str(error)[:80]}); name another folder, and training begins anew"
            ) from error
    memory, wall_s = psutil.Process().memory_info().rss, stage.seconds
    cost = {"wall_s": wall_s, "cpu_s": figures.cpu_s, "memory_bytes": memory}
    if taken := next(steps) - 1:
        cost["rays_per_s"] = taken * training.rays / wall_s
    field = RestoredField(renderer, proxy, options.recipe, flight.water, options.steps)
    return Trained(field, figures, scene, options, cost)


def surface_in(trained: Trained) -> Surface:
    """Surface points of a field, in cells of a pixel or of half a cell of the field, whichever is larger."""
    of, scene, field = trained.options, trained.scene, trained.field
    cell = scene.box.edge / of.cells
    with current().stage("Surface", len(scene.train.cameras)) as stage:
        distance = partial(distance_of, rule=of.rule, density=of.density or np.log(2.0) / cell)
        points = points_on_surface(
            field.renderer, scene.train, field.cells, samples=of.samples, distance=distance, advance=stage.advance
        )
        return surface_of(points, scene.box, max(scene.pixel_m, 0.5 * cell))
