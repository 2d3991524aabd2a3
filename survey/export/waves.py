"""The surfaces of the water that the solver found, one raster for each photograph."""

from __future__ import annotations

import math
from pathlib import Path

from geo.files import reporting_disk_errors
from geo.raster import RasterBand, RasterForm, write_cog
from survey.errors import SurveyError
from survey.export.loaded import LoadedRun
from survey.export.product import ExportOptions
from survey.files.json_values import read_json_object
from survey.run.stage_solver import WAVES, load_surfaces
from survey.water.wave_surfaces import WaveSurfaces

_TAGS = {
    "HEIGHT": "of the surface of the water over its level at the moment of the photograph, which is a plane",
    "EXTENT": "where rays from the photograph to points of the bed cross the water",
}


def _surfaces(run: LoadedRun) -> WaveSurfaces:
    """The surfaces of a run; raises SurveyError where it has none."""
    why, what = f"the run {run.folder.path} has no surfaces of the water", "leave out --waves"
    if "solver" not in run.stages:
        raise SurveyError(f"{why}: it was made without the solver, which finds them; process with --quality standard")
    solver = run.folder.load_stage("solver")
    found = load_surfaces(solver, run.flight)
    if found is None:
        waves = read_json_object(solver / WAVES)
        if waves["sea"] is not None:
            raise SurveyError(f"{why} of whole photographs: it was solved in tiles, each with its own; {what}")
        moved = f"waves shift its photographs by {waves['moved_px']:.2f} px"
        raise SurveyError(f"{why}: it was taken as still ({moved}); {what}")
    return found


def check_waves(_path: Path, run: LoadedRun, _options: ExportOptions) -> None:
    """Raise SurveyError where the run has no surfaces."""
    _surfaces(run)


def write_waves(path: Path, run: LoadedRun, _options: ExportOptions) -> None:
    """The surface of each photograph that shows water."""
    band = RasterBand("height of the water over its level", "metre")
    for found in _surfaces(run).over(run.bed.bed.xyz):
        file, grid = path / f"{found.name}.tif", found.grid
        with reporting_disk_errors(file):
            file.parent.mkdir(parents=True, exist_ok=True)
        form = RasterForm(grid.crs, grid.transform, grid.shape, (band,), nodata=math.nan, tags=_TAGS)
        write_cog(file, form, [(0, 0, found.height[None])])
