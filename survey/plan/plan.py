"""The plan: what a scene needs, what is skipped, and the reason for each; from geometry only."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

import numpy as np

from refract import PinholeCamera
from survey.errors import SurveyError
from survey.folder.survey import Survey

QUALITIES = ("draft", "standard", "fine")
DEVICES = ("auto", "cpu", "cuda")

# Largest image that a quality works on [Mpx]; larger ones are halved until they fit.
_MEGAPIXELS = {"draft": 2.0, "standard": 6.0, "fine": 100.0}
# Overlap along the flight line that planners aim at; used only where nothing tells the height of dry ground.
_USUAL_OVERLAP = 0.75


@dataclass(frozen=True)
class Decision:
    """One line of the plan: what it is about, what was chosen, and why."""

    name: str
    choice: str
    reason: str


@dataclass(frozen=True)
class Plan:
    """What `process` is going to do.

    Attributes
    ----------
    quality : "draft", "standard" or "fine"
    device : "cuda", "llvm" or "torch"
        Where kernels run: Dr.Jit on CUDA, Dr.Jit on the CPU by LLVM, or torch on the CPU.
    image_scale : [-]
        At most 1: the size at which images are worked on.
    gsd_m : [m]
        Ground sampling distance at that size, median over the views: at the water, or the ground of a dry
        survey.
    height_m : [m]
        Height of the cameras over the water or ground, median.
    footprint_m : (width, height) [m]
        What one image covers there, median.
    decisions : tuple of Decision
    """

    quality: str
    device: str
    image_scale: float
    gsd_m: float
    height_m: float
    footprint_m: tuple[float, float]
    decisions: tuple[Decision, ...]

    def as_dict(self) -> dict:
        """Plain numbers, texts and lists, to be saved with the run."""
        return asdict(self)

    def is_on(self, name: str) -> bool:
        """Whether the decision of that name is to do it.

        Raises
        ------
        KeyError
            If there is none of that name.
        """
        return {decision.name: decision.choice != "off" for decision in self.decisions}[name]


def make_plan(survey: Survey, *, quality: str = "standard", device: str = "auto", field: str = "auto") -> Plan:
    """What the scene needs.

    Parameters
    ----------
    survey : Survey
    quality : "draft", "standard" or "fine"
    device : "auto", "cpu" or "cuda"
    field : "auto", "on" or "off"

    Raises
    ------
    SurveyError
        If CUDA is asked for and there is none, or a word is not known.
    """
    require_choice("quality", quality, QUALITIES)
    chosen = device_decision(device)
    cameras = [view.camera for view in survey.views]
    height = _height(survey)
    scale = min(image_scale(camera.width, camera.height, quality) for camera in cameras)
    gsd = float(np.median([_distance_along_axis(c, survey, height) / c.fx for c in cameras])) / scale
    sides = np.median([(camera.width / camera.fx, camera.height / camera.fy) for camera in cameras], axis=0)
    footprint = (float(height * sides[0]), float(height * sides[1]))
    decisions = (
        *_water_decisions(survey),
        Decision(
            "background shell",
            "off",
            "seen from above, the scene ends at its ground; rays past it are left out",
        ),
        _field(quality, field),
        Decision("tiles", "1", f"{len(cameras)} views are worked on together"),
        _image_decision(cameras[0], scale, quality),
        Decision(
            "ground sampling distance",
            f"{100.0 * gsd:.2g} cm",
            f"cameras {height:.1f} m over the {_over(survey)}",
        ),
        chosen,
    )
    return Plan(quality, chosen.choice, scale, gsd, height, footprint, decisions)


def _field(quality: str, field: str) -> Decision:
    require_choice("field", field, ("auto", "on", "off"))
    if field != "auto":
        return Decision("field", field, "asked for")
    if quality != "fine":
        return Decision(
            "field", "off", f"it takes some noise off at twice the time; {quality} takes the sweep's heights"
        )
    return Decision("field", "on", "trained inside the bound of the sweep, it takes some noise off the heights")


def require_choice(name: str, value: str, known: tuple[str, ...]) -> None:
    """Raise SurveyError where a word is not one of the known ones."""
    if value not in known:
        raise SurveyError(f"{name} is {value}, expected one of {', '.join(known)}")


def device_decision(device: str) -> Decision:
    """Where the kernels run.

    Raises
    ------
    SurveyError
        If CUDA is asked for and there is none.
    """
    # Starts Dr.Jit, which not every user of this module needs.
    from fields.device import choose_device

    require_choice("device", device, DEVICES)
    try:
        chosen = choose_device(device)
    except ValueError as error:
        raise SurveyError(str(error)) from error
    return Decision("device", chosen.name, chosen.reason)


def _water_decisions(survey: Survey) -> tuple[Decision, ...]:
    water = survey.water
    if water is None:
        dry = "a dry survey: there is no [water]"
        return (
            Decision("refraction", "off", dry),
            Decision("water column", "off", dry),
            Decision("shoreline", "off", dry),
        )
    slope = math.hypot(water.slope_x, water.slope_y)
    tilt = f", sloped by {slope:.4f}" if slope > 1e-6 else ""
    if water.n_water == 1.0:
        refraction = Decision("refraction", "off", "the index of the water is 1, as if it were air")
    else:
        refraction = Decision(
            "refraction",
            "on",
            f"water of index {water.n_water:.4f} at {survey.config.water.level_m:g} m{tilt}",
        )
    aside = [view.name for view in survey.views if _sees_beside_water(view.camera, survey)]
    if aside:
        look = "view looks" if len(aside) == 1 else "views look"
        shore = f"{len(aside)} {look} past the water to the horizon, and land may rise out of it"
    else:
        shore = "every ray meets the water plane; whether land rises out of it shows in the sweep"
    return (
        refraction,
        Decision("water column", "on", "light is absorbed and scattered on its way through water"),
        Decision("shoreline", "on", shore),
    )


def _sees_beside_water(camera: PinholeCamera, survey: Survey) -> bool:
    w, h = camera.width, camera.height
    corners = camera.directions(np.array([[0.0, 0.0], [w, 0.0], [w, h], [0.0, h]]))
    return bool((corners @ np.array(survey.water.up) >= 0.0).any())


def _image_decision(camera: PinholeCamera, scale: float, quality: str) -> Decision:
    size = f"images of {camera.width} x {camera.height} px"
    if scale == 1.0:
        return Decision("image scale", "1", f"{size} are worked on whole")
    limit = f"at most {_MEGAPIXELS[quality]:g} Mpx for {quality} quality"
    return Decision("image scale", f"{scale:g}", f"{size} are halved until they have {limit}")


def image_scale(width: int, height: int, quality: str) -> float:
    """The scale [-], at most 1, at which an image of a size [px] is worked on."""
    halvings = math.ceil(0.5 * math.log2(width * height / (1e6 * _MEGAPIXELS[quality])) - 1e-9)
    return 0.5 ** max(halvings, 0)


def _over(survey: Survey) -> str:
    return "water" if survey.water is not None else "ground, as far as the cameras tell"


def _height(survey: Survey) -> float:
    centres = np.array([view.camera.centre for view in survey.views])
    if survey.water is not None:
        return float(np.median(-survey.water.depth(centres)))
    return float(np.median(centres[:, 2]) - ground_height(survey))


def _distance_along_axis(camera: PinholeCamera, survey: Survey, height: float) -> float:
    """From the camera to water or ground, along its axis; at most three heights for views to the horizon."""
    own = height if survey.water is None else -float(survey.water.depth(camera.centre))
    falling = -camera.cam_from_local[2, 2]
    return own / max(falling, 1.0 / 3.0)


def ground_height(survey: Survey) -> float:
    """Rough height [m], local, of the ground of a dry survey, from its cameras alone.

    Where the axes of oblique views converge, the median height at which pairs of them pass each other; else
    the ground at which neighbours overlap as usual.
    """
    cameras = [view.camera for view in survey.views]
    centres = np.array([camera.centre for camera in cameras])
    axes = np.array([camera.cam_from_local[2] for camera in cameras])
    i, j = np.triu_indices(len(cameras), 1)
    cos = np.sum(axes[i] * axes[j], axis=1)
    convergent = cos < math.cos(math.radians(15.0))
    if convergent.sum() >= 10:
        i, j, cos = i[convergent], j[convergent], cos[convergent]
        between = centres[j] - centres[i]
        along_i, along_j = np.sum(between * axes[i], axis=1), np.sum(between * axes[j], axis=1)
        t = (along_i - cos * along_j) / (1.0 - cos**2)
        met = (centres[i] + t[:, None] * axes[i])[t > 0.0, 2]
        if met.size >= 10:
            return float(np.median(met))
    apart = np.linalg.norm(centres[:, None, :2] - centres[None, :, :2], axis=-1)
    np.fill_diagonal(apart, np.inf)
    base = float(np.median(apart.min(axis=1)))
    camera = cameras[0]
    seen = min(camera.width / camera.fx, camera.height / camera.fy)
    return float(np.median(centres[:, 2]) - base / ((1.0 - _USUAL_OVERLAP) * seen))
