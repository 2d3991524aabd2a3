"""The stages of a run, in their order."""

from __future__ import annotations

from dataclasses import replace

from survey.run.job import Job
from survey.run.stage import Stage
from survey.run.stage_adjust import FILES as ADJUSTMENT_FILES
from survey.run.stage_adjust import adjust_block, use_adjustment
from survey.run.stage_assess import REACHED, assess_round, use_assessment
from survey.run.stage_bed import FILES, make_bed
from survey.run.stage_field import train_field
from survey.run.stage_pose_check import MISFIT, check_poses, use_misfit
from survey.run.stage_solver import SIGHTINGS, SOLVED, solve_heights
from survey.run.stage_sweep import (
    BOUND,
    CELLS,
    EARLIER_ASSESSMENT,
    EARLIER_SOLVER,
    EARLIER_SWEEP,
    MAPS,
    SATURATED,
    SWEPT,
    sweep_views,
    use_sweep,
)
from survey.run.stage_water_colour import estimate_colour, use_colour
from survey.run.stored import FIELD_FILES
from survey.run.water_colour import COLOUR_FILE, colour_is_known


def _adjusts(job: Job) -> bool:
    return job.plan.poses[0] == "refine"


def _checks_poses(job: Job) -> bool:
    return job.plan.poses[0] == "check"


def _needs_colour(job: Job) -> bool:
    return job.chosen.true_colour and not colour_is_known(job.survey)


def _is_solved(job: Job) -> bool:
    return job.plan.field == "solver"


def _is_aimed(job: Job) -> bool:
    return job.aimed is not None


def _has_slab(job: Job) -> bool:
    return job.plan.field == "slab"


def _is_refined(job: Job) -> bool:
    return _is_solved(job) or _has_slab(job)


# What decides the rays of the photographs, and the size and the pixels that are worked on.
_RAYS = ("photographs", "cameras", "water", "device")
_VIEWS = (*_RAYS, "size", "skips")
# The stage that ends a round of a run with an aim.
ASSESSMENT = "reached"

STAGES = (
    Stage(
        name="pose_check",
        needs=(),
        depends_on=(*_VIEWS, "frame", "area", "heights"),
        files=(MISFIT,),
        compute=check_poses,
        is_on=_checks_poses,
        apply=use_misfit,
    ),
    Stage(
        name="adjust",
        needs=(),
        depends_on=(*_VIEWS, "frame", "water_settings", "area", "heights", "ties", "priors", "control", "freed"),
        files=ADJUSTMENT_FILES,
        compute=adjust_block,
        is_on=_adjusts,
        apply=use_adjustment,
    ),
    Stage(
        name="sweep",
        needs=(EARLIER_SWEEP, EARLIER_ASSESSMENT),
        depends_on=(*_VIEWS, "heights", "area", "coverage", "refined", "aim"),
        files=(MAPS, BOUND, SATURATED, SWEPT),
        compute=sweep_views,
        apply=use_sweep,
    ),
    Stage(
        name="solver",
        needs=("sweep", EARLIER_SWEEP, EARLIER_SOLVER),
        depends_on=(*_VIEWS, "gsd", "aim"),
        files=(SOLVED, SIGHTINGS),
        compute=solve_heights,
        is_on=_is_solved,
    ),
    Stage(
        name=ASSESSMENT,
        needs=("adjust", "sweep", "solver"),
        depends_on=(*_VIEWS, "area", "gsd", "aim"),
        files=(REACHED, CELLS),
        compute=assess_round,
        is_on=_is_aimed,
        apply=use_assessment,
    ),
    Stage(
        name="water_colour",
        needs=("sweep",),
        depends_on=_VIEWS,
        files=(COLOUR_FILE,),
        compute=estimate_colour,
        is_on=_needs_colour,
        apply=use_colour,
    ),
    Stage(
        name="field",
        needs=("sweep",),
        depends_on=(*_VIEWS, "area", "frame", "gsd", "rays", "water_colour"),
        files=FIELD_FILES,
        compute=train_field,
        is_on=_has_slab,
    ),
    Stage(
        name="bed",
        needs=("adjust", "sweep", "solver", "field"),
        depends_on=(*_VIEWS, "water_settings", "priors", "area", "frame", "name", "gsd", "true_colour", "boxes"),
        files=FILES,
        compute=make_bed,
    ),
)

# What the cloud would be of the sweep alone: a baseline for the report.
BED_OF_SWEEP = replace(STAGES[-1], name="bed_of_sweep", needs=("adjust", "sweep"), is_on=_is_refined)
