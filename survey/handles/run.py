"""A finished run as an object: its cloud, its report, products, profiles and comparisons."""

from __future__ import annotations

import base64
import html
from collections.abc import Iterable, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from geo.las import read_cloud
from geo.lines import Line
from geo.shapes import Cloud
from survey.errors import SurveyError
from survey.export.product import ExportOptions
from survey.files.json_values import read_json_object
from survey.profile.profile import Bed, Profile
from survey.run.folder import RunDir

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from survey.compare.figures import Figures
    from survey.compare.options import CompareOptions
    from survey.handles.dem import Dem

# Of the report, the first that is there: for notebooks.
_PICTURES = ("depth.png", "orthophoto.png", "std.png")
# Places (K, 2) of a line in the CRS of the run: easting or longitude first.
Places = Sequence[Sequence[float]] | np.ndarray


class Run:
    """A run folder that `process` wrote; nothing is read before it is asked for.

    Attributes
    ----------
    folder : Path

    Raises
    ------
    SurveyError
        If the folder is no run, or not a finished one.
    """

    def __init__(self, folder: str | Path):
        self._run = RunDir(folder)
        self._run.require_run()
        self.folder = self._run.path

    @staticmethod
    def open(folder: str | Path) -> Run:
        """The run in a folder; errors as those of the class."""
        return Run(folder)

    def __repr__(self) -> str:
        return f"Run({str(self.folder)!r})"

    @cached_property
    def cloud(self) -> Cloud:
        """The points of the bed, in the CRS of the survey: ``cloud.points`` is an array (N, 3)."""
        return read_cloud(self._run.cloud_path)

    @cached_property
    def report(self) -> dict[str, Any]:
        """The numbers of the report, as report.json has them (docs/formats.md)."""
        return read_json_object(self._run.report_json_path)

    @property
    def report_path(self) -> Path:
        """The report as a page."""
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
        from survey.handles.dem import dem_of

        return dem_of(self.folder, ExportOptions(resolution_m=resolution_m, fill_m=fill_m, crs=crs))

    def export(self, *, options: ExportOptions | None = None, **files: str | Path | None) -> list[Path]:
        """Write products, e.g. ``run.export(laz="bed.laz")``; see `survey.export.export.export`."""
        from survey.export.export import export

        return export(self.folder, options=options or ExportOptions(), **files)

    def compare(self, reference: str | Path, options: CompareOptions | None = None) -> Figures:
        """Compare the cloud with a reference; see `survey.compare.comparison.compare_files`."""
        from survey.compare.comparison import compare_files
        from survey.compare.options import CompareOptions

        return compare_files(self._run.cloud_path, Path(reference), options=options or CompareOptions())

    def profile(
        self, line: Places, *, step_m: float | None = None, reference: str | Path | None = None, name: str = "profile"
    ) -> Profile:
        """Bed, water, standard deviations and a reference along a line.

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

        Raises
        ------
        SurveyError, GeoError
            If the line has no length, or the reference cannot be read or is of another place.
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
        """A picture of `profile`, into axes or a figure of its own."""
        from survey.profile.profiles import draw, figure_of

        profile = self.profile(line, step_m=step_m, reference=reference, name=name)
        if axes is None:
            return figure_of([profile])
        draw(profile, axes)
        return cast("Figure", axes.get_figure(root=True))

    def to_open3d(self) -> Any:
        """The cloud as ``open3d.geometry.PointCloud``, from its lowest corner on: Open3D draws in float32.

        Raises
        ------
        SurveyError
            If Open3D is not installed.
        """
        try:
            import open3d
        except ModuleNotFoundError as error:
            raise SurveyError("Open3D is not installed: pip install 'bathynerf[mesh]'") from error
        points = self.cloud.points
        shown = open3d.geometry.PointCloud()
        shown.points = open3d.utility.Vector3dVector(points - np.floor(points.min(axis=0)))
        if self.cloud.rgb is not None:
            shown.colors = open3d.utility.Vector3dVector(self.cloud.rgb / 255.0)
        return shown

    def _bed(self, reference: Path | None) -> Bed:
        beds = self.__dict__.setdefault("_beds", {})
        if reference not in beds:
            beds[reference] = Bed(self.folder, reference)
        return beds[reference]

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
        return table_html(rows) + self._picture_html()

    def _picture_html(self) -> str:
        for name in _PICTURES:
            path = self._run.pictures_path / name
            if path.is_file():
                data = base64.b64encode(path.read_bytes()).decode()
                return f'<img alt="{path.stem}" style="max-width: 40em" src="data:image/png;base64,{data}">'
        return ""


def table_html(rows: Iterable[tuple[str, object]]) -> str:
    """A table of labels and values."""
    lines = (
        f"<tr><th style='text-align: left'>{html.escape(label)}</th>"
        f"<td style='text-align: left'>{html.escape(str(value))}</td></tr>"
        for label, value in rows
    )
    return f"<table>{''.join(lines)}</table>"
