"""Draw random surveys as they come from the field, with the truth beside them in truth/.

    python benchmarks/field_surveys.py FOLDER --seeds 1-8

FOLDER/01 and so on: photographs with GPS EXIF, survey.toml with the lens of a data sheet and a level read at a staff,
survey_plain.toml (the same without standard deviations and control), gcp_list.txt where there is a bank,
checkpoints.csv; truth/: cameras.csv, truth.toml, survey.toml (with the true lens and water), reference.ply and
visible.ply. A survey that is there is kept.
"""

import argparse
import shutil
import time
from pathlib import Path

import numpy as np
import tomli_w
from field_scenes import EVALUATED, FieldScene, stage
from field_settings import FieldSettings, as_table, draw_settings
from PIL import ExifTags, Image
from pyproj import Transformer

from evaluation import sample_mesh
from geo import write_ply
from geo.crs import horizontal_crs
from refract import FlatWater
from refract.lens import distorted
from survey.simulate.sidecars import cameras_csv, gps_exif
from survey.simulate.writing import ground_mesh, seen_by

MIN_VIEWS = 3
MARK_STD_PX, MARK_STD_M, ROD_STD_M = 0.4, 0.01, 0.01
NUM_RODS = 20
# Candidates for visible points.
MOST_POINTS = 150_000


def draw_field_survey(folder: Path, settings: FieldSettings) -> None:
    """Draw one survey into a folder, whole or not at all."""
    scene = stage(settings)
    work = folder.with_name(f".{folder.name}.part")
    shutil.rmtree(work, ignore_errors=True)
    (work / "images").mkdir(parents=True)
    (work / "truth").mkdir()
    rng = np.random.default_rng([settings.seed, 24])
    heard = _heard_positions(scene, rng)
    for index, name in enumerate(scene.names):
        _write_photograph(work / "images" / name, scene, index, heard[index])
    bed = _write_truth(work / "truth", scene)
    rods = _rods(scene, rng)
    (work / "checkpoints.csv").write_text(rods, encoding="utf-8")
    marks = _marks(scene, bed, rng) if scene.settings.dry_share > 0.0 else ""
    if marks:
        (work / "gcp_list.txt").write_text(marks, encoding="utf-8")
    _write_tomls(work, scene, controlled=bool(marks))
    work.rename(folder)


def _heard_positions(scene: FieldScene, rng: np.random.Generator) -> np.ndarray:
    """Longitude, latitude [deg] and height in crs (cameras, 3), as GPS has them."""
    settings = scene.settings
    centres = np.array([camera.centre for camera in scene.cameras])
    # Of an error that a flight has in common, the standard deviation of single positions shows little.
    common = any(settings.position_offset_m)
    std = (0.3, 0.3, 0.5) if common else settings.position_std_m
    shift = rng.normal(0.0, std, centres.shape) + settings.position_offset_m
    e, n, heights = scene.frame.crs_from_local(centres + shift).T
    lon, lat = Transformer.from_crs(horizontal_crs(scene.frame.crs), "EPSG:4326", always_xy=True).transform(e, n)
    return np.stack([lon, lat, heights], axis=-1)


def _write_photograph(path: Path, scene: FieldScene, index: int, position: np.ndarray) -> None:
    settings = scene.settings
    exif = Image.Exif()
    exif[ExifTags.Base.Make], exif[ExifTags.Base.Model] = "Synthetic", "field"
    film_mm = 36.0 * settings.stated_focal_px / max(settings.size_px)
    exif[ExifTags.IFD.Exif] = {ExifTags.Base.FocalLengthIn35mmFilm: round(film_mm)}
    exif[ExifTags.IFD.GPSInfo] = gps_exif(*(float(v) for v in position))
    Image.fromarray(scene.photograph(index)).save(
        path, "JPEG", quality=settings.jpeg_quality, subsampling=settings.jpeg_subsampling, exif=exif
    )


def _write_truth(folder: Path, scene: FieldScene) -> np.ndarray:
    """Write truth/ but its TOML; points (N, 3) of the flown ground, local, that three cameras see."""
    frame, ground = scene.frame, scene.still.ground
    (folder / "cameras.csv").write_text(cameras_csv(scene.names, scene.cameras, frame), encoding="utf-8")
    wide, deep = scene.settings.size_m
    grid = ground.bed.mesh()[0]
    near = (np.abs(grid[:, 0]) < 0.5 * wide + 1.0) & (np.abs(grid[:, 1]) < 0.5 * deep + 1.0)
    inside = np.zeros(len(grid), dtype=bool)
    inside[near] = _within(scene.flown, frame.crs_from_local(grid[near]))
    vertices, faces = ground_mesh(ground, inside)
    write_ply(folder / "reference.ply", frame.crs_from_local(vertices), faces=faces)
    points, _ = sample_mesh(vertices, faces, MOST_POINTS, seed=scene.settings.seed)
    points = points[_within(scene.flown, frame.crs_from_local(points))]
    num_views = sum(seen_by(scene.still, camera, scene.lens, points).astype(int) for camera in scene.cameras)
    points = points[num_views >= MIN_VIEWS]
    points_crs = frame.crs_from_local(points)
    # Completeness counts all of these, wherever the cloud is cropped.
    write_ply(folder / "visible.ply", points_crs[_within(scene.bounds, points_crs)])
    return points


def _within(area: tuple[float, float, float, float], points_crs: np.ndarray) -> np.ndarray:
    e0, n0, e1, n1 = area
    e, n = points_crs[:, 0], points_crs[:, 1]
    return (e >= e0) & (e <= e1) & (n >= n0) & (n <= n1)


