"""`bathynerf check` before the flight: predicted accuracy of a planned flight over the bed of a scene file."""

import math
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np

from geo.sun import sun_at
from survey.adjust.result.foreseen import foreseen_section
from survey.display.quantities import length
from survey.errors import FILE_NAME, SurveyError
from survey.folder.heights import place_of
from survey.folder.observations import Observations
from survey.folder.pose_priors import PosePrior
from survey.folder.survey import Survey
from survey.photos.cameras import View
from survey.photos.poses import TiePoints
from survey.plan.area import ASSUMED_DEPTH_M, in_the_middle
from survey.plan.check import CheckSection, Verdict, verdict_by_limits, verdict_text
from survey.plan.choices import USUAL, Choices, gsd_m
from survey.plan.light import LOST_GOOD, GlitterOfFlight, glitter_text, lost_share, motion_text, sun_text
from survey.plan.plan import make_plan
from survey.plan.workload import room_warnings, workload_of
from survey.progress import rough
from survey.settings.config import AreaConfig, SurveyConfig
from survey.simulate.flight import NADIR_DEG, views_of_bed
from survey.simulate.scene_file import read_scene
from survey.simulate.simulate import ScenePlan, plan_scene, sun_of

# Shares of the area seen by fewer than three photographs, up to which coverage is good, and fair.
_UNSEEN = 0.0, 0.05
# The day is sampled in these steps, while the sun is high enough to light the bed.
_STEP_MIN, _LOWEST_SUN_DEG = 15, 15.0
_NO_TIME = 'unknown: give [light] time, e.g. time = "2026-07-14T09:30+02:00"'


def check_plan(path: Path, *, chosen: Choices = USUAL, wind_m_s: float) -> list[CheckSection]:
    """Pre-analysis of a planned flight, for the choices of a run; nothing is written.

    Of the scene file (docs/simulation.md) place, water, depth, camera, flight, light and shutter count. The wind is for
    sun glitter.
    """
    plan = flight_of(path)
    survey = survey_of(plan)
    foreseen, of_run = foreseen_section(survey, depth_m=depth_of(plan), chosen=chosen), make_plan(survey, chosen)
    shown = [d for d in of_run.decisions if d.name in ("field", "image scale", "device")]
    decisions, work = [(d.name, f"{d.choice}: {d.reason}") for d in shown], workload_of(survey, of_run)
    warnings = room_warnings(work, survey.folder)
    workload = verdict_text(Verdict.poor if warnings else Verdict.good, str(work), "; ".join(warnings))
    sections = [
        CheckSection("Flight", tuple(_flight_rows(plan, survey))),
        CheckSection("Light and motion", tuple(_light_rows(plan, survey, wind_m_s))),
        CheckSection("Processing", (*decisions, ("workload", workload))),
    ]
    return sections if foreseen is None else [*sections[:1], foreseen, *sections[1:]]


def flight_of(path: Path) -> ScenePlan:
    """The planned flight of a scene file."""
    if path.name == FILE_NAME:
        raise SurveyError(f"{path} has the settings of a survey, expected its folder; give {path.resolve().parent}")
    return plan_scene(read_scene(path), path.parent)


def depth_of(plan: ScenePlan) -> float:
    """Depth of the bed under the water for which the accuracy is predicted [m]."""
    return plan.site.depth_m or ASSUMED_DEPTH_M


def survey_of(plan: ScenePlan) -> Survey:
    """A planned flight as a survey without photographs: GPS, the lens of its data sheet, no tie points."""
    settings, frame = plan.settings, plan.frame
    half = 0.5 * np.array(settings.area.size_m)
    corners = frame.crs_from_local([[x, y, 0.0] for x in (-half[0], half[0]) for y in (-half[1], half[1])])
    (e0, n0), (e1, n1) = corners[:, :2].min(axis=0).tolist(), corners[:, :2].max(axis=0).tolist()
    area = AreaConfig(bounds=(e0, n0, e1, n1))
    none, std = np.empty(0, dtype=np.int64), np.full(3, settings.flight.position_std_m)
    cameras = {f"{number:04d}.jpg": camera for number, camera in enumerate(plan.cameras)}
    return Survey(
        name=settings.name,
        folder=plan.folder,
        frame=frame,
        views=tuple(View(name, Path(name), camera, plan.lens) for name, camera in cameras.items()),
        water=plan.site.water,
        config=SurveyConfig(name=settings.name, crs=settings.crs, water=plan.level, area=area),
        observations=Observations(
            ties=TiePoints(np.empty((0, 3)), none, none, np.empty((0, 2))),
            priors={name: PosePrior(camera.centre, std, None, "the plan") for name, camera in cameras.items()},
        ),
    )


