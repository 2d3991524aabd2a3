"""`bathynerf process`: from a survey folder to a run folder, stage by stage.

    images -> sweep -> field -> bed -> cloud.las -> comparison -> report

Stages that take long leave their result in the run folder and are used again while what they depend on is the same.
"""

from __future__ import annotations

import json
import time
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from fields.colour.true_colour import true_colours
from fields.heads import WaterColumn
from survey.compare.comparison import CompareOptions, compare_surfaces
from survey.errors import SurveyError
from survey.folder.config import dump_config
from survey.folder.survey import Survey, load_survey
from survey.plan.block import backend, limits, load_block, plane_name
from survey.plan.plan import Plan, make_plan
from survey.progress import Progress, current
from survey.report import ReportFacts, write_report
from survey.run import stages
from survey.run.export import write_bed_las
from survey.run.folder import RunDir, stage_key, versions
from survey.run.stored import StoredBed, load_bed, load_depth_maps, save_bed, save_depth_maps
from survey.run.stored_field import load_field, save_field, save_place
from survey.run.water import calibrated
from survey.run.water_colour import colour_is_known, colour_of, require_water, save_colour, with_colour

QUALITY_GATE_FAILED = 3
# At which the report asks how complete the cloud is: that of the study which this work follows, and a finer one.
TOLERANCES_M = (0.2, 0.05)


def process(
    survey_folder: Path,
    run_folder: Path | None = None,
    *,
    quality: str = "standard",
    device: str = "auto",
    resume: bool = True,
    field: str = "auto",
    calibrate_water: bool = False,
    true_colour: bool = False,
    reference: Path | None = None,
    visible: Path | None = None,
) -> int:
    """Make the point cloud of the bed, with a report, in a run folder.

    Parameters
    ----------
    survey_folder : Path
    run_folder : Path, optional
        Default ``survey_folder/bathynerf``.
    quality : "draft", "standard" or "fine"
    device : "auto", "cpu" or "cuda"
    field : "auto", "on" or "off"
        Whether the tensor field refines the sweep; "auto" leaves it to the plan.
    resume : bool
        Use what an earlier run in this folder finished, where nothing that it depends on has changed.
    calibrate_water : bool
        First estimate level, slopes and index of the water from the photographs; what they cannot tell stays as given.
    true_colour : bool
        Give the points the bed's own colour, the water taken away, instead of the photographs'.
    reference, visible : Path, optional
        True surface and the points of it that cameras see, for the report; the reconstruction never reads them.

    Returns
    -------
    int
        0, or 3 where a quality gate failed; all outputs are written either way.

    Raises
    ------
    SurveyError, GeoError
        Where the input is at fault.
    """
    progress = current()
    run_folder = survey_folder / "bathynerf" if run_folder is None else run_folder
    for name, path in (("--reference", reference), ("--visible", visible)):
        if path is not None and not path.exists():
            raise SurveyError(f"{name} {path} does not exist; give the path of a PLY, OBJ, LAS or LAZ file")
    survey = load_survey(survey_folder, workspace=run_folder / "sfm", report=progress.note)
    if true_colour:
        require_water(survey)
    plan = make_plan(survey, quality=quality, device=device, field=field)
    with RunDir(run_folder) as run:
        progress.log_to(run.log_path)
        if calibrate_water and survey.water is not None:
            survey = calibrated(run, survey, device, progress, resume=resume)
            plan = make_plan(survey, quality=quality, device=device, field=field)
        _announce(progress, survey, plan)
        run.write_text(run.settings_path, dump_config(survey.config))
        run.write_text(run.plan_path, json.dumps(plan.as_dict(), indent=2))
        return _Run(run, survey, plan, progress, resume, true_colour).to_the_end(reference, visible)


