"""`bathynerf field`: one of the published radiance fields on the photographs of a finished run."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from evaluation import distance_statistics, image_quality
from fields.image_based import heights_over
from fields.sweep.bed import BedPoints
from geo import read_reference
from geo.las import write_cloud
from survey.compare.comparison import compare_files
from survey.compare.figures import numbers_of
from survey.compare.options import CompareOptions
from survey.display.quantities import length
from survey.export.loaded import LoadedRun, flight_of
from survey.export.render import Target, targets_of, write_views
from survey.files.json_values import write_json
from survey.progress import current
from survey.run.flight import Flight
from survey.run.stored import FIELD_BED, FIELD_CLOUD, StoredBed, save_bed
from survey.volume.options import VolumeOptions
from survey.volume.scene import HELD, REPORT, VIEWS, VolumeFolder, load_scene
from survey.volume.submodules import train_submodules
from survey.volume.training import FieldResult, surface_in, train


def train_field(run: str | Path, output: str | Path, options: VolumeOptions | None = None) -> dict[str, Any]:
    """Train a radiance field on a run, or continue its training, and write its surface, figures and views.

    Into the folder, a new one or one with the same training in it, go the state of the training, from which one goes
    on, the surface, ``report.json`` with all figures, which are returned, and views, also of photographs held out.
    """
    options, output = options or VolumeOptions(), Path(output)
    if options.reference is not None:
        # One that cannot be read is refused before the training, not after it.
        read_reference(options.reference)
    with LoadedRun(run) as loaded:
        flight = flight_of(loaded, options.survey)
        targets = []
        if options.cameras is not None:
            targets = targets_of(loaded.folder, flight.frame, options.cameras, output / VIEWS)
        folder = VolumeFolder(output, options.of_training(loaded), loaded.folder.inputs())
        made = (_one if options.submodules is None else train_submodules)(loaded, flight, options, folder)
        # Until there are figures of this surface, none of an earlier one.
        (output / REPORT).unlink(missing_ok=True)
        _write_surface(output, made, loaded, flight)
        report = {
            "model": options.model,
            **made.report,
            "points": len(made.surface.xyz),
            "over_the_bed_of_the_run_m": _over_bed(made),
            # With vectors of appearance the left halves are fitted, and the right ones alone are predicted.
            **_held_out(made, output / HELD, right_half=options.appearance and options.submodules is None),
        }
    if not report["points"]:
        current().note(
            f"the surface has no points: nothing that two photographs see is opaque after {options.steps:,} steps; "
            "train more of them"
        )
    elif options.reference is not None:
        found = compare_files(output / FIELD_CLOUD, options.reference, options=CompareOptions(bounds=options.bounds))
        report["compared"] = numbers_of(found)
    if targets:
        write_views(targets, lambda camera: made.view(camera, options.dry))
    write_json(output / REPORT, report)
    return report


def _one(run: LoadedRun, flight: Flight, options: VolumeOptions, folder: VolumeFolder) -> FieldResult:
    """One field over the whole bed."""
    with current().stage("Photographs", len(flight.views)) as stage:
        scene = load_scene(run, flight, options, stage.advance)
    trained = train(scene, flight, options, folder)
    surface, views = surface_in(trained), trained.held_views()
    return FieldResult(surface, scene.bed, scene.held, trained.field.view, views, trained.report())


def _write_surface(output: Path, made: FieldResult, run: LoadedRun, flight: Flight) -> None:
    """Write the points of a field as a cloud, and as those of a run are stored, for exports."""
    of = made.surface
    depth = np.full(len(of.xyz), np.nan) if flight.water is None else -heights_over(of.xyz, flight.water)
    columns = {
        "rgb": of.rgb, "std": of.std.astype(np.float32), "num_views": np.minimum(of.num_views, 255).astype(np.uint8),
        "depth": depth.astype(np.float32), "incidence": of.incidence.astype(np.float32), "wet": depth > 0.0,
    }  # fmt: skip
    bed, header, points = BedPoints(of.xyz, **columns), run.bed_header, flight.frame.crs_from_local(of.xyz)
    (output / FIELD_BED).mkdir(exist_ok=True)
    save_bed(output / FIELD_BED, StoredBed(bed, points, header.crs, header.name, made.report["pixel_m"]))
    write_cloud(
        output / FIELD_CLOUD, points, header.crs, rgb=bed.rgb, depth_m=bed.depth, std_m=bed.std,
        num_views=bed.num_views, incidence_deg=np.degrees(bed.incidence), is_wet=bed.wet,
    )  # fmt: skip


def _over_bed(made: FieldResult) -> dict[str, Any]:
    """Statistics of the heights [m] of the surface over the nearest points of the run's bed in plan."""
    _, nearest = cKDTree(made.bed[:, :2]).query(made.surface.xyz[:, :2])
    return asdict(distance_statistics(made.surface.xyz[:, 2] - made.bed[nearest, 2]))


def _held_out(made: FieldResult, folder: Path, *, right_half: bool) -> dict[str, dict[str, float]]:
    """PSNR [dB] over the pixels of the photographs held out that show the box, and SSIM over their largest rectangle.

    Their renderings go into the folder.
    """
    held = made.held
    found: dict[str, dict[str, float]] = {"held_out_psnr_db": {}, "held_out_ssim": {}}
    named = zip(held.names, held.cameras, strict=True)
    targets = [Target(name, camera, folder / Path(name).with_suffix("")) for name, camera in named]
    if not targets:
        return found
    views = {id(target.camera): view for target, view in zip(targets, made.held_views, strict=True)}
    write_views(targets, lambda camera: views[id(camera)])
    for number, target in enumerate(targets):
        shown = views[id(target.camera)].rgb / 255.0
        mask = np.zeros((target.camera.height, target.camera.width), dtype=bool)
        mask.flat[held.pixels[number]] = True
        if right_half:
            mask[:, : target.camera.width // 2] = False
        photograph = held.images[number] / 255.0
        if mask.any():
            for measure, value in image_quality(photograph, shown, mask=mask).items():
                found[f"held_out_{measure}"][target.name] = value
    return found


def rows_of(report: dict[str, Any], output: Path) -> list[tuple[str, str]]:
    """Summary of a report of `train_field` for the console: labels and values."""
    training, over = report["training"], report["over_the_bed_of_the_run_m"]
    rows = [
        ("model", f"{report['model']}, {training['parameters']:,} parameters, {training['steps']:,} steps"),
        *([("submodules", str(len(report["submodules"])))] if "submodules" in report else []),
        ("training", f"{report['photographs']} photographs, PSNR {training['psnr_db']:.1f} dB"),
    ]
    if report["held_out_psnr_db"]:
        held, alike = (list(report[key].values()) for key in ("held_out_psnr_db", "held_out_ssim"))
        means = f"PSNR {np.mean(held):.1f} dB" + (f", SSIM {np.mean(alike):.3f}" if alike else "")
        rows.append(("held out", f"{len(held)} photographs, {means} (mean)"))
    rows.append(("surface", f"{report['points']:,} points"))
    if report["points"]:
        inner = f"{length(over['mean_inner90_m'])} +- {length(over['std_inner90_m'])}"
        rows.append(("over the run's bed", f"{inner} (inner 90 %, mean and std)"))
    if "compared" in report:
        to = report["compared"]
        rows.append(("over the reference", f"{length(to['mean_inner90_m'])} +- {length(to['std_inner90_m'])}"))
    return [*rows, ("folder", str(output))]
