"""The folder of a drawn survey: survey.toml, cameras.csv, images, and beside them what is true, in truth/."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import shutil
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from survey.drawn.drawing import Drawing
from survey.drawn.scene import DrawnScene
from survey.drawn.sidecars import cameras_csv, exif_of_views, save_image, survey_toml
from survey.drawn.truth import ground_mesh, points_on, seen_by, write_ply
from survey.errors import SurveyError
from survey.progress import Progress, Stage

MARKER = "drawn.json"
# As many cameras have to see a point for it to count as visible.
_MIN_VIEWS = 3


def draw_survey(folder: Path, scene: DrawnScene, *, again: bool = False, progress: Progress | None = None) -> None:
    """Draw a survey into a folder, whole or not at all; the same scene gives the same bytes.

    Parameters
    ----------
    folder : Path
        Becomes a survey folder with ``truth/reference.ply`` (the true surface in the bounds, crs, double
        precision) and ``truth/visible.ply`` (points of it that at least three cameras see). Where the same
        survey was drawn before, nothing is done; another drawn survey is replaced, and what is not of it,
        such as a run folder, stays.
    again : bool
        Draw even if the same survey lies there.

    Raises
    ------
    SurveyError
        If the folder holds something that was not drawn here.
    """
    folder, mark = Path(folder), _mark(scene)
    marker = folder / MARKER
    if marker.is_file():
        if not again and marker.read_text(encoding="utf-8") == mark:
            return
    elif folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise SurveyError(
            f"{folder} is not empty and was not drawn here (no {MARKER} in it); give another folder or empty it"
        )
    folder.parent.mkdir(parents=True, exist_ok=True)
    work = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.parent))
    try:
        _write(work / "new", Drawing.of(scene), progress or Progress(verbosity=-1))
        (work / "new" / MARKER).write_text(mark, encoding="utf-8")
    except BaseException:
        shutil.rmtree(work, ignore_errors=True)
        raise
    # If this fails, what was in the folder still lies in the folder or beside it.
    _replace(folder, work)
    shutil.rmtree(work, ignore_errors=True)


def _mark(scene: DrawnScene) -> str:
    """The scene, and a hash of it and of the code that draws it, as the text of the marker."""
    settings = dataclasses.asdict(scene)
    code = hashlib.sha256(json.dumps(settings).encode())
    for path in sorted(Path(__file__).parent.glob("*.py")):
        code.update(path.read_bytes())
    return json.dumps({"scene": settings, "sha256": code.hexdigest()}, indent=1) + "\n"


def _replace(folder: Path, work: Path) -> None:
    """Put work/new in the place of `folder`, and what was in the folder but is not drawn back into it."""
    new, old = work / "new", work / "old"
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


def _write(folder: Path, drawing: Drawing, progress: Progress) -> None:
    for name in ("images", "truth"):
        (folder / name).mkdir(parents=True)
    (folder / "survey.toml").write_text(survey_toml(drawing), encoding="utf-8")
    (folder / "cameras.csv").write_text(cameras_csv(drawing), encoding="utf-8")
    count = len(drawing.cameras)
    # Positions first: PROJ's transformations are not for several threads.
    exifs = exif_of_views(drawing)
    with progress.stage("drawing the survey", 2 * count) as stage, ThreadPoolExecutor(_threads()) as pool:
        for name, exif, image in zip(drawing.names, exifs, pool.map(drawing.photograph, range(count)), strict=True):
            save_image(folder / "images" / name, image, exif)
            stage.advance()
        _write_truth(folder / "truth", drawing, pool, stage)


def _write_truth(folder: Path, drawing: Drawing, pool: ThreadPoolExecutor, stage: Stage) -> None:
    frame, ground = drawing.frame, drawing.renderer.ground
    e0, n0, e1, n1 = drawing.bounds

    def inside(points_crs: np.ndarray) -> np.ndarray:
        e, n = points_crs[..., 0], points_crs[..., 1]
        return (e >= e0) & (e <= e1) & (n >= n0) & (n <= n1)

    vertices, faces = ground_mesh(ground, inside(frame.crs_from_local(ground.bed.vertices())))
    write_ply(folder / "reference.ply", frame.crs_from_local(vertices), faces)
    points = points_on(vertices, faces, np.random.default_rng([drawing.scene.seed, 4]))
    points_crs = frame.crs_from_local(points)
    points, points_crs = points[inside(points_crs)], points_crs[inside(points_crs)]
    num_views = np.zeros(len(points), dtype=int)
    for seen in pool.map(lambda camera: seen_by(drawing.renderer, camera, points, drawing.water), drawing.cameras):
        num_views += seen
        stage.advance()
    write_ply(folder / "visible.ply", points_crs[num_views >= _MIN_VIEWS])


def _threads() -> int:
    """Each view takes about 0.2 GB while it is drawn."""
    return min(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1, 8)
