"""The report of a run over the small survey: a plane, compared with a reference 4 mm above it."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from small_bed import plane_bed, plane_height_map, write_plane_mesh
from small_survey import TOML, small_survey

from survey.compare.comparison import CompareOptions, compare_surfaces
from survey.folder.survey import Survey, load_survey
from survey.plan.plan import Decision, Plan
from survey.report import ReportFacts, write_report
from survey.report.facts import Gate, RunVerdict
from survey.run.folder import RunDir
from survey.run.products import write_bed_las
from survey.run.stored import StoredBed

RAISED_M = 0.004
# LAS rounds heights to 1 mm, evenly to both sides.
LAS_STD_M = 1e-3 / np.sqrt(12.0)
# Ten different fractions of a millimetre are rounded; a tenth of one stays.
LAS_BIAS_M = 1e-4
# The water touches a level surface 5 m from the origin; over 12 m that is (12 m)^2 / 6.4e6 m at most.
CURVATURE_M = 2.3e-5

MET = Gate("covered", 87.5, 50.0, "%", True, "87.5 % of the ground has a point, at least 50 % is asked")
MISSED = Gate("spread", 9.9, 5.0, "cm", False, "The median standard deviation is 9.9 cm; 5 cm are allowed.")

PLAN = Plan(
    quality="standard",
    device="llvm",
    image_scale=1.0,
    gsd_m=0.05,
    height_m=20.0,
    footprint_m=(12.8, 9.6),
    decisions=(Decision("refraction", "on", "water of index 1.3330 <here>"),),
)


def load_shallow_survey(folder: Path) -> Survey:
    """The small survey with bounds, under a name that HTML has to escape."""
    toml = TOML.replace('"small"', '"small & <shallow>"') + "[area]\nbounds = [589006, 5194730, 589019, 5194742]\n"
    return load_survey(small_survey(folder / "small", toml=toml))


def facts_of(survey, bed, **others) -> ReportFacts:
    """What a finished run over a survey hands to its report."""
    points_crs = survey.frame.crs_from_local(bed.xyz)
    timings, others = {"sweep": 61.2, "bed": 4.0}, {"versions": {"bathynerf": "0.1.0"}} | others
    return ReportFacts(survey, PLAN, {"quality": "standard"}, timings, bed, points_crs, **others)


def write_plane_report(survey: Survey, folder: Path) -> SimpleNamespace:
    """A finished report against a reference 4 mm above the bed, its run and its figures."""
    bed = plane_bed(survey)
    facts = facts_of(
        survey,
        bed,
        height_maps=[plane_height_map(survey, 1)],
        verdict=RunVerdict((MET,)),
        warnings=("a doubt of the plan",),
    )
    write_bed_las(folder / "cloud.las", StoredBed(bed, facts.points_crs, survey.frame.crs, "small", 0.05))
    reference = write_plane_mesh(folder / "reference.ply", survey, raised_m=RAISED_M)
    facts = replace(
        facts, comparison=compare_surfaces(folder / "cloud.las", reference, CompareOptions(bounds=survey.bounds))
    )
    steps = []
    with RunDir(folder / "run") as run:
        figures = write_report(run.path, facts, lambda: steps.append(1))
    return SimpleNamespace(run=run, facts=facts, figures=figures, num_steps=len(steps))
