"""`bathynerf field`: one of the published radiance fields on the photographs of a finished run."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from evaluation import distance_statistics, psnr
from fields.image_based import NovelView, heights_over
from fields.volume.losses import Losses, PatchWeights, PriorWeights
from fields.volume.models import MODELS
from fields.volume.renderer import VolumeRenderer
from fields.volume.sampling import Cells
from fields.volume.surface import Rule, Surface, surface_of
from fields.volume.train import Checkpoints, Training, VolumeFigures, train_volume
from geo import read_reference
from geo.las import write_cloud
from refract import PinholeCamera
from survey.compare.comparison import compare_files
from survey.compare.figures import numbers_of
from survey.compare.options import CompareOptions
from survey.display.quantities import length
from survey.errors import SurveyError
from survey.export.loaded import LoadedRun, flight_of
from survey.export.render import Target, targets_of, write_views
from survey.files.json_values import write_json
from survey.progress import current, shares
from survey.run.flight import Flight
from survey.settings.tables import LossesConfig
from survey.volume.monocular import priors_hash
from survey.volume.scene import Scene, SceneOptions, VolumeFolder, load_scene
from survey.volume.stored import VolumeRecipe, view_of

CLOUD, REPORT, VIEWS, HELD = "cloud.las", "report.json", "views", "held out"
# Weights of depth and of normals (MonoSDF, Yu et al. 2022).
MONOCULAR = (0.1, 0.05)


@dataclass(frozen=True)
class VolumeOptions:
    """Options of the training of a radiance field on a run, and of its products."""

    model: str = "mdw"  # key of `fields.volume.models.MODELS`
    # steps, rays, samples: Steps of training, paths of each, and samples of each path
    steps: int = 2000
    rays: int = 4096
    samples: int = 48
    cells: int = 256  # Along the longest edge at the finest scale, of models that have cells
    image_scale: float | None = None  # [-], optional: of the photographs; default: two pixels a cell
    # (E0, N0, E1, N1), optional, in crs: part of the bed; default: all of it
    bounds: tuple[float, float, float, float] | None = None
    held_every: int | None = None  # optional: every so many photographs one is left out and predicted
    from_scratch: bool = False  # Surfaces may be anywhere in the box at first; else within two cells of the run's bed
    straight: bool = False  # Rays are not bent, as in the fields of others
    appearance: bool = False  # A vector for each photograph that changes colours, for changing light
    rule: Rule = Rule.median  # Where on a path the surface is
    # [1/m], optional: of ``Rule.density``; default: half of the light is stopped within a cell
    density: float | None = None
    reference: Path | None = None  # optional: mesh or cloud that the surface is compared with
    cameras: Path | None = None  # optional: poses of views to render; ``dry``, without the water
    dry: bool = False
    survey: str | None = None  # optional: folder of the survey, if it was moved since the run
    device: str = "auto"  # "auto", "cpu", "cuda" or "torch"
    seed: int = 0
    monocular: Path | None = None  # optional: folder of monocular depth and normals, see `survey.volume.monocular`
    # Where none of depth and normal has a weight, those of MonoSDF count with ``monocular``
    losses: LossesConfig = field(default_factory=LossesConfig)

    def __post_init__(self):
        if self.model not in MODELS:
            raise SurveyError(f"there is no model {self.model}; expected one of {', '.join(MODELS)}")
        for name, least in (("steps", 1), ("rays", 1), ("samples", 2), ("cells", 8), ("held_every", 2)):
            value = getattr(self, name)
            if value is not None and value < least:
                raise SurveyError(f"{name} is {value}, expected at least {least}")
        if self.image_scale is not None and not 0.0 < self.image_scale <= 1.0:
            raise SurveyError(f"the image scale is {self.image_scale:g}, expected more than 0 and at most 1")
        if self.density is not None and not 0.0 < self.density < np.inf:
            raise SurveyError(f"the density is {self.density:g}, expected more than 0, in 1/m")
        if self.monocular is None and (self.losses.depth or self.losses.normal or self.losses.predicted_normal):
            raise SurveyError(
                "losses on monocular depth or normals have a weight, but there are none; name their folder with "
                "--monocular DIR"
            )

    def of_training(self, run: LoadedRun) -> dict[str, Any]:
        """Dependencies of the trained field."""
        made = ("rule", "density", "reference", "cameras", "dry", "survey", "device")
        settings = {k: v for k, v in asdict(self).items() if k not in made}
        priors = None if self.monocular is None else priors_hash(self.monocular)
        return {"result": run.stages} | settings | {"monocular": priors}

    @property
    def scene(self) -> SceneOptions:
        """Options of the box and its photographs."""
        return SceneOptions(**{each.name: getattr(self, each.name) for each in fields(SceneOptions)})

    @property
    def recipe(self) -> VolumeRecipe:
        """Options of the model and its paths."""
        return VolumeRecipe(**{name: getattr(self, name) for name in VolumeRecipe.__dataclass_fields__})

    def of_losses(self) -> Losses:
        """The weights of the losses."""
        of = self.losses
        depth, normal = of.depth, of.normal
        if self.monocular is not None and not (depth or normal or of.predicted_normal):
            depth, normal = MONOCULAR
        return Losses(
            transparency=of.transparency,
            distortion=of.distortion,
            orientation=of.orientation,
            density=of.density,
            gaussian_density=of.gaussian_density,
            printed_density=of.printed_density,
            printed_gaussian_density=of.printed_gaussian_density,
            empty=of.empty,
            virtual_views=of.virtual_views,
            patches=PatchWeights(of.patch_px, of.ncc, of.ssim, of.smooth_normals, of.virtual_patches),
            priors=PriorWeights(depth=depth, normal=normal, predicted_normal=of.predicted_normal),
        )


@dataclass(frozen=True)
class Trained:
    """A field with what it was trained on."""

    renderer: VolumeRenderer
    cells: Cells
    figures: VolumeFigures
    scene: Scene
    flight: Flight
    options: VolumeOptions


def train_field(run: str | Path, output: str | Path, options: VolumeOptions | None = None) -> dict[str, Any]:
    """Train a radiance field on a run, or go on with it, and write what it shows.

    Into the folder go the state of the training (an interrupted one goes on), ``cloud.las`` with the surface,
    ``report.json`` with all figures, and pictures of views and of photographs that were left out.

    Parameters
    ----------
    run : Path
        Folder that `bathynerf process` made.
    output : Path
        A new folder, or one with the same training in it.

    Returns
    -------
    dict
        The figures.

    Raises
    ------
    SurveyError, GeoError
        If the run, its photographs, the bounds, the cameras or the reference cannot be used.
    OutputError
        If the folder holds something else.
    """
    options, output = options or VolumeOptions(), Path(output)
    if options.reference is not None:
        # One that cannot be read is refused before the training, not after it.
        read_reference(options.reference)
    with LoadedRun(run) as loaded:
        flight = flight_of(loaded, options.survey)
        targets = _targets(loaded, flight, output, options)
        folder = VolumeFolder(output, options.of_training(loaded), loaded.folder.inputs())
        with current().stage("Photographs", len(flight.views)) as stage:
            scene = load_scene(loaded, flight, options.scene, stage.advance)
        trained = train(scene, flight, options, folder)
        surface = _surface(trained)
        _write_cloud(output / CLOUD, surface, loaded, flight)
        report = {
            "model": options.model,
            "training": asdict(trained.figures),
            "box_m": scene.box.size.tolist(),
            "photographs": len(scene.train.names),
            "pixel_m": scene.pixel_m,
            "points": len(surface.xyz),
            "over_the_bed_of_the_run_m": _over_bed(surface, scene),
            "held_out_psnr_db": _held_out(trained, output / HELD),
        }
    if options.reference is not None:
        found = compare_files(output / CLOUD, options.reference, options=CompareOptions(bounds=options.bounds))
        report["compared"] = numbers_of(found)
    if targets:
        write_views(targets, lambda camera: _view(trained, camera, dry=options.dry))
    write_json(output / REPORT, report)
    return report


def _targets(run: LoadedRun, flight: Flight, output: Path, options: VolumeOptions) -> list[Target]:
    return [] if options.cameras is None else targets_of(run.folder, flight.frame, options.cameras, output / VIEWS)


def train(scene: Scene, flight: Flight, options: VolumeOptions, checkpoints: Checkpoints | None = None) -> Trained:
    """Train the field of the options on a scene of a flight, or go on from a checkpoint."""
    renderer = options.recipe.renderer(
        scene.box,
        flight.water,
        len(scene.train.names),
        options.device,
        normal_head=options.losses.predicted_normal > 0.0,
    )
    cells = min(Training.cells, options.cells)
    training = Training(
        steps=options.steps,
        rays=options.rays,
        samples=options.samples,
        cells=cells,
        huber=options.losses.huber,
        losses=options.of_losses(),
    )
    start = None if options.from_scratch else scene.cells_about_bed(training.cells, training.margin)
    with current().stage("Training", 1.0) as stage:
        proxy, figures = train_volume(
            renderer,
            scene.train.photographs,
            training,
            shares(stage),
            cells=start,
            seed=options.seed,
            checkpoints=checkpoints,
        )
    return Trained(renderer, proxy, figures, scene, flight, options)


def _surface(trained: Trained) -> Surface:
    """The surface in cells of a pixel, or of half a cell of the field where that is more."""
    of, scene = trained.options, trained.scene
    cell = scene.box.edge / of.cells
    photographs = scene.train.photographs
    with current().stage("Surface", len(photographs.cameras)) as stage:
        return surface_of(
            trained.renderer,
            photographs,
            trained.cells,
            samples=of.samples,
            side=max(scene.pixel_m, 0.5 * cell),
            rule=of.rule,
            density=of.density or np.log(2.0) / cell,
            advance=stage.advance,
        )


def _write_cloud(path: Path, surface: Surface, run: LoadedRun, flight: Flight) -> None:
    depth = np.full(len(surface.xyz), np.nan) if flight.water is None else -heights_over(surface.xyz, flight.water)
    write_cloud(
        path,
        flight.frame.crs_from_local(surface.xyz),
        run.place.crs,
        rgb=surface.rgb,
        depth_m=depth.astype(np.float32),
        std_m=surface.std.astype(np.float32),
        num_views=np.minimum(surface.num_views, 255).astype(np.uint8),
        incidence_deg=np.degrees(surface.incidence),
        is_wet=depth > 0.0,
    )


def _over_bed(surface: Surface, scene: Scene) -> dict[str, Any]:
    """Heights [m] of the surface over the nearest points of the run's bed in plan."""
    _, nearest = cKDTree(scene.bed[:, :2]).query(surface.xyz[:, :2])
    return asdict(distance_statistics(surface.xyz[:, 2] - scene.bed[nearest, 2]))