def _rods(scene: FieldScene, rng: np.random.Generator) -> str:
    """checkpoints.csv: places under water at which the height of the bed was measured."""
    half, water = 0.48 * EVALUATED * np.array(scene.settings.size_m), scene.still.water
    places = rng.uniform(-half, half, (40 * NUM_RODS, 2))
    bed = scene.still.ground.bed.height(*places.T)
    wet = np.flatnonzero(bed < water.height(*places.T) - 0.1)[:NUM_RODS]
    heights = bed[wet] + ROD_STD_M * rng.standard_normal(len(wet))
    rows = scene.frame.crs_from_local(np.column_stack([places[wet], heights]))
    lines = [f"rod{k},{e:.3f},{n:.3f},{h:.3f}" for k, (e, n, h) in enumerate(rows, start=1)]
    return "\n".join(["name,easting,northing,height", *lines, ""])


def _marks(scene: FieldScene, seen: np.ndarray, rng: np.random.Generator) -> str:
    """gcp_list.txt: five to eight marks on the bank, far from each other; the first pixel's centre is at 0, 0."""
    water: FlatWater = scene.still.water
    dry = seen[seen[:, 2] > water.height(seen[:, 0], seen[:, 1]) + 0.1]
    if not len(dry):
        return ""
    chosen = [int(rng.integers(len(dry)))]
    for _ in range(int(rng.integers(5, 9)) - 1):
        away = np.min([np.hypot(*(dry - dry[k])[:, :2].T) for k in chosen], axis=0)
        chosen.append(int(np.argmax(away)))
    # A tape finds the middle of a mark to a centimetre.
    points = dry[chosen]
    known = scene.frame.crs_from_local(points + MARK_STD_M * rng.standard_normal(points.shape))
    lines = [scene.settings.crs.split("+")[0]]
    for camera, name in zip(scene.cameras, scene.names, strict=True):
        on_image = distorted(scene.lens, camera.project(points, water))
        on_image += MARK_STD_PX * rng.standard_normal(on_image.shape)
        inside = ((on_image > 1.0) & (on_image < np.array(scene.settings.size_px) - 1.0)).all(axis=1)
        for k in np.flatnonzero(seen_by(scene.still, camera, scene.lens, points) & inside):
            (e, n, h), (u, v) = known[k], on_image[k] - 0.5
            lines.append(f"{e:.4f} {n:.4f} {h:.4f} {u:.2f} {v:.2f} {name} gcp{k + 1}")
    return "\n".join([*lines[:1], *sorted(lines[1:], key=lambda line: line.split()[::-1]), ""])


def _write_tomls(folder: Path, scene: FieldScene, *, controlled: bool) -> None:
    settings = scene.settings
    width, height = settings.size_px
    cameras = {
        "model": "OPENCV",
        "distortion": [0.0, 0.0, 0.0, 0.0],
        "size_px": [width, height],
        "focal_px": settings.stated_focal_px,
        "principal_point_px": [0.5 * width, 0.5 * height],
    }
    water = {
        "level_m": settings.stated_level_m,
        "level_at": list(settings.origin),
        "slope_east": settings.slope_east,
        "slope_north": settings.slope_north,
        "refractive_index": settings.stated_index,
    }
    area = {"bounds": [round(v, 3) for v in scene.bounds]}
    local = {"origin": [*settings.origin, settings.level_m]}
    plain = {"name": folder.name.strip(".").removesuffix(".part"), "crs": settings.crs}
    _toml(folder / "survey_plain.toml", plain | {"cameras": cameras, "water": water, "area": area})
    known = {
        "cameras": cameras | {"position_std_m": list(settings.position_std_m)},
        "water": water | {"level_std_m": settings.level_std_m},
        "control": {"checkpoints": "checkpoints.csv"} | ({"gcps": "gcp_list.txt"} if controlled else {}),
    }
    _toml(folder / "survey.toml", plain | known | {"area": area})
    true_cameras = cameras | {
        "poses": "cameras.csv",
        "focal_px": settings.focal_px,
        "principal_point_px": list(settings.principal_px),
        "distortion": list(settings.distortion),
    }
    true_water = water | {"level_m": settings.level_m, "refractive_index": settings.index}
    tables = {"cameras": true_cameras, "water": true_water, "area": area}
    _toml(folder / "truth" / "survey.toml", plain | tables)
    true = {
        "level_m": settings.level_m,
        "level_at": list(settings.origin),
        "slope_east": settings.slope_east,
        "slope_north": settings.slope_north,
        "refractive_index": settings.index,
        "focal_px": settings.focal_px,
        "principal_point_px": list(settings.principal_px),
        "distortion": list(settings.distortion),
        "wave_amplitude_m": settings.wave_m,
    }
    _toml(folder / "truth" / "truth.toml", true | {"local": local, "settings": as_table(settings)})


def _toml(path: Path, table: dict) -> None:
    path.write_text(tomli_w.dumps(table), encoding="utf-8")


def _seeds(text: str) -> list[int]:
    """``1,4-6`` is 1, 4, 5, 6."""
    numbers = []
    for part in text.split(","):
        first, _, last = part.partition("-")
        numbers += range(int(first), int(last or first) + 1)
    return numbers


def main() -> None:
    """Draw the surveys that are not there."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", type=_seeds, default=_seeds("1-8"))
    options = parser.parse_args()
    for seed in options.seeds:
        folder = options.folder / f"{seed:02d}"
        if not folder.exists():
            start = time.monotonic()
            draw_field_survey(folder, draw_settings(seed))
            print(f"{folder} in {time.monotonic() - start:.0f} s")  # noqa: T201


if __name__ == "__main__":
    main()
