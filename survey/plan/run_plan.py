"""The plan of a run with its tiles and what they take, as `check` prints it and `process` follows it."""

from __future__ import annotations

from dataclasses import replace

from survey.folder.survey import Survey
from survey.plan.choices import Choices
from survey.plan.decisions import Decision
from survey.plan.plan import Plan, make_plan
from survey.plan.tile_choice import choose_tiles
from survey.plan.tiling import tile_warnings
from survey.plan.workload import Workload, amounts_of_run, workload_of


def plan_run(
    survey: Survey,
    chosen: Choices,
    *,
    aim: Decision | None = None,
    chooses_workers: bool = False,
    earlier_tiles: int | None = None,
) -> tuple[Plan, Workload, tuple[str, ...]]:
    """Plan and workload of a run on a survey whose poses are known, and warnings where tiles are not accurate enough.

    ``aim`` is by which quality and image scale were chosen; ``chooses_workers`` whether a number of processes for tiles
    is chosen where none is given; ``earlier_tiles`` that of an unfinished run that goes on.
    """
    plan = make_plan(survey, chosen)
    amounts = amounts_of_run(survey, plan)
    workload = workload_of(survey, plan, amounts)
    tiles = choose_tiles(
        survey, plan, chosen, workload, amounts, earlier=earlier_tiles, chooses_workers=chooses_workers
    )
    decisions = (*plan.decisions, *(() if aim is None else (aim,)), *tiles.decisions)
    plan = replace(plan, decisions=decisions, tiling=tiles.tiling, workers=tiles.workers)
    return plan, replace(workload, memory_bytes=int(tiles.memory_bytes)), tile_warnings(survey, plan)
