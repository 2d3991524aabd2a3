"""The folder of a simulated survey: survey.toml, cameras.csv and images, and the truth beside them in truth/.

All is written to a hidden folder beside the survey, and moved at the end; a run that was stopped continues with the
images that are there.
"""

import hashlib
import json
import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from PIL import Image

from evaluation import sample_mesh
from evaluation.c2m import area_vectors
from geo import write_ply
from refract import PinholeCamera
from refract.lens import Lens, distorted, normalised
from survey.errors import SurveyError
from survey.machine import num_cores
from survey.progress import Progress, Step
from survey.simulate import sidecars
from survey.simulate.direct import DirectRenderer, depth_below
from survey.simulate.ground import Ground

# Candidates for visible points per square metre of ground.
_POINTS_PER_M2 = 1000
# A point is seen if the ray through its pixel ends this close to it [m]: far more than the error of projection
# (1e-9 m, more along faces that are seen edge on), far less than the distance to anything in front of it.
_LEAST_FALL = 0.05
_SAME_POINT_M = 1e-4

MARKER = "simulated.json"
# Number of cameras that have to see a point for it to count as visible.
_MIN_VIEWS = 3
# Code that determines the photographs of a survey.
CODE = Path(__file__).parent


def ground_mesh(ground: Ground, inside: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) [m], local, and faces (F, 3) of the bed and of all bodies on it.

    A triangle with any vertex of the bed `inside` (V,) bool is kept, so that the area is covered up to its border.
    Bodies are kept whole, and so is the bed beneath them.
    """
    bed, faces, _ = ground.bed.mesh()
    faces = faces[inside[faces].any(axis=1)]
    used, faces = np.unique(faces, return_inverse=True)
    vertices, all_faces = [bed[used]], [faces.reshape(-1, 3)]
    count = len(used)
    for solid in ground.solids:
        vertices.append(solid.vertices)
        all_faces.append(solid.faces + count)
        count += len(solid.vertices)
    return np.concatenate(vertices), np.concatenate(all_faces)


def seen_by(renderer: DirectRenderer, camera: PinholeCamera, lens: Lens, points: np.ndarray) -> np.ndarray:
    """Whether a camera sees points (N, 3) [m], local: (N,) bool.

    `refract` only proposes the pixel; the ray that the renderer sends through it has to end at the point.
    """
    near = np.flatnonzero(_in_reach(camera, lens, points))
    pixels = np.full((len(points), 2), np.nan)
    pixels[near] = camera.project(points[near], renderer.water)
    near = near[np.isfinite(pixels[near]).all(axis=1)]
    on_image = distorted(lens, pixels[near])
    near = near[((on_image > 0.0) & (on_image < (lens.width, lens.height))).all(axis=1)]
    ends = renderer.trace(camera, pixels[near]).points
    seen = np.zeros(len(points), dtype=bool)
    # A ray that meets nothing ends at NaN, which is near nothing.
    seen[near] = np.linalg.norm(ends - points[near], axis=1) < _SAME_POINT_M
    return seen


def _in_reach(camera: PinholeCamera, lens: Lens, points: np.ndarray) -> np.ndarray:
    """Whether points (N, 3) lie in the rectangle that a camera can see of, from above: (N,) bool.

    Straight rays down to the lowest point reach further than those that water bends; a margin covers waves.
    """
    plane, _ = normalised(lens)
    (u0, v0), (u1, v1) = plane.min(axis=0), plane.max(axis=0)
    rays = np.array([(u, v, 1.0) for u in (u0, u1) for v in (v0, v1)]) @ camera.cam_from_local
    cos_nadir = -rays[:, 2] / np.linalg.norm(rays, axis=1)
    if not len(points) or cos_nadir.min() < _LEAST_FALL:
        return np.ones(len(points), dtype=bool)
    t = (camera.centre[2] - points[:, 2].min()) / -rays[:, 2]
    ends = np.concatenate([camera.centre[None, :2], camera.centre[:2] + t[:, None] * rays[:, :2]])
    low, high = ends.min(axis=0), ends.max(axis=0)
    margin = 0.1 * (high - low) + 0.5
    return ((points[:, :2] >= low - margin) & (points[:, :2] <= high + margin)).all(axis=1)


def depth_map(renderer: DirectRenderer, camera: PinholeCamera, lens: Lens) -> tuple[np.ndarray, np.ndarray]:
    """Vertical depth (height, width) float32 [m] of the bed at the middles of pixels, and 255 where rays enter water.

    Below the water surface, negative above it; without water, below the origin of local. NaN where a ray meets nothing.
    """
    plane, _ = normalised(lens)
    direction = np.concatenate([plane, np.ones((len(plane), 1))], axis=-1) @ camera.cam_from_local
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    origin = camera.centres(camera.pixel_centres().reshape(-1, 2))
    hits = renderer.trace_rays(np.broadcast_to(origin, direction.shape), direction)
    depth = depth_below(renderer.water, hits.points)
    shape = (lens.height, lens.width)
    wet = np.where(hits.in_water > 0.0, 255, 0).astype(np.uint8)
    return depth.astype(np.float32).reshape(shape), wet.reshape(shape)


def write_survey(
    folder: Path,
    settings: dict,
    stage_scene: Callable[[], sidecars.StagedScene],
    *,
    again: bool = False,
    progress: Progress | None = None,
) -> None:
    """Photograph a scene into a folder, whole or not at all; the same settings give the same bytes.

    It becomes a survey folder with ``truth/reference.ply`` (the true surface in the bounds, crs, double precision),
    ``truth/visible.ply`` (points of it that at least three cameras see), ``truth/depth/`` (TIFF [m], below the water of
    that photograph, of the middle of each pixel, NaN for none) and ``truth/wet/`` (PNG, white where the pixel looks
    into water). If the same survey exists, nothing is done, unless `again`; another simulated survey is replaced, and
    other files, such as a run folder, are kept. `settings` are all inputs of the scene, as values for JSON;
    `stage_scene` is called only if something is left to do.
    """
    folder = Path(folder)
    code = hashlib.sha256(json.dumps(settings).encode())
    for path in sorted(CODE.rglob("*.py")):
        code.update(path.read_bytes())
    mark = json.dumps({"scene": settings, "sha256": code.hexdigest()}, indent=1) + "\n"
    work = folder.absolute().parent / f".{folder.absolute().name}.part"
    _put_back(folder, work)
    marker, started = folder / MARKER, work / MARKER
    if marker.is_file():
        if not again and marker.read_text(encoding="utf-8") == mark:
            return
    elif folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise SurveyError(
            f"{folder} is not empty and was not simulated here (no {MARKER} in it); give another folder or empty it"
        )
    if again or not started.is_file() or started.read_text(encoding="utf-8") != mark:
        shutil.rmtree(work, ignore_errors=True)
        (work / "new").mkdir(parents=True)
        started.write_text(mark, encoding="utf-8")
    _write(work / "new", stage_scene(), progress or Progress(verbosity=-1))
    (work / "new" / MARKER).write_text(mark, encoding="utf-8")
    # If this fails, the earlier files are still in the folder or beside it.
    _replace(folder, work)
    shutil.rmtree(work, ignore_errors=True)


def _replace(folder: Path, work: Path) -> None:
    """Replace `folder` by work/new, and move files that were not simulated back into it."""
    new, old = work / "new", work / "old"
    if folder.exists():
        folder.rename(old)
    try:
        new.rename(folder)
    except OSError:
        if old.exists():
            old.rename(folder)
        raise
    _put_back(folder, work)


def _put_back(folder: Path, work: Path) -> None:
    """Move files out of work/old into `folder`: now, or after a run that was killed before it could."""
    old = work / "old"
    if old.exists() and not folder.exists():
        old.rename(folder)
    elif old.exists():
        for entry in list(old.iterdir()):
            if not (folder / entry.name).exists():
                entry.rename(folder / entry.name)
        # The rest are the simulated files that were replaced.
        shutil.rmtree(old)


def _write(folder: Path, scene: sidecars.StagedScene, progress: Progress) -> None:
    for name in ("images", "truth/depth", "truth/wet"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    texts = {
        "survey.toml": sidecars.survey_toml(scene),
        "cameras.csv": sidecars.cameras_csv(scene.names, scene.cameras, scene.frame),
    }
    for name, text in (texts | ({sidecars.GAUGE: sidecars.gauge_csv(scene)} if scene.duration_s > 0.0 else {})).items():
        (folder / name).write_text(text, encoding="utf-8")
    # Positions first: PROJ's transformations are not for several threads.
    exifs, xmps = sidecars.exif_of_views(scene), sidecars.xmp_of_views(scene)

    def take(index: int) -> None:
        path = folder / "images" / scene.names[index]
        if not path.exists():
            sidecars.write_image(path, scene.photograph(index), exifs[index], xmps[index])

    # Each view takes about 0.2 GB while it is evaluated; a custom renderer runs its own threads.
    count, threads = len(scene.cameras), min(num_cores(), 8)
    own = threads if scene.radiance_of is None else 1
    with progress.stage("Photographs", count) as step, ThreadPoolExecutor(own) as pool:
        for _ in pool.map(take, range(count)):
            step.advance()
    with progress.stage("Ground truth", count) as step, ThreadPoolExecutor(threads) as pool:
        _write_truth(folder / "truth", scene, pool, step)


def _write_truth(folder: Path, scene: sidecars.StagedScene, pool: ThreadPoolExecutor, step: Step) -> None:
    frame, ground = scene.frame, scene.renderer.ground
    e0, n0, e1, n1 = scene.bounds

    def inside(points_crs: np.ndarray) -> np.ndarray:
        e, n = points_crs[..., 0], points_crs[..., 1]
        return (e >= e0) & (e <= e1) & (n >= n0) & (n <= n1)

    vertices, faces = ground_mesh(ground, inside(frame.crs_from_local(ground.bed.mesh()[0])))
    write_ply(folder / "reference.ply", frame.crs_from_local(vertices), faces=faces)
    count = int(_POINTS_PER_M2 * np.linalg.norm(area_vectors(vertices, faces), axis=1).sum())
    points, _ = sample_mesh(vertices, faces, count, seed=scene.seed)
    points_crs = frame.crs_from_local(points)
    points, points_crs = points[inside(points_crs)], points_crs[inside(points_crs)]

    def visible_in(index: int) -> np.ndarray:
        (renderer, camera), stem = scene.at(index), Path(scene.names[index]).stem
        depth, wet = depth_map(renderer, camera, scene.lens)
        Image.fromarray(depth).save(folder / "depth" / f"{stem}.tif", compression="tiff_deflate")
        Image.fromarray(wet).save(folder / "wet" / f"{stem}.png")
        return seen_by(renderer, camera, scene.lens, points)

    num_views = np.zeros(len(points), dtype=int)
    for seen in pool.map(visible_in, range(len(scene.cameras))):
        num_views += seen
        step.advance()
    write_ply(folder / "visible.ply", points_crs[num_views >= _MIN_VIEWS])
