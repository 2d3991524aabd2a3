"""A trained radiance field as an object: its surface, figures and views."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Any

from geo.las import read_cloud
from geo.shapes import Cloud
from survey.display.blocks import picture_html, table_html
from survey.files.json_values import read_json_object
from survey.progress import opened
from survey.run.stored import FIELD_CLOUD, run_of
from survey.settings.tables import FieldConfig
from survey.volume.field import rows_of
from survey.volume.field import train_field as train
from survey.volume.options import volume_options
from survey.volume.scene import CURVE, REPORT
from survey.volume.submodules import render_field


def train_field(run: str | Path, output: str | Path, **options: Any) -> Field:
    """Train a radiance field on a run, or continue its training; keywords are those of `VolumeOptions`.

    >>> field = train_field("harbour/bathynerf", "mdw", model="mdw", steps=3000)        # doctest: +SKIP

    The output is a new folder, or one with the same training in it. A notebook shows the growing curve of the training.
    Raises SurveyError or GeoError as `bathynerf field` does.
    """
    with opened():
        train(run, output, volume_options(FieldConfig(), **options))
    return Field(output)


class Field:
    """A folder of `bathynerf field`; files are read when they are first needed.

    Raises SurveyError if the folder holds no trained field.

    Attributes
    ----------
    folder : Path
    run : Path
        Folder of the run that it was trained on.
    """

    def __init__(self, folder: str | Path):
        self.folder = Path(folder)
        self.run = run_of(self.folder)

    def __repr__(self) -> str:
        return f"Field({str(self.folder)!r})"

    @cached_property
    def surface(self) -> Cloud:
        """The points of its surface, in the CRS of the survey."""
        return read_cloud(self.folder / FIELD_CLOUD)

    @cached_property
    def report(self) -> dict[str, Any]:
        """All figures, as report.json has them; ``report["training"]["history"]`` is the curve of the training."""
        return read_json_object(self.folder / REPORT)

    def render(self, cameras: str | Path, output: str | Path, **options: Any) -> list[Path]:
        """Render views for other cameras, or a video along them; see `survey.volume.submodules.render_field`."""
        return render_field(self.folder, cameras, output, **options)

    def _repr_html_(self) -> str:
        """HTML for notebooks: the figures, and the curve of the training."""
        curve = self.folder / CURVE
        # Submodules have none: one is trained after the other.
        return table_html(rows_of(self.report, self.folder)) + (picture_html(curve) if curve.is_file() else "")
