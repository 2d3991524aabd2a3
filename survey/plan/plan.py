"""The plan: what is done and what is skipped, with reasons; from geometry only."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

import numpy as np

from survey.display.quantities import length
from survey.errors import SurveyError
from survey.folder.survey import Survey
from survey.plan.area import Tiling, flattened
from survey.plan.choices import USUAL, Choices
from survey.plan.decisions import Decision, finer_passes, lens_terms, pixels, pose_choice, refraction
from survey.plan.heights import dry_ground, in_words
from survey.plan.recipe import RECIPES, Recipe, camera_height_m, gsd_m, image_decision, image_scale_of
from survey.water.surface import EARTH
from survey.water.tides import MOST_SHIFT_PX

# Decisions that follow from the photographs alone, or were made before the run.
OF_RUN = ("aim", "tiles", "workers")


@dataclass(frozen=True)
class Plan:
    """Plan of a run: what `process` does."""

    quality: str  # "draft", "standard" or "fine"
    device: str  # Where kernels run: Dr.Jit on CUDA, on the CPU by LLVM, or torch: "cuda", "llvm" or "torch"
    image_scale: float  # [-]: of the images in the run, at most 1
    # gsd_m, height_m, footprint_m [m], medians over the views: ground sampling distance at that size, height of the
    # cameras, width and height of what an image covers; at the water, or the ground of a dry survey
    gsd_m: float
    height_m: float
    footprint_m: tuple[float, float]
    decisions: tuple[Decision, ...]
    recipe: Recipe = RECIPES["standard"]  # The numbers of the quality
    field: str = "off"  # "off", "solver", or a model of `fields.models.IN_LAYER`, trained about the solver's heights
    boxes: bool = False  # Whether the bed beside and under depth steps is searched in boxes: `fields.occluded`
    device_asked: str = "auto"  # "auto", "cpu" or "cuda"
    # "refine", "fixed" or "check", and why: whether poses, lens and water are adjusted first, or only if a sample of
    # photographs contradicts the poses
    pose_choice: str = "fixed"
    pose_reason: str = ""
    tiling: Tiling | None = None  # Tiles of the ground; None for one piece
    workers: int = 1  # Processes that compute tiles; 1 for that of the run itself

    @property
    def solves(self) -> bool:
        """Whether heights are those of the solver."""
        return self.field != "off"

    def as_dict(self) -> dict:
        """Plain numbers, texts and lists, to be saved with the run."""
        values = asdict(replace(self, tiling=None))
        poses = values.pop("pose_choice"), values.pop("pose_reason")
        del values["tiling"], values["workers"]
        return {**values, "poses": poses}

    def again(self, survey: Survey, chosen: Choices) -> Plan:
        """The plan for a survey of the same photographs, e.g. with adjusted water; tiles stay."""
        kept = tuple(each for each in self.decisions if each.name in OF_RUN)
        made = make_plan(survey, chosen)
        return replace(made, decisions=(*made.decisions, *kept), tiling=self.tiling, workers=self.workers)


def make_plan(survey: Survey, chosen: Choices = USUAL) -> Plan:
    """Plan for a survey and the options of a run.

    Raises SurveyError if CUDA is asked for and there is none.
    """
    survey = flattened(survey)
    recipe, device = RECIPES[chosen.quality], device_decision(chosen.device)
    cameras = [view.camera for view in survey.views]
    height, scale = camera_height_m(survey), image_scale_of(survey, chosen)
    sides = np.median([(camera.width / camera.fx, camera.height / camera.fy) for camera in cameras], axis=0)
    poses = Decision("poses", *pose_choice(survey, chosen.poses, free_water=chosen.calibrate_water))
    field = _field(recipe, chosen)
    boxes = has_boxes(field.choice, chosen.field)
    decisions = (
        poses,
        refraction(survey),
        lens_terms(survey),
        pixels(survey),
        *_tide(survey),
        *_by_place(survey),
        field,
        finer_passes(field.choice),
        *((_BOXES,) if boxes else ()),
        image_decision(cameras[0], scale, chosen),
        *_ground(survey, height),
        Decision("range of heights", *in_words(survey, height)),
        Decision("first heights", "those of thumbnails", "a sweep of eight small photographs finds where the bed is"),
        device,
    )
    return Plan(
        chosen.quality,
        device.choice,
        scale,
        gsd_m(survey, chosen),
        height,
        (float(height * sides[0]), float(height * sides[1])),
        decisions,
        recipe,
        field=field.choice,
        boxes=boxes,
        device_asked=chosen.device,
        pose_choice=poses.choice,
        pose_reason=poses.reason,
    )


def _field(recipe: Recipe, chosen: Choices) -> Decision:
    if chosen.field == "boxes":
        return Decision("field", "solver", "set by --field boxes")
    if chosen.field != "auto":
        return Decision("field", chosen.field, "set by --field")
    reasons = {
        "off": f"{chosen.quality} uses the sweep's heights",
        "solver": "least squares over all photographs: less noise, and the standard deviation of each height",
    }
    return Decision("field", recipe.field, reasons[recipe.field])


def has_boxes(field: str, asked: str) -> bool:
    """Whether a run looks for the bed in boxes: after the solver, unless the field was set."""
    return field != "off" and asked != "solver"


# Photographs are compared pixel by pixel there.
_BOXES = Decision(
    "boxes",
    "beside depth steps with holes",
    "windows cover both an edge and the bed beside it, single pixels do not; a box of some metres takes about a "
    "second, and there are none where the cloud has no holes",
)


def device_decision(device: str) -> Decision:
    """Device of the kernels, with the reason."""
    # Starts Dr.Jit, which not every user of this module needs.
    from fields.device import choose_device

    try:
        chosen = choose_device(device)
    except ValueError as error:
        raise SurveyError(str(error)) from error
    return Decision("device", chosen.name, chosen.reason)


def _by_place(survey: Survey) -> tuple[Decision, ...]:
    """Decision to follow water that is not a plane; none for a plane."""
    departure = survey.observations.departure
    if departure is None:
        return ()
    under = np.array([view.camera.centre[:2] for view in survey.views])
    distance = length(float(np.abs(departure.at(under)[0]).max()))
    moved = "points of the bed are moved to it"
    if departure.source == EARTH:
        return (Decision(EARTH, "followed", f"still water lies up to {distance} below its tangent plane; {moved}"),)
    message = f"{departure.source} lies up to {distance} off one plane under the cameras"
    return (Decision("level", "by place", f"{message}; {moved}"),)


def _tide(survey: Survey) -> tuple[Decision, ...]:
    """Decision whether each photograph has its own level; none for a level that is constant."""
    tide = survey.observations.tide
    if tide is None:
        return ()
    water = survey.config.water
    if water is not None and water.rate.level_rate_std_m_per_h is not None and not survey.provenance.is_adjusted:
        known = f"{water.rate.level_rate_m_per_h:g} +- {water.rate.level_rate_std_m_per_h:g} m/h"
        return (Decision("level", "per photograph", f"its rate, known to {known}, is estimated with the poses"),)
    moves = f"{tide.source}, moves by {length(tide.moves_m)} over the flight, images by up to {tide.shift_px:.2g} px"
    if tide.matters:
        return (Decision("level", "per photograph", moves),)
    return (Decision("level", "one", f"{moves}: less than {MOST_SHIFT_PX:g}, below the noise of matching"),)


def _ground(survey: Survey, height_m: float) -> tuple[Decision, ...]:
    """Decision on the height of dry ground under the cameras."""
    if survey.water is not None:
        return ()
    ground = dry_ground(survey)
    advice = "; tie points, control points or [area] heights would give it" if ground.is_guess else ""
    return (Decision("height over ground", f"{height_m:.1f} m", f"by {ground.source}{advice}"),)
