"""The plan: what is done and what is skipped, with reasons; from geometry only."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace

import numpy as np

from refract import PinholeCamera
from survey.display.quantities import length
from survey.errors import SurveyError
from survey.folder.pose_priors import BY_FILE
from survey.folder.survey import Survey
from survey.plan.area import AREA_MARGIN_M, Tiling, flattened
from survey.plan.choices import RECIPES, USUAL, Choices, Recipe, gsd_m, image_scale_of
from survey.plan.heights import camera_height_m, dry_ground, height_range
from survey.water.surface import EARTH
from survey.water.tides import MOST_SHIFT_PX
from survey.words import Poses

# Pose errors that add less than this are negligible against the noise of matching, about a third of a pixel. Simulated
# surveys with exact poses have 0.001 to 0.08, with errors of 1 cm and 0.01 degrees 0.14 to 0.23 (docs/adjustment.md).
MOST_MISFIT_PX = 0.1
# The check of poses needs at least this many views.
_FEWEST_VIEWS = 12
_UNSTATED = "poses from a file without position_std_m count as exact"
# Decisions that follow from the photographs alone, or were made before the run.
OF_RUN = ("aim", "tiles", "workers")


@dataclass(frozen=True)
class Decision:
    """Decision of the plan: subject, choice and reason."""

    name: str
    choice: str
    reason: str


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
    heights, over = height_range(survey, height), "local origin" if survey.water is None else "water"
    poses = Decision("poses", *pose_choice(survey, chosen.poses, free_water=chosen.calibrate_water))
    field = _field(recipe, chosen)
    boxes = has_boxes(field.choice, chosen.field)
    decisions = (
        poses,
        _refraction(survey),
        _pixels(survey),
        *_tide(survey),
        *_by_place(survey),
        field,
        *((_BOXES,) if boxes else ()),
        _image_scale(cameras[0], scale, chosen),
        *_ground(survey, height),
        Decision("range of heights", f"{heights.low:.1f} to {heights.high:.1f} m over the {over}", heights.reason),
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
    if water is not None and water.level_rate_std_m_per_h is not None and not survey.provenance.is_adjusted:
        known = f"{water.level_rate_m_per_h:g} +- {water.level_rate_std_m_per_h:g} m/h"
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


def _refraction(survey: Survey) -> Decision:
    if survey.water is None:
        return Decision("refraction", "off", "a dry survey, without [water]")
    water, given = survey.require_water()
    if water.n_water == 1.0:
        return Decision("refraction", "off", "the index of the water is 1, as if it were air")
    slope = math.hypot(water.slope_x, water.slope_y)
    tilt = f", sloped by {slope:.4f}" if slope > 1e-6 else ""
    outlines = [view.camera.directions(view.camera.outline()) for view in survey.views]
    num_to_horizon = sum(bool((rays @ np.array(water.up) >= 0.0).any()) for rays in outlines)
    horizon = (
        f"; {num_to_horizon} of {len(survey.views)} views look past the water to the horizon" if num_to_horizon else ""
    )
    return Decision("refraction", "on", f"water of index {water.n_water:.4f} at {given.level_m:g} m{tilt}{horizon}")


def _pixels(survey: Survey) -> Decision:
    if survey.bounds is None:
        return Decision("pixels", "all", "there are no [area] bounds")
    return Decision(
        "pixels",
        "those that may see the area",
        f"the cloud ends {AREA_MARGIN_M:g} m beyond a box, true east and north, about [area] bounds",
    )


def _image_scale(camera: PinholeCamera, scale: float, chosen: Choices) -> Decision:
    size = f"images of {camera.width} x {camera.height} px"
    if chosen.image_scale is not None:
        by = "chosen for the aim" if chosen.has_aim else "set by --image-scale"
        return Decision("image scale", f"{scale:g}", f"{by}, for {size}")
    if scale == 1.0:
        return Decision("image scale", "1", f"{size} are worked on whole")
    limit = f"at most {RECIPES[chosen.quality].megapixels:g} Mpx for {chosen.quality} quality"
    return Decision("image scale", f"{scale:g}", f"{size} are halved until they have {limit}")


def require_placeable(reference: str | None, asked: str) -> None:
    """Raise SurveyError where an earlier survey is to place a block whose poses are to be kept."""
    if reference is not None and asked == Poses.fixed:
        raise SurveyError(
            f"[control] reference = {reference!r} places the block by an adjustment, and --poses fixed leaves it out; "
            "leave out --poses fixed, or reference"
        )


def pose_choice(survey: Survey, asked: str, *, free_water: bool) -> tuple[str, str]:
    """Choice ("refine", "fixed", or "check" first) and its reason, for the plan."""
    if survey.provenance.is_adjusted:
        return "refine", "adjusted with lens and water; see adjustment.json"
    if free_water and asked == Poses.fixed:
        raise SurveyError("--calibrate-water estimates the water together with the poses; leave out --poses fixed")
    if asked == Poses.fixed and not survey.provenance.is_level_known:
        raise SurveyError(
            "[water] has no level, and --poses fixed leaves out the adjustment that would estimate it; give level_m, "
            "or leave out --poses fixed"
        )
    require_placeable(survey.config.control.reference, asked)
    tool = survey.provenance.tool
    if asked != Poses.auto:
        is_straight = asked == Poses.fixed and tool is not None and survey.water is not None
        return asked, "set by --poses" + (f", though {tool} ignored refraction" if is_straight else "")
    reason = _reason_to_refine(survey, free_water=free_water)
    return _choice_by_check(survey) if reason is None else ("refine", reason)


def _reason_to_refine(survey: Survey, *, free_water: bool) -> str | None:
    """What a survey has, or asks to estimate, that takes an adjustment; None where a check is to decide."""
    given, cameras, water = survey.observations, survey.config.cameras, survey.config.water
    if given.ties is not None:
        return "structure from motion ignores refraction: poses, lens and water are adjusted with bent rays"
    if given.control is not None:
        return "there are control points to adjust to"
    if given.ground is not None:
        return "there is an earlier survey to place the block on"
    sources = {prior.source for prior in given.priors.values()}
    if "survey.toml" in sources:
        return "adjusted within the accuracy that survey.toml states for them"
    if cameras.rolling_shutter_std_s is not None:
        return "rolling_shutter_std_s asks to estimate the readout time of the shutter"
    if water is not None and water.level_rate_std_m_per_h is not None:
        return "level_rate_std_m_per_h asks to estimate the rate of the level"
    if BY_FILE in sources:
        return "adjusted within the accuracy that the poses file states for the positions"
    if free_water:
        return "--calibrate-water estimates the water together with poses and lens"
    tool = survey.provenance.tool
    if tool is not None and survey.water is not None:
        # Poses that were adjusted without refraction cannot be used to test the water.
        return f"{tool} ignored refraction: poses, lens and water are adjusted with bent rays"
    return None


def _choice_by_check(survey: Survey) -> tuple[str, str]:
    """Choice by the misfit between photographs under the given poses, and its reason."""
    provenance, num = survey.provenance, len(survey.views)
    if num < _FEWEST_VIEWS:
        return "fixed", f"{_UNSTATED}; a check needs at least {_FEWEST_VIEWS} views, and there are {num}"
    if provenance.pose_misfit_px is None:
        return "check", f"{_UNSTATED}, unless photographs contradict them"
    if provenance.pose_misfit_px < 0.0:
        return "fixed", f"{_UNSTATED}; too few matches to check them"
    message = f"reprojection misfit {provenance.pose_misfit_px:.2f} px with the given poses"
    if provenance.contradiction is not None:
        return "refine", f"{message}, and {provenance.contradiction}: water, poses and lens are adjusted"
    if provenance.pose_misfit_px > MOST_MISFIT_PX:
        return "refine", f"{message}, more than {MOST_MISFIT_PX:g}: poses, lens and water are adjusted"
    return "fixed", f"{message}, at most {MOST_MISFIT_PX:g}: they need no adjustment"