def _held_out(trained: Trained, folder: Path) -> dict[str, float]:
    """PSNR [dB] of the photographs that were left out, over the pixels that show the box; their pictures go there."""
    held, found = trained.scene.held, {}
    targets = [
        Target(name, camera, folder / Path(name).with_suffix(""))
        for name, camera in zip(held.names, held.photographs.cameras, strict=True)
    ]
    if not targets:
        return {}
    views: dict[int, NovelView] = {}
    write_views(targets, lambda camera: views.setdefault(id(camera), _view(trained, camera)))
    for number, target in enumerate(targets):
        mask = np.zeros(target.camera.width * target.camera.height, dtype=bool)
        mask[held.photographs.pixels[number]] = True
        shown = views[id(target.camera)].rgb / 255.0
        found[target.name] = psnr(held.photographs.images[number] / 255.0, shown, mask.reshape(shown.shape[:2]))
    return found


def _view(trained: Trained, camera: PinholeCamera, *, dry: bool = False) -> NovelView:
    return view_of(
        trained.renderer, trained.cells, trained.options.recipe, trained.flight.water, camera, dry=dry
    )  # fmt: skip


def rows_of(report: dict[str, Any], output: Path) -> list[tuple[str, str]]:
    """Rows that the command prints of `train_field`: labels and values."""
    training, over = report["training"], report["over_the_bed_of_the_run_m"]
    rows = [
        ("model", f"{report['model']}, {training['parameters']:,} parameters, {training['steps']:,} steps"),
        ("photographs", f"{report['photographs']} learned from, to {training['psnr_db']:.1f} dB"),
    ]
    if report["held_out_psnr_db"]:
        held = list(report["held_out_psnr_db"].values())
        rows.append(("held out", f"{len(held)} photographs predicted to {np.mean(held):.1f} dB (mean)"))
    rows.append(("surface", f"{report['points']:,} points"))
    if report["points"]:
        inner = f"{length(over['mean_inner90_m'])} +- {length(over['std_inner90_m'])}"
        rows.append(("over the run's bed", f"{inner} (inner 90 %, mean and std)"))
    if "compared" in report:
        to = report["compared"]
        rows.append(("over the reference", f"{length(to['mean_inner90_m'])} +- {length(to['std_inner90_m'])}"))
    return [*rows, ("in", str(output))]
