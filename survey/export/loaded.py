"""A finished run as products read it: each part when it is first needed, and once."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from survey.run.folder import RunDir

if TYPE_CHECKING:
    from survey.run.stored import StoredBed

# The stage whose folder holds the cloud.
BED_STAGE = "bed"


class LoadedRun:
    """The result that stands in a run folder.

    Attributes
    ----------
    folder : RunDir
    stages : dict of str to str
        Names of the stages of the result, and their folders; a folder's name ends in a hash of all that it depends on.

    Raises
    ------
    SurveyError
        If the folder is no run, or the run has not come as far as the cloud.
    """

    def __init__(self, path: str | Path):
        self.folder = RunDir(path)
        self.folder.require_run()
        self.folder.load_stage(BED_STAGE)
        self.stages: dict[str, str] = self.folder.result()["stages"]

    @cached_property
    def bed(self) -> StoredBed:
        """The cloud, in the CRS of the survey."""
        from survey.run.stored import load_bed

        return load_bed(self.folder.load_stage(BED_STAGE))

    def bed_in(self, crs: str | None) -> StoredBed:
        """The cloud with its coordinates in another CRS; see `geo.reproject.Reprojection`.

        Raises
        ------
        GeoError
            If the CRS is unusable, or a grid that the way to it needs is not there.
        """
        if crs is None:
            return self.bed
        from geo.reproject import Reprojection

        way = Reprojection.between(self.bed.crs, crs, where="--crs")
        return replace(self.bed, points_crs=way(self.bed.points_crs), crs=way.crs)
