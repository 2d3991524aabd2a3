"""The plan of a run with its tiles and what they take, as `check` prints it and `process` follows it."""

from __future__ import annotations

from dataclasses import dataclass, replace

from survey.folder.survey import Survey
from survey.plan.choices import Choices
from survey.plan.decisions import Decision
from survey.plan.plan import Plan, make_plan
from survey.plan.tile_choice import TileChoice, choose_tiles, with_free_cores
from survey.plan.tiling import tile_warnings
from survey.plan.workload import Workload, amounts_of_run, workload_of


@dataclass(frozen=True)
class RunPlan:
    """Plan of a run."""

    plan: Plan  # With the decisions on an aim and on tiles
    tiles: TileChoice
    workload: Workload
    warnings: tuple[str, ...]  # Where a plane or a local frame is not accurate enough for a tile

    def again(self, survey: Survey, chosen: Choices) -> Plan:
        """The plan for a survey of the same photographs, e.g. with adjusted water; tiles stay."""
        plan = make_plan(survey, chosen)
        kept = [each for each in self.plan.decisions if each.name in _OF_RUN]
        return replace(plan, decisions=(*plan.decisions, *kept))


# Decisions that follow from the photographs alone, or were made before the run.
_OF_RUN = ("aim", "tiles", "workers")


def plan_run(
    survey: Survey,
    chosen: Choices,
    *,
    aim: Decision | None = None,
    chooses_workers: bool = False,
    earlier_tiles: int | None = None,
) -> RunPlan:
    """Plan of a run on a survey whose poses are known.

    Parameters
    ----------
    aim : Decision, optional
        By which quality and image scale were chosen.
    chooses_workers : bool
        Choose the number of processes for tiles where no number is given.
    earlier_tiles : int, optional
        Number of tiles of an unfinished run that goes on.
    """
    plan = make_plan(survey, chosen)
    amounts = amounts_of_run(survey, plan)
    workload = workload_of(survey, plan, amounts)
    tiles = choose_tiles(survey, plan, chosen, workload, earlier=earlier_tiles, amounts=amounts)
    tiles = with_free_cores(tiles, chosen) if chooses_workers else tiles
    of_run = tiles.decisions if aim is None else (aim, *tiles.decisions)
    return RunPlan(
        replace(plan, decisions=(*plan.decisions, *of_run)),
        tiles,
        replace(workload, memory_bytes=int(tiles.memory_bytes)),
        tile_warnings(survey, plan, tiles.tiling),
    )
