"""The folder of a simulated survey: survey.toml, cameras.csv and images, and the truth beside them in truth/.

Images are written to a hidden folder beside the survey, which is renamed at the end; a run that was stopped
continues with the images that are there.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from PIL import Image

from geo import write_whole
from survey.errors import SurveyError
from survey.machine import num_cores
from survey.progress import Progress, Step
from survey.simulate.output.sidecars import (
    GAUGE,
    cameras_csv,
    exif_of_views,
    gauge_csv,
    survey_toml,
    write_image,
    xmp_of_views,
)
from survey.simulate.output.staged_scene import StagedScene
from survey.simulate.output.truth import depth_map, ground_mesh, points_on, seen_by, write_ply

MARKER = "simulated.json"
# As many cameras have to see a point for it to count as visible.
_MIN_VIEWS = 3
# Code that determines the photographs of a survey.
CODE = Path(__file__).parent.parent


def write_survey(
    folder: Path,
    settings: dict,
    stage_scene: Callable[[], StagedScene],
    *,
    again: bool = False,
    progress: Progress | None = None,
) -> None:
    """Photograph a scene into a folder, whole or not at all; the same settings give the same bytes.

    Parameters
    ----------
    folder : Path
        Becomes a survey folder with ``truth/reference.ply`` (the true surface in the bounds, crs, double
        precision), ``truth/visible.ply`` (points of it that at least three cameras see), ``truth/depth/`` (TIFF
        [m], below the water of that photograph, of the middle of each pixel, NaN for none) and ``truth/wet/`` (PNG,
        white where the pixel looks into water). If the same survey exists, nothing is done; another simulated survey is
        replaced, and other files, such as a run folder, are kept.
    settings : dict
        All inputs of the scene, as values for JSON.
    stage_scene : callable
        Makes the scene; called only if something is left to do.
    again : bool
        Start again even if the same survey, or a part of it, is there.

    Raises
    ------
    SurveyError
        If the folder holds something that was not simulated here.
    """
    folder, mark = Path(folder), _mark(settings)
    marker = folder / MARKER
    if marker.is_file():
        if not again and marker.read_text(encoding="utf-8") == mark:
            return
    elif folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise SurveyError(
            f"{folder} is not empty and was not simulated here (no {MARKER} in it); give another folder or empty it"
        )
    work = folder.absolute().parent / f".{folder.absolute().name}.part"
    started = work / MARKER
    if again or not started.is_file() or started.read_text(encoding="utf-8") != mark:
        shutil.rmtree(work, ignore_errors=True)
        (work / "new").mkdir(parents=True)
        started.write_text(mark, encoding="utf-8")
    _write(work / "new", stage_scene(), progress or Progress(verbosity=-1))
    (work / "new" / MARKER).write_text(mark, encoding="utf-8")
    # If this fails, the earlier files are still in the folder or beside it.
    _replace(folder, work)
    shutil.rmtree(work, ignore_errors=True)


def _mark(settings: dict) -> str:
    """The text of the marker: the inputs of the scene, and a hash of them and of the simulator's code."""
    code = hashlib.sha256(json.dumps(settings).encode())
    for path in sorted(CODE.rglob("*.py")):
        code.update(path.read_bytes())
    return json.dumps({"scene": settings, "sha256": code.hexdigest()}, indent=1) + "\n"


def _replace(folder: Path, work: Path) -> None:
    """Replace `folder` by work/new, and move files that were not simulated back into it."""
    new, old = work / "new", work / "old"
    # Left by an earlier try that was killed between the two names.
    if old.exists() and not folder.exists():
        old.rename(folder)
    if folder.exists():
        folder.rename(old)
    try:
        new.rename(folder)
    except OSError:
        if old.exists():
            old.rename(folder)
        raise
    if old.exists():
        for entry in old.iterdir():
            if not (folder / entry.name).exists():
                entry.rename(folder / entry.name)


def _write(folder: Path, scene: StagedScene, progress: Progress) -> None:
    for name in ("images", "truth/depth", "truth/wet"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    (folder / "survey.toml").write_text(survey_toml(scene), encoding="utf-8")
    (folder / "cameras.csv").write_text(cameras_csv(scene.names, scene.cameras, scene.frame), encoding="utf-8")
    if scene.duration_s > 0.0:
        (folder / GAUGE).write_text(gauge_csv(scene), encoding="utf-8")
    # Positions first: PROJ's transformations are not for several threads.
    exifs, xmps = exif_of_views(scene), xmp_of_views(scene)

    def take(index: int) -> None:
        path = folder / "images" / scene.names[index]
        if not path.exists():
            write_image(path, scene.photograph(index), exifs[index], xmps[index])

    count = len(scene.cameras)
    with progress.stage("photographing the scene", count) as step, ThreadPoolExecutor(_threads(scene)) as pool:
        for _ in pool.map(take, range(count)):
            step.advance()
    with progress.stage("writing the truth", count) as step, ThreadPoolExecutor(_threads()) as pool:
        _write_truth(folder / "truth", scene, pool, step)


def _write_truth(folder: Path, scene: StagedScene, pool: ThreadPoolExecutor, step: Step) -> None:
    frame, ground = scene.frame, scene.renderer.ground
    e0, n0, e1, n1 = scene.bounds

    def inside(points_crs: np.ndarray) -> np.ndarray:
        e, n = points_crs[..., 0], points_crs[..., 1]
        return (e >= e0) & (e <= e1) & (n >= n0) & (n <= n1)

    vertices, faces = ground_mesh(ground, inside(frame.crs_from_local(ground.bed.mesh()[0])))
    write_ply(folder / "reference.ply", frame.crs_from_local(vertices), faces)
    points = points_on(vertices, faces, np.random.default_rng([scene.seed, 4]))
    points_crs = frame.crs_from_local(points)
    points, points_crs = points[inside(points_crs)], points_crs[inside(points_crs)]

    def look(index: int) -> np.ndarray:
        (renderer, camera), stem = scene.at(index), Path(scene.names[index]).stem
        depth, wet = depth_map(renderer, camera, scene.lens)
        _write_picture(folder / "depth" / f"{stem}.tif", Image.fromarray(depth), compression="tiff_deflate")
        _write_picture(folder / "wet" / f"{stem}.png", Image.fromarray(wet))
        return seen_by(renderer, camera, scene.lens, points)

    num_views = np.zeros(len(points), dtype=int)
    for seen in pool.map(look, range(len(scene.cameras))):
        num_views += seen
        step.advance()
    write_ply(folder / "visible.ply", points_crs[num_views >= _MIN_VIEWS])


def _write_picture(path: Path, picture: Image.Image, **options) -> None:
    with write_whole(path) as stream:
        picture.save(stream, {".tif": "TIFF", ".png": "PNG"}[path.suffix], **options)


def _threads(scene: StagedScene | None = None) -> int:
    """Each view takes about 0.2 GB while it is evaluated; a custom renderer runs its own threads."""
    if scene is not None and scene.eye is not None:
        return 1
    return min(num_cores(), 8)