def _announce(progress: Progress, survey: Survey, plan: Plan) -> None:
    progress.note(f"{survey.name}: {len(survey.views)} views")
    for text in survey.assumptions:
        progress.note(f"assumed: {text}")
    for text in survey.warnings:
        progress.warn(text)
    for decision in plan.decisions:
        progress.note(f"plan: {decision.name}: {decision.choice} ({decision.reason})")


class _Run:
    """One run of the pipeline: what its stages share."""

    def __init__(self, run: RunDir, survey: Survey, plan: Plan, progress: Progress, resume: bool, true_colour: bool):
        self.run, self.survey, self.plan, self.progress, self.resume = run, survey, plan, progress, resume
        self.true_colour = true_colour
        self.timings: dict[str, float] = {}
        self._block = None

    def to_the_end(self, reference: Path | None, visible: Path | None) -> int:
        """All stages in their order; the exit code."""
        key = stage_key(
            *(view.path for view in self.survey.views), self.survey.views, self.survey.water, self.survey.bounds,
            self.plan.image_scale, self.plan.quality, self.plan.device, limits(self.survey),
        )  # fmt: skip
        sweep_key, sweep_folder = key, self._stage("sweep", key, self._sweep)
        if self.true_colour and not colour_is_known(self.survey):
            folder = self._stage(
                "water_colour", stage_key(key, "water_colour"), lambda f: self._colour(f, sweep_folder)
            )
            self.survey = with_colour(self.survey, folder)
            self.progress.note(f"water colour: {self.survey.assumptions[-1]}")
        colour = colour_of(self.survey)
        field_folder = None
        if self.plan.is_on("field"):
            key = stage_key(key, "field", self.survey.frame, colour)
            field_folder = self._stage("field", key, lambda f: self._field(f, sweep_folder))
        key = stage_key(key, "bed", self.survey.frame, colour if self.true_colour else None)
        bed_folder = self._stage("bed", key, lambda f: self._bed(f, sweep_folder, field_folder))
        stored = load_bed(bed_folder)
        self._write_cloud(stored)
        comparison = self._compare(self.run.cloud_path, reference, visible)
        without_field = None
        if reference is not None and field_folder is not None:
            key = stage_key(sweep_key, "bed_of_sweep", self.survey.frame)
            folder = self._stage("bed_of_sweep", key, lambda f: self._bed_of_sweep(f, sweep_folder))
            without_field = self._compare(folder / "cloud.las", reference, visible)
        return self._report(stored, load_depth_maps(sweep_folder / "maps.npz"), comparison, without_field)

    @property
    def block(self):
        """The images, loaded when the first stage needs them."""
        if self._block is None:
            with self.progress.stage("Images", len(self.survey.views)) as stage:
                self._block = load_block(self.survey, self.plan, stage.advance)
        return self._block

    def _stage(self, name: str, key: str, compute) -> Path:
        """The folder of a stage: the one in the run where it is still right, else computed."""
        if self.resume and self.run.stage_is_current(name, key):
            self.progress.note(f"{name}: used again, nothing that it depends on has changed")
        else:
            folder = self.run.open_stage(name)
            compute(folder)
            self.run.finish_stage(name, key, folder)
        self.timings[name] = self.run.stage_seconds(name)
        return self.run.load_stage(name)

    def _sweep(self, folder: Path) -> None:
        with self.progress.stage("Sweep", 1.0) as stage:
            bound, maps = stages.sweep_block(self.block, self.survey, self.plan, stage)
        low, high = bound
        self.progress.note(f"bound: bed between {low:.2f} and {high:.2f} m over the {plane_name(self.survey)}")
        save_depth_maps(folder / "maps.npz", maps)

    def _colour(self, folder: Path, sweep_folder: Path) -> None:
        maps = load_depth_maps(sweep_folder / "maps.npz")
        with self.progress.stage("Water colour"):
            save_colour(folder, stages.sources_of(self.survey, self.plan, maps))

    def _field(self, folder: Path, sweep_folder: Path) -> None:
        maps = load_depth_maps(sweep_folder / "maps.npz")
        with self.progress.stage("Field", 1.0) as stage:
            field, figures = stages.train_field(self.survey, self.plan, maps, stage)
        self.progress.note(f"field: {figures['psnr_db']:.1f} dB after {figures['rays']:,} rays")
        save_field(folder, field, figures)
        save_place(folder, self.survey.frame, self.survey.water)

    def _bed(self, folder: Path, sweep_folder: Path, field_folder: Path | None) -> None:
        maps = load_depth_maps(sweep_folder / "maps.npz")
        field = None if field_folder is None else load_field(field_folder, backend(self.plan))
        with self.progress.stage("Bed", len(maps)) as stage:
            bed, moved = stages.bed_points(self.block, self.survey, self.plan, maps, field, stage.advance)
        if field is not None:
            self.progress.detail(f"{moved:,} of {len(bed):,} points have the field's height")
        if len(bed) == 0:
            raise SurveyError(
                "no point of the bed was confirmed by two views; check that poses, water level and images belong "
                "together (bathynerf check) and that the views overlap"
            )
        if self.true_colour:
            rgb, too_bright = true_colours(bed, self.survey.water, WaterColumn(*colour_of(self.survey)))
            bed = replace(bed, rgb=rgb)
            self.progress.detail(f"{100 * too_bright:.1f} % of the points are brighter than white without the water")
        points_crs = self.survey.frame.crs_from_local(bed.xyz)
        save_bed(folder, StoredBed(bed, points_crs, self.survey.frame.crs, self.survey.name, self.plan.gsd_m))

    def _bed_of_sweep(self, folder: Path, sweep_folder: Path) -> None:
        """What the cloud would be without the field: a baseline for the report."""
        self._bed(folder, sweep_folder, None)
        write_bed_las(folder / "cloud.las", load_bed(folder))

    def _write_cloud(self, stored: StoredBed) -> None:
        write_bed_las(self.run.cloud_path, stored)
        self.progress.note(f"{len(stored.bed):,} points in {self.run.cloud_path}")

    def _compare(self, cloud: Path, reference: Path | None, visible: Path | None):
        if reference is None:
            return None
        start = time.monotonic()
        options = CompareOptions(tolerances_m=TOLERANCES_M, visible=visible, bounds=self.survey.bounds)
        comparison = compare_surfaces(cloud, reference, options)
        self.timings["comparison"] = self.timings.get("comparison", 0.0) + time.monotonic() - start
        return comparison

    def _report(self, stored: StoredBed, maps, comparison, without_field) -> int:
        share = stages.share_of_wet_pixels(maps, self.survey)
        settings = {**asdict(self.survey.config), "quality": self.plan.quality, "device": self.plan.device}
        facts = ReportFacts(
            survey=self.survey,
            plan=self.plan,
            settings=settings,
            timings=self.timings,
            bed=stored.bed,
            points_crs=stored.points_crs,
            depth_maps=maps,
            wet_pixel_share=share,
            comparison=comparison,
            sweep_comparison=without_field,
            versions=versions(),
        )
        with self.progress.stage("Report"):
            write_report(self.run.path, facts)
        self.progress.note(f"report: {self.run.report_html_path}")
        return self._gate(share, stored)

    def _gate(self, share: float | None, stored: StoredBed) -> int:
        """The quality gate of the command line: 3 where the result should not be used unseen."""
        failed = []
        if share is not None and share < stages.MIN_WET_SHARE:
            failed.append(f"only {100 * share:.0f} % of the wet pixels have a point of the bed")
        std = float(np.nanmedian(stored.bed.std))
        if std > stages.MAX_STD_GSD * self.plan.gsd_m:
            failed.append(f"the median standard deviation is {100 * std:.1f} cm, over {stages.MAX_STD_GSD} GSD")
        for text in failed:
            self.progress.warn(f"quality gate: {text}; all outputs are written")
        return QUALITY_GATE_FAILED if failed else 0
