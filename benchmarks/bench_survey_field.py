"""What does the field bring to a survey, and how well does it predict photographs that were held out?

    python benchmarks/bench_survey_field.py SURVEY -o WORK [--quality draft] [--rows sweep field held held_field]
        [--reference F --visible F] [--steps] [--views N]

Rows: `sweep`, the cloud of `bathynerf process --field off`; `field`, the same with the field, whose run goes on from
that sweep; `held`, a survey without every eighth photograph, processed with the field, and what `bathynerf render`
makes of the cameras that were left out from the other photographs, over water pixels; `held_field`, the same from the
field; with --steps also over pixels within 5 px of a step of depth, away from steps, and of places that three
photographs see at most; with --views N, of N of them. One JSON for each row in WORK, and markers for commands that
have finished: the same command again does what is missing. SURVEY is only read. Reference and visible points default to
reference.ply and visible.ply of the survey.
"""

import argparse
import csv
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.ndimage import distance_transform_edt, map_coordinates, percentile_filter
from scipy.spatial import cKDTree
from study import tops

from evaluation import distance_statistics, distance_to_mesh, image_quality, is_reached, psnr
from evaluation.images import largest_rectangle
from geo import read_cloud, read_reference
from refract import FlatWater, PinholeCamera
from survey.folder.survey import Survey, load_survey
from survey.photos.cameras import View
from survey.photos.images import load_image, load_mask
from survey.plan.area import local_area, within
from survey.run.folder import RunDir
from survey.run.stored import load_bed
from survey.settings.config import read_config
from survey.simulate.shapes import TriangleMesh

# The images number 4, 12, 20, ... of the table are left out.
EVERY, FIRST = 8, 4
HELD = ("held", "held_field")
# A quality gate that failed leaves all outputs behind.
FINISHED = (0, 3)
BATHYNERF = [sys.executable, "-c", "from survey.commands.app import main; main()"]
# Neighbouring pixels whose points are further apart along the path than this many times their distance across it: a
# surface that rises by 79 degrees from the picture, or a step.
STEP = 5.0
REACH_PX = 5
FEW = 3
# A place is hidden from a photograph that sees something this much nearer [m]; its distances are known at every so many
# pixels.
HIDDEN_M, STRIDE = 0.05, 4
TOLERANCES_M = (0.05, 0.2)
# A point belongs to a mast if it rises this far above what covers a quarter of the disc of this diameter around it, in
# a raster of these cells: a deck beside the side of a hull does, and the top of a mast does not.
RISE_M, WIDE_M, CELL_M, COVERED = 0.5, 1.5, 0.1, 0.25
# Sightings are counted at one pixel in so many each way.
THINNED = 4


