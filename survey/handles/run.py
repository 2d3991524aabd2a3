"""A survey and its finished run as objects: checked, planned, processed; cloud, terrain models, products, profiles."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, cast

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from pyproj import CRS

from geo.features import Line
from geo.las import read_cloud, read_window
from geo.raster import open_raster, read_raster
from geo.shapes import Cloud, Mesh
from geo.vectors import Layer, geodataframe
from survey.compare.figures import Figures
from survey.compare.options import CompareOptions
from survey.display.blocks import picture_html, table_html
from survey.errors import SurveyError
from survey.export.export import cloud_of, export
from survey.export.loaded import LoadedRun
from survey.export.profiles import Bed, Profile, draw, figure_of
from survey.export.rasters import write_dem
from survey.export.registry import ExportOptions
from survey.export.vectors import LAYERS
from survey.files.json_values import read_json_object
from survey.files.remote import local_run
from survey.folder import survey as folder_survey
from survey.folder.found import Found, find_survey
from survey.plan.check import CheckSection, check_survey
from survey.plan.choices import Choices
from survey.run.folder import RunDir

# Names of the bands of the product, in order.
_BANDS = ("height", "std", "std_common", "num_points", "depth", "origin")
# Pictures of the report for notebooks; the first that exists is shown.
_PICTURES = ("depth.png", "orthophoto.png", "std.png")
# Places (K, 2) of a line in the CRS of the run: easting or longitude first.
Places = Sequence[Sequence[float]] | np.ndarray


@dataclass(frozen=True)
class Dem:
    """Terrain model: heights of the bed in square cells, the first row in the north; NaN where there is no point.

    ``numpy.asarray(dem)`` are its heights.
    """

    height: np.ndarray  # (rows, columns) float32, in the heights of crs
    # std, std_common (rows, columns) float32 [m]: Standard deviation of the height, random, and that which all
    # heights share
    std: np.ndarray
    std_common: np.ndarray
    num_points: np.ndarray  # (rows, columns) int
    depth: np.ndarray  # (rows, columns) float32 [m]: Below the water, negative above it; NaN for a dry survey
    east: np.ndarray  # east, north (columns,), (rows,), in crs: Centres of the cells
    north: np.ndarray
    crs: CRS  # Compound: with the vertical datum of the heights

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        """The heights."""
        return np.array(self.height, dtype=dtype, copy=copy)

    def to_xarray(self) -> Any:
        """An ``xarray.Dataset`` of all layers with units and long names, the CRS as rioxarray and CF have it.

        Raises SurveyError if xarray is not installed.
        """
        try:
            import xarray
        except ModuleNotFoundError as error:
            raise SurveyError("xarray is not installed: pip install 'bathynerf[xarray]'") from error
        layers = {
            name: (("y", "x"), getattr(self, name), {"long_name": about, "units": unit, "grid_mapping": "spatial_ref"})
            for name, about, unit in (
                ("height", f"height of the bed, {self.crs.name}", self.crs.axis_info[2].unit_name),
                ("std", "random standard deviation of the height", "metre"),
                ("std_common", "standard deviation that all heights share", "metre"),
                ("num_points", "points in the cell", "1"),
                ("depth", "depth of the bed below the water", "metre"),
            )
        }
        axes = {axis.get("axis"): axis for axis in self.crs.cs_to_cf()}
        coords = {"x": ("x", self.east, axes["X"]), "y": ("y", self.north, axes["Y"])}
        return xarray.Dataset(layers, coords=coords | {"spatial_ref": ((), 0, self.crs.to_cf())})


@contextmanager
def _dem_file(path: Path, options: ExportOptions) -> Iterator[tuple[Path, CRS]]:
    """The terrain model of a run folder in a temporary file, and its CRS."""
    with LoadedRun(path) as run, TemporaryDirectory(prefix="bathynerf-dem-") as folder:
        file = Path(folder) / "dem.tif"
        write_dem(file, run, options)
        yield file, run.crs_for(options.crs)


def dem_mesh(path: Path, options: ExportOptions) -> Mesh:
    """The terrain model of a run folder as triangles, in crs."""
    with _dem_file(path, options) as (file, _):
        return read_raster(file)


def dem_of(path: Path, options: ExportOptions) -> Dem:
    """The terrain model of a run folder, as ``export --dem`` makes it."""
    with _dem_file(path, options) as (file, crs), open_raster(file) as raster:
        layers = dict(zip(_BANDS, raster.read(masked=True).filled(np.nan), strict=True))
        transform, (rows, columns) = raster.transform, raster.shape
    return Dem(
        height=layers["height"],
        std=layers["std"],
        std_common=layers["std_common"],
        num_points=np.nan_to_num(layers["num_points"]).astype(np.int64),
        depth=layers["depth"],
        east=transform.c + transform.a * (np.arange(columns) + 0.5),
        north=transform.f + transform.e * (np.arange(rows) + 0.5),
        crs=crs,
    )


class Run:
    """A run folder that `process` wrote; files are read when they are first needed.

    Raises SurveyError if the folder is not a run, or not a finished one.

    Attributes
    ----------
    folder : Path
    """

    def __init__(self, folder: str | Path):
        self._run = RunDir(folder)
        self._run.require_run()
        self.folder = self._run.path
        self._beds: dict[Path | None, Bed] = {}

    @staticmethod
    def open(folder: str | Path) -> Run:
        """The run in a folder; errors as those of the class."""
        return Run(folder)

    def __repr__(self) -> str:
        return f"Run({str(self.folder)!r})"

    @cached_property
    def cloud(self) -> Cloud:
        """The points, in the CRS of the survey, with edits: ``cloud.points`` is an array (N, 3)."""
        return read_cloud(cloud_of(self.folder))

    def cloud_in(self, bounds: Sequence[float]) -> Cloud:
        """The points in bounds (E0, N0, E1, N1) in the CRS of the survey, with edits; the others are not read.

        From cloud.copc.laz in the run folder, which is written before the first use and after edits.
        """
        if len(bounds) != 4 or not (bounds[0] < bounds[2] and bounds[1] < bounds[3]):
            raise SurveyError(f"bounds are {list(bounds)}, expected E0 N0 E1 N1 with E0 < E1 and N0 < N1")
        return read_window(export(self.folder, copc=self.folder / "cloud.copc.laz")[0], bounds)

    def layer(self, name: str, options: ExportOptions | None = None) -> Any:
        """A ``geopandas.GeoDataFrame`` of footprints, shoreline, contours, unseen or checkpoints; GeoError without it.

        The first four are as ``export`` makes them by the options, check points have their residuals.
        """
        if name == "checkpoints":
            rows = (self.report.get("checkpoints") or {}).get("rows") or []
            columns = {column: [row[column] for row in rows] for column in (rows[0] if rows else ())}
            if rows and "easting" not in rows[0]:
                raise SurveyError(f"{self.folder} was made before runs kept the places of check points; process again")
            shapes = [(row["easting"], row["northing"]) for row in rows]
            with LoadedRun(self.folder) as run:
                return geodataframe(Layer(name, "Point", shapes, run.bed_header.crs, columns))
        if name not in LAYERS:
            raise SurveyError(f"there is no layer {name!r}, expected one of {', '.join(LAYERS)}, checkpoints")
        with LoadedRun(self.folder) as run:
            return geodataframe(LAYERS[name](run, options or ExportOptions()))

    @cached_property
    def report(self) -> dict[str, Any]:
        """The numbers of the report, as report.json has them (docs/formats.md)."""
        return read_json_object(self._run.report_json_path)

    @property
    def report_path(self) -> Path:
        """Path of report.html."""
        return self._run.report_html_path

    @property
    def passed(self) -> bool:
        """Whether the run passed its quality gates."""
        return bool(self.report.get("verdict", {}).get("passed"))

    def dem(self, resolution_m: float | None = None, *, fill_m: float = 0.0, crs: str | None = None) -> Dem:
        """The terrain model, as ``export --dem`` makes it.

        Parameters
        ----------
        resolution_m : [m], optional
            Side of a cell; default by the density of the points.
        fill_m : [m]
            Gaps up to this width are filled.
        crs : str, optional
            Of the model; default that of the survey.
        """
        return dem_of(self.folder, ExportOptions(resolution_m=resolution_m, fill_m=fill_m, crs=crs))

    def export(self, *, options: ExportOptions | None = None, **files: str | Path | None) -> list[Path]:
        """Write products, e.g. ``run.export(laz="bed.laz")``; see `survey.export.export.export`."""
        return export(self.folder, options=options or ExportOptions(), **files)

    def compare(self, reference: str | Path, options: CompareOptions | None = None) -> Figures:
        """Compare the cloud with a reference; see `survey.compare.comparison.compare_files`."""
        from survey.compare.comparison import compare_files

        return compare_files(cloud_of(self.folder), Path(reference), options=options or CompareOptions())

    def profile(
        self, line: Places, *, step_m: float | None = None, reference: str | Path | None = None, name: str = "profile"
    ) -> Profile:
        """Bed, water, standard deviations and a reference along a line.

        Raises SurveyError or GeoError if the line has no length, or the reference cannot be read or is of another
        place.

        Parameters
        ----------
        line : (K, 2), in the CRS of the run
            Corners, easting or longitude first.
        step_m : [m], optional
            Between places; default by the spacing of the points.
        reference : str or Path, optional
            Mesh, GeoTIFF or points.
        name : str
            Of the profile.
        """
        corners = np.asarray(line, dtype=np.float64)
        if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 2 or not np.isfinite(corners).all():
            raise SurveyError(
                f"a line is {str(line)[:60]}, expected two places or more as [easting, northing] in the CRS of the run"
            )
        return self._bed(None if reference is None else Path(reference)).along(Line(name, corners), step_m)

    def plot_profile(
        self,
        line: Places,
        *,
        step_m: float | None = None,
        reference: str | Path | None = None,
        name: str = "profile",
        axes: Axes | None = None,
    ) -> Figure:
        """Plot of `profile`, into axes or a new figure."""
        profile = self.profile(line, step_m=step_m, reference=reference, name=name)
        if axes is None:
            return figure_of([profile])
        draw(profile, axes)
        return cast("Figure", axes.get_figure(root=True))

    def _bed(self, reference: Path | None) -> Bed:
        """The bed beside a reference, read once."""
        if reference not in self._beds:
            self._beds[reference] = Bed(self.folder, reference)
        return self._beds[reference]

    def _repr_html_(self) -> str:
        """HTML for notebooks: the verdict in numbers, and a picture of the report."""
        report = self.report
        gates = [gate["sentence"] for gate in report.get("verdict", {}).get("gates", ())]
        rows = [
            ("run", self.folder),
            ("survey", report.get("survey", {}).get("name")),
            ("crs", report.get("survey", {}).get("crs", {}).get("name")),
            ("verdict", f"{'passed' if self.passed else 'not passed'}: {'; '.join(gates)}"),
        ]
        shown = [path for name in _PICTURES if (path := self._run.pictures_path / name).is_file()]
        return table_html(rows) + "".join(map(picture_html, shown[:1]))


class Survey:
    """A survey folder, its settings and image headers read and checked.

    >>> run = Survey.open("harbour").process(quality="standard")        # doctest: +SKIP

    Raises SurveyError or GeoError where something is missing, damaged or contradictory.

    Attributes
    ----------
    folder : Path
    found : Found
        What the folder holds.
    """

    def __init__(self, folder: str | Path):
        self.folder = Path(folder)
        self.found: Found = find_survey(self.folder)

    @staticmethod
    def open(folder: str | Path) -> Survey:
        """The survey in a folder; errors as those of the class."""
        return Survey(folder)

    @property
    def name(self) -> str:
        """Name by survey.toml, else that of the folder."""
        return self.found.name

    def __repr__(self) -> str:
        return f"Survey({str(self.folder)!r})"

    def check(self, **choices: Any) -> list[CheckSection]:
        """Check the survey: findings, assumptions, and the plan of `process`; keywords are those of `Choices`."""
        return check_survey(self.folder, chosen=Choices(**choices))

    def load(self) -> folder_survey.Survey:
        """Photographs, poses and water in the local frame; missing poses are computed, which takes long."""
        return folder_survey.load_survey(self.folder)

    def process(self, run: str | Path | None = None, **options: Any) -> Run:
        """Process the survey to a point cloud of the bed; stages that are finished are kept.

        Parameters
        ----------
        run : str or Path, optional
            Run folder; default ``bathynerf`` in the folder of the survey.
        options :
            Those of `survey.run.process.process`, e.g. ``quality="draft"``.

        Returns
        -------
        Run
            Where a quality gate failed too: `Run.passed` tells.
        """
        from survey.run.process import process

        process(self.folder, run, **options)
        return Run(local_run(self.folder, run))

    def run(self, run: str | Path | None = None) -> Run:
        """An existing run of the survey."""
        return Run(local_run(self.folder, run))

    def _repr_html_(self) -> str:
        """HTML for notebooks: contents of the folder."""
        poses = self.found.poses_path
        rows = [
            ("survey", self.name),
            ("folder", self.folder),
            ("crs", self.found.crs.name),
            ("photographs", len(self.found.images)),
            ("poses", "to be found from the photographs" if poses is None else poses.name),
            *(("warning", text) for text in self.found.findings.warnings),
        ]
        return table_html(rows)
