"""The verb simulate: a scene file becomes a survey folder, or the plan of its flight."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from geo import write_whole
from survey.errors import OutputError
from survey.files.outputs import ReadFiles, require_folder
from survey.progress import current
from survey.simulate.flight.coverage import Coverage, coverage
from survey.simulate.flight.picture import picture
from survey.simulate.output.sidecars import cameras_csv
from survey.simulate.output.writing import write_survey
from survey.simulate.scene_file import SceneSettings, read_scene
from survey.simulate.staging.build import stage_scene
from survey.simulate.staging.planning import Plan, files_of, marks_of, plan_scene

# What --flight-only writes.
_FLIGHT = ("cameras.csv", "flight.png")


def simulate(
    path: str | Path, output: str | Path, *, mode: str | None = None, preview: bool = False, again: bool = False
) -> None:
    """Photograph the scene of a file into a survey folder.

    Parameters
    ----------
    path : Path
        Scene file; names of files in it are relative to its folder.
    output : Path
        See `survey.simulate.output.writing.write_survey`.
    mode : "direct" or "physical", optional
        Instead of that of the scene file.
    preview : bool
        One ray per pixel, without care for noise.
    again : bool
        Start again even if the same survey, or a part of it, is there.

    Raises
    ------
    SurveyError, GeoError
        If the scene cannot be simulated, or the folder holds something else.
    """
    path, output = Path(path), Path(output)
    settings = _changed(read_scene(path), mode, preview)
    _require_output(output, path, settings)
    plan = plan_scene(settings, path.parent)
    _say_of(plan, coverage(plan.cameras, plan.site))
    marks = marks_of(settings, path.parent)
    write_survey(output, marks, lambda: stage_scene(plan), again=again, progress=current())


def simulate_flight(path: str | Path, output: str | Path) -> None:
    """Write the flight of a scene file: cameras.csv, and flight.png with what it sees of the bed."""
    path, output = Path(path), Path(output)
    settings = read_scene(path)
    _require_output(output, path, settings)
    _require_flight_or_empty(output)
    plan = plan_scene(settings, path.parent)
    cover = coverage(plan.cameras, plan.site)
    _say_of(plan, cover)
    output.mkdir(parents=True, exist_ok=True)
    names = [f"{k:04d}.jpg" for k in range(len(plan.cameras))]
    table, drawing = (output / name for name in _FLIGHT)
    with write_whole(table) as stream:
        stream.write(cameras_csv(names, plan.cameras, plan.frame).encode("utf-8"))
    with write_whole(drawing) as stream:
        stream.write(picture(plan.cameras, cover, plan.site))


def _require_output(output: Path, path: Path, settings: SceneSettings) -> None:
    named = (path.parent / name for name in files_of(settings))
    require_folder("-o", output, ReadFiles.of(path, *named))


def _require_flight_or_empty(output: Path) -> None:
    """Raise OutputError where a folder has other things than an earlier flight, e.g. the cameras.csv of a survey."""
    found = {entry.name for entry in output.iterdir() if entry.name[0] != "."} if output.is_dir() else set()
    if found and found != set(_FLIGHT):
        other = min(found - set(_FLIGHT), default=min(found))
        raise OutputError(
            f"-o names {output}, which has {other} and is not a flight of --flight-only; name a new or empty folder"
        )


def _changed(settings: SceneSettings, mode: str | None, preview: bool) -> SceneSettings:
    render = settings.render
    if mode is not None:
        render = dataclasses.replace(render, mode=mode)
    if preview:
        render = dataclasses.replace(render, samples=1)
    return dataclasses.replace(settings, render=render)


def _say_of(plan: Plan, cover: Coverage) -> None:
    """Report the figures of a flight, and what to improve."""
    heights = [float(camera.centre[2]) - plan.site.level for camera in plan.cameras]
    height, focal = sum(heights) / len(heights), plan.lens.focal[0]
    gsd_cm = 100.0 * (height + plan.site.apparent_depth) / focal
    progress = current()
    progress.note(
        f"{len(plan.cameras)} photographs from {height:.1f} m, {gsd_cm:.1f} cm per pixel on the bed, which "
        f"{cover.num_views.min()} to {cover.num_views.max()} of them see"
    )
    if cover.level_hidden_m is not None:
        progress.note(f"systematic errors of 0.1 px hide a water level {min(cover.level_hidden_m, 99.0):.2f} m off")
    for warning in cover.warnings:
        progress.warn(warning)