def _flight_rows(plan: ScenePlan, survey: Survey) -> list[tuple[str, str]]:
    lens, site, cameras = plan.lens, plan.site, plan.cameras
    centres = np.array([camera.centre for camera in cameras])
    height = float(np.median(centres[:, 2])) - site.level
    tilted = [math.degrees(math.acos(min(-float(camera.cam_from_local[2, 2]), 1.0))) for camera in cameras]
    down = sum(tilt <= NADIR_DEG for tilt in tilted)
    path = float(np.linalg.norm(np.diff(centres, axis=0), axis=1).sum())
    speed = plan.settings.flight.speed_m_s
    duration = "" if speed is None else f", {rough(path / speed)} at {speed:g} m/s without the turns"
    over = "the water" if site.water is not None else "the ground"
    wide, deep = plan.settings.area.size_m
    unseen = float((views_of_bed(cameras, site) < 3).mean())
    return [
        ("area", f"{wide:g} x {deep:g} m, the bed {site.depth_m:g} m deep, in {survey.frame.crs.name}"),
        ("camera", f"{lens.model}, {lens.width} x {lens.height} px, focal length {lens.focal[0]:.1f} px"),
        ("photographs", f"{len(cameras)} from {height:.1f} m over {over}: {down} nadir, {len(cameras) - down} oblique "
                        f"(tilted by up to {max(tilted):.0f} degrees)"),
        ("GSD", f"{length((height + site.apparent_depth) / lens.focal[0])} on the bed at nadir"),
        ("positions", f"standard deviation {plan.settings.flight.position_std_m:g} m ([flight] position_std_m); the "
                      "lens by its data sheet"),
        ("path", f"{path:.0f} m in the order of the photographs{duration}"),
        ("coverage", verdict_text(
            verdict_by_limits(unseen, *_UNSEEN),
            f"{100.0 * (1.0 - unseen):.0f} % of the area is in three photographs or more",
            "give more overlap, or let the strips begin outside the area",
        )),
    ]  # fmt: skip


def _light_rows(plan: ScenePlan, survey: Survey, wind_m_s: float) -> list[tuple[str, str]]:
    time = plan.settings.light.known_time
    rows = [("sun", _NO_TIME)]
    if time is not None:
        place = place_of(survey.frame.crs, np.array(survey.frame.origin))
        sun = sun_of(plan.settings.light, survey.frame)
        rows = [("sun", sun_text([sun], f"{time:%Y-%m-%d %H:%M %Z}"))]
        if survey.water is not None:
            flight = GlitterOfFlight.of(in_the_middle(survey))
            found = flight.under(sun.direction, wind_m_s)
            rows += [
                ("glitter", glitter_text(found, flight.highest_sun(wind_m_s), wind_m_s, is_flown=False)),
                ("hours", _hours_text(flight, time, place, wind_m_s)),
            ]
    settings = plan.settings
    pixel = gsd_m(survey, Choices(quality="fine"))
    return [*rows, ("motion", motion_text(settings.flight.speed_m_s, settings.sensor.shutter_s, pixel))]


def _hours_text(flight: GlitterOfFlight, time: datetime, place: tuple[float, float], wind_m_s: float) -> str:
    """Hours of the day with little glitter and enough light on the bed, by the clock of the given time."""
    day, lost = time.replace(hour=0, minute=0, second=0, microsecond=0), dict[datetime, float]()
    for minute in range(0, 24 * 60, _STEP_MIN):
        at = day + timedelta(minutes=minute)
        sun = sun_at(at, *place)
        if sun.elevation >= math.radians(_LOWEST_SUN_DEG):
            lost[at] = lost_share(flight.under(sun.direction, wind_m_s))
    if not lost:
        return f"the sun stays lower than {_LOWEST_SUN_DEG:g} degrees that day: little light reaches the bed"
    good = [at for at, share in lost.items() if share <= LOST_GOOD]
    if not good:
        return f"no hour of that day has little glitter; the least is at {min(lost, key=lambda at: lost[at]):%H:%M}"
    step = timedelta(minutes=_STEP_MIN)
    firsts, lasts = ([at for at in good if at + way * step not in good] for way in (-1, 1))
    hours = " and ".join(f"{first:%H:%M} to {last:%H:%M}" for first, last in zip(firsts, lasts, strict=True))
    return f"{hours}: little glitter, and the sun at {_LOWEST_SUN_DEG:g} degrees or higher"
