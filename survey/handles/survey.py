"""A survey folder as an object: checked, planned, processed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from survey.display.blocks import table_html
from survey.files.remote import local_run
from survey.folder import survey as folder_survey
from survey.folder.found import Found, find_survey
from survey.handles.run import Run
from survey.plan.check import CheckSection, check_survey
from survey.plan.choices import Choices


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