def true_points(
    camera: PinholeCamera, water: FlatWater | None, surface: TriangleMesh, stride: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Distances (rows, columns) [m] and points (rows, columns, 3) of one pixel in so many each way; NaN for none."""
    pixels = camera.pixel_centres()[stride // 2 :: stride, stride // 2 :: stride]
    flat = pixels.reshape(-1, 2)
    origin, direction = camera.centres(flat), camera.directions(flat)
    origin = np.broadcast_to(origin, direction.shape)
    before = np.full(len(flat), np.inf)
    if water is not None:
        paths = camera.paths(flat, water)
        before = np.where(paths.wet, paths.air_length, np.inf)
    distance, _ = surface.hit(origin, direction, before)
    points = origin + np.where(np.isfinite(distance), distance, np.nan)[:, None] * direction
    under = np.flatnonzero(~np.isfinite(distance) & np.isfinite(before))
    if under.size and water is not None:
        start, bent = paths.crossing[under], paths.water_direction[under]
        further, _ = surface.hit(start, bent, np.full(len(under), np.inf))
        points[under] = start + np.where(np.isfinite(further), further, np.nan)[:, None] * bent
        distance[under] = before[under] + further
    distance = np.where(np.isfinite(distance), distance, np.nan)
    return distance.reshape(pixels.shape[:2]), points.reshape(*pixels.shape[:2], 3)


def near_steps(distance: np.ndarray, focal_px: float, reach_px: int = REACH_PX) -> np.ndarray:
    """Which pixels (height, width) lie within ``reach_px`` of a step between neighbours."""
    step = np.zeros(distance.shape, dtype=bool)
    for before, after in (((slice(None), slice(-1)), (slice(None), slice(1, None))),
                          ((slice(-1), slice(None)), (slice(1, None), slice(None)))):  # fmt: skip
        near, far = distance[before], distance[after]
        jump = np.abs(far - near) > STEP * np.fmin(near, far) / focal_px
        step[before] |= jump
        step[after] |= jump
    return step if not step.any() else distance_transform_edt(~step) <= reach_px


def sightings(
    points: np.ndarray, cameras: Sequence[PinholeCamera], water: FlatWater | None, surface: TriangleMesh
) -> np.ndarray:
    """How many cameras see each of points (..., 3)."""
    flat, count = points.reshape(-1, 3), np.zeros(points[..., 0].size, dtype=int)
    known = np.flatnonzero(np.isfinite(flat).all(axis=1))
    for camera in cameras:
        pixels = camera.project(flat[known], water)
        inside = ((pixels > 0.0) & (pixels < (camera.width, camera.height))).all(axis=1)
        rows = known[inside]
        if not rows.size:
            continue
        seen, _ = true_points(camera, water, surface, STRIDE)
        at = (pixels[inside].T[::-1] - 0.5 - STRIDE // 2) / STRIDE
        found = map_coordinates(seen, at, order=1, mode="nearest")
        count[rows] += found > _distances(camera, water, flat[rows]) - HIDDEN_M
    return count.reshape(points.shape[:-1])


def _distances(camera: PinholeCamera, water: FlatWater | None, points: np.ndarray) -> np.ndarray:
    """Path lengths (N,) [m] from a camera to points (N, 3) [m] that it sees."""
    if water is None:
        return np.linalg.norm(points - camera.centre, axis=1)
    paths = camera.paths(camera.project(points, water), water)
    return np.where(
        paths.wet,
        paths.air_length + np.linalg.norm(points - paths.crossing, axis=1),
        np.linalg.norm(points - camera.centre, axis=1),
    )


def is_mast(points: np.ndarray) -> np.ndarray:
    """Which points (N, 3) [m] of a surface, local, belong to masts, yards and other narrow objects: (N,) bool."""
    top, row, column = tops(points, CELL_M)
    nearest = distance_transform_edt(np.isinf(top), return_distances=False, return_indices=True)
    across = np.arange(-int(WIDE_M / CELL_M / 2), int(WIDE_M / CELL_M / 2) + 1)
    disc = np.add.outer(across**2, across**2) <= (WIDE_M / CELL_M / 2) ** 2
    around = percentile_filter(top[tuple(nearest)], 100.0 * (1.0 - COVERED), footprint=disc)
    return points[:, 2] - around[row, column] > RISE_M


def cloud_figures(cloud: Path, reference: Path, visible: Path, survey: Survey) -> dict:
    """Completeness over what cameras see, and the distances of the cloud from the truth, with masts apart."""
    frame, area = survey.frame, local_area(survey)
    points = frame.local_from_crs(read_cloud(cloud).points)
    mesh, seen = read_reference(reference), frame.local_from_crs(read_reference(visible).points)
    mast = is_mast(seen)
    figures = {"points": len(points), "mast_share": float(mast.mean())}
    for tolerance in TOLERANCES_M:
        reached = is_reached(seen, points, tolerance_m=tolerance)
        for name, part in (("all", np.ones(len(seen), bool)), ("bed", ~mast), ("masts", mast)):
            figures[f"complete_{name}_{tolerance}"] = float(reached[part].mean()) if part.any() else None
    inside = points[within(points, area)] if area is not None else points
    distances = distance_to_mesh(inside, frame.local_from_crs(mesh.vertices), mesh.faces).signed
    of_mast = mast[cKDTree(seen).query(inside, workers=-1)[1]]
    for name, part in (("all", np.ones(len(inside), bool)), ("bed", ~of_mast), ("masts", of_mast)):
        numbers = distance_statistics(distances[part])
        figures |= {f"mean_{name}": numbers.mean_inner90_m, f"std_{name}": numbers.std_inner90_m}
    return figures


def water_pixels(survey: Survey, view: View, deepest_m: float) -> np.ndarray:
    """Pixels (height, width) whose path lies over the bounds of the survey from the surface down to the deepest bed.

    Independent of the rendering, so that pixels it leaves black count.
    """
    path = view.camera.paths(view.camera.pixel_centres(), survey.water)
    area = local_area(survey)
    held = np.ones(path.wet.shape, dtype=bool)
    for height in (0.0, -deepest_m):
        at = path.at_height(np.full(held.shape, height), survey.water)
        held &= within(at.reshape(-1, 3), area).reshape(held.shape)
    mask = load_mask(view)
    return held if mask is None else held & mask


def view_figures(survey: Survey, view: View, picture: Path, deepest_m: float) -> dict:
    """Image quality of one rendered view over its water pixels; what needs a rectangle only where there is one."""
    with Image.open(picture) as image:
        rendered = np.asarray(image)
    photograph, found = load_image(view) / 255.0, rendered[..., :3] / 255.0
    mask, seen = water_pixels(survey, view, deepest_m), rendered[..., 3] > 0
    if not (mask & seen).any():
        return {"image": view.name, "pixels": 0}
    figures = {"image": view.name, "pixels": int(mask.sum()), "unseen_share": float((mask & ~seen).sum() / mask.sum())}
    figures["psnr_seen_db"] = psnr(photograph, found, mask & seen)
    rows, columns = largest_rectangle(mask)
    figures["rectangle_px"] = [columns.stop - columns.start, rows.stop - rows.start]
    return figures | image_quality(photograph, found, mask=mask)


def with_steps(
    figures: list[dict], survey: Survey, kept: list[View], reference: Path, pictures: Path, deepest_m: float
) -> None:
    """Add the PSNR [dB] beside steps of depth, away from them, and where few of the kept photographs see a place.

    Sightings are counted at one pixel in `THINNED` each way.
    """
    mesh = read_reference(reference)
    surface = TriangleMesh(survey.frame.local_from_crs(mesh.vertices), mesh.faces)
    by_name, cameras, some = {view.name: view for view in survey.views}, [view.camera for view in kept], []
    for each in (f for f in figures if f["pixels"]):
        view = by_name[each["image"]]
        with Image.open((pictures / view.name).with_suffix(".png")) as image:
            found = np.asarray(image)[..., :3] / 255.0
        photograph, mask = load_image(view) / 255.0, water_pixels(survey, view, deepest_m)
        distance, points = true_points(view.camera, survey.water, surface)
        beside, known = near_steps(distance, view.camera.fx), mask & np.isfinite(distance)
        for name, part in (("steps", known & beside), ("away", known & ~beside)):
            _add(each, name, photograph, found, known, part)
        thin = (slice(None, None, THINNED), slice(None, None, THINNED))
        some.append((each, photograph[thin][known[thin]], found[thin][known[thin]], points[thin][known[thin]]))
    if not some:
        return
    # Distances from all cameras are found once for all views.
    count = sightings(np.concatenate([points for *_, points in some]), cameras, survey.water, surface)
    ends = np.cumsum([len(points) for *_, points in some])[:-1]
    for (each, photograph, found, _), seen in zip(some, np.split(count, ends), strict=True):
        _add(each, "few", photograph, found, np.ones(len(seen), dtype=bool), seen <= FEW)


def _add(
    figures: dict, name: str, photograph: np.ndarray, found: np.ndarray, known: np.ndarray, part: np.ndarray
) -> None:
    figures[f"{name}_share"] = float(part.sum() / max(known.sum(), 1))
    if part.any():
        # As a picture of one row.
        figures[f"psnr_{name}_db"] = psnr(photograph[part][None], found[part][None])


def summary(views: list[dict]) -> dict:
    """Means over images, and the PSNR [dB] of all water pixels together."""
    views = [v for v in views if v["pixels"] > 0]
    names = sorted({k for v in views for k in v} - {"image", "pixels", "rectangle_px"})
    means = {name: float(np.mean([v[name] for v in views if name in v])) for name in names}
    count = np.array([v["pixels"] for v in views])
    mse = np.array([10.0 ** (-0.1 * v["psnr_db"]) for v in views])
    return {"images": len(views), **means, "psnr_pooled_db": float(-10.0 * np.log10((count * mse).sum() / count.sum()))}


def once(marker: Path, arguments: list[str]) -> dict:
    """Run a command of bathynerf unless its marker shows it finished; returns the marker's seconds and load."""
    if not marker.exists():
        load, start = os.getloadavg()[0], time.monotonic()
        code = subprocess.run([*BATHYNERF, *arguments], check=False, stdout=subprocess.DEVNULL).returncode
        if code not in FINISHED:
            raise SystemExit(f"bathynerf {' '.join(arguments)} failed with exit code {code}; see its output above")
        record = {"wall_s": round(time.monotonic() - start, 1), "load_before": round(load, 1)}
        marker.write_text(json.dumps(record))
    return json.loads(marker.read_text())


def cloud_row(name: str, options: argparse.Namespace) -> dict:
    """The cloud with the field off or on, and how far it is from the truth."""
    run, cloud = options.output / "run", options.output / f"{name}.las"
    arguments = ["process", str(options.survey), "-o", str(run), "--quality", options.quality]
    record = once(
        options.output / f"{name}.process.json", [*arguments, "--field", "off" if name == "sweep" else "mdw", "-q"]
    )
    if not cloud.exists():
        shutil.copyfile(run / "cloud.las", cloud)
        shutil.copyfile(run / "report.json", options.output / f"{name}.report.json")
    stages = json.loads((options.output / f"{name}.report.json").read_text())["timings_s"]
    figures = cloud_figures(cloud, options.reference, options.visible, load_survey(options.survey))
    return {"row": name, **record, "stages_s": stages, **figures}


def held_survey(survey: Path, folder: Path) -> Path:
    """A survey folder without every eighth photograph, by links; the table of those that were left out."""
    config = read_config(survey / "survey.toml")
    table = survey / (config.cameras.poses or "")
    if table.suffix != ".csv":
        raise SystemExit(f"{survey} has its poses in {table}, expected a table (.csv), of which lines are left out")
    with table.open(encoding="utf-8", newline="") as stream:
        head, *lines = list(csv.reader(stream))
    held = lines[FIRST::EVERY]
    kept = [line for line in lines if line not in held]
    (folder / config.images.dir).mkdir(parents=True, exist_ok=True)
    shutil.copyfile(survey / "survey.toml", folder / "survey.toml")
    for line in kept:
        link = folder / config.images.dir / line[0]
        if not link.is_symlink():
            link.symlink_to((survey / config.images.dir / line[0]).resolve())
    for path, part in ((folder / config.cameras.poses, kept), (folder / "held.csv", held)):
        with path.open("w", encoding="utf-8", newline="") as stream:
            csv.writer(stream, lineterminator="\n").writerows([head, *part])
    return folder / "held.csv"


def some_of(held: Path, number: int | None) -> Path:
    """A table of as many of the views that were left out, evenly chosen."""
    head, *lines = held.read_text(encoding="utf-8").splitlines()
    if number is None or number >= len(lines):
        return held
    chosen = [lines[len(lines) * i // number] for i in range(number)]
    table = held.with_name(f"held_{number}.csv")
    table.write_text("\n".join([head, *chosen]) + "\n", encoding="utf-8")
    return table


def kept_views(survey: Survey, table: Path) -> list[View]:
    """The views of a survey that a table does not name: in its frame, which that of the others alone is not."""
    with table.open(encoding="utf-8", newline="") as stream:
        held = {line[0] for line in csv.reader(stream)}
    return [view for view in survey.views if view.name not in held]


def held_row(name: str, options: argparse.Namespace) -> dict:
    """Photographs that were left out, predicted from the others or from the field."""
    folder, views = options.output / "held", options.output / f"views of {name}"
    held, run = held_survey(options.survey, folder), folder / "bathynerf"
    table = some_of(held, options.views)
    arguments = ["process", str(folder), "--quality", options.quality, "--field", "mdw", "-q"]
    record = {"process": once(options.output / "held.process.json", arguments)}
    arguments = ["render", str(run), "--cameras", str(table), "-o", str(views), "-q"]
    arguments += ["--field"] if name == "held_field" else []
    record["render"] = once(options.output / f"{name}.render.json", arguments)
    survey, deepest = load_survey(options.survey), float(load_bed(RunDir(run).load_stage("bed")).bed.depth.max())
    rendered = [(view, (views / view.name).with_suffix(".png")) for view in survey.views]
    each = [view_figures(survey, view, path, deepest) for view, path in rendered if path.exists()]
    if options.steps:
        with_steps(each, survey, kept_views(survey, held), options.reference, views, deepest)
    return {"row": name, **record, **summary(each), "views": each}


def table(rows: list[dict]) -> str:
    """The rows as Markdown."""
    lines = []
    clouds = [r for r in rows if r["row"] not in HELD]
    if clouds:
        share = 100.0 * clouds[0]["mast_share"]
        lines += [
            f"Masts, with yards, rails and other narrow objects, are {share:.2f} % of what three cameras see.",
            "",
            "| row | seconds | of | complete at 0.05 m | at 0.2 m | mean, mm | std, mm |",
            "|---|---|---|---|---|---|---|",
        ]
    for r in clouds:
        for part in ("all", "bed", "masts"):
            shares = [r[f"complete_{part}_{t}"] for t in (0.05, 0.2)]
            said = ["" if v is None else f"{100.0 * v:.2f} %" for v in shares]
            lengths = [f"{1000.0 * r[f'{k}_{part}']:.1f}" for k in ("mean", "std")]
            lines.append(f"| {r['row']} | {r['wall_s']:.0f} | {part} | {' | '.join(said + lengths)} |")
    for r in (r for r in rows if r["row"] in HELD):
        found = {k: v for k, v in r.items() if isinstance(v, float)}
        lines += ["", f"{r['row']}: {r['images']} images.", "", "| measure | mean |", "|---|---|"]
        lines += [f"| {name} | {value:.4f} |" for name, value in sorted(found.items())]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("survey", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--quality", default="draft")
    parser.add_argument("--rows", nargs="+", default=["sweep", "field", *HELD], choices=["sweep", "field", *HELD])
    parser.add_argument("--steps", action="store_true")
    parser.add_argument("--views", type=int)
    for name in ("reference", "visible"):
        parser.add_argument(f"--{name}", type=Path)
    options = parser.parse_args()
    options.reference = options.reference or options.survey / "reference.ply"
    options.visible = options.visible or options.survey / "visible.ply"
    options.output.mkdir(parents=True, exist_ok=True)
    rows = []
    for name in options.rows:
        path = options.output / f"{name}.json"
        if not path.exists():
            row = held_row(name, options) if name in HELD else cloud_row(name, options)
            path.write_text(json.dumps(row, indent=2))
        rows.append(json.loads(path.read_text()))
    print(table(rows))  # noqa: T201


if __name__ == "__main__":
    main()
