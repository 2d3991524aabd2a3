"""An adjustment applied to its survey, and its cameras as files of other programs."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from geo.crs import is_geographic
from geo.files import write_text
from refract.lens import Lens
from survey.adjust.assembling import lens_with
from survey.adjust.block.observed import original_pixels
from survey.adjust.block.priors import PriorKnowledge
from survey.adjust.block.state import Layout, State, enlarged
from survey.adjust.result.adjustment import Adjustment
from survey.folder.local_frame import water_plane
from survey.folder.observations import rows_between
from survey.folder.survey import Survey
from survey.photos.cameras import View, equations_of_lines
from survey.photos.colmap_model import FILES, write_model
from survey.photos.poses import CAM_FROM_OPK_CAM, TiePoints, least_track
from survey.water.tides import with_shift

# Decimals of coordinates in metres and in degrees: to a tenth of a micrometre, so that nothing is lost.
_DECIMALS_M, _DECIMALS_DEG = 7, 12
# Reciprocal condition below which rays are parallel.
_PARALLEL = 1e-9
_HEAD = "# tie points where straight rays meet: those under water lie deeper\n"
CAMERAS = "cameras.csv"
MODEL_FOLDER = "sparse"
MODEL = tuple(f"{MODEL_FOLDER}/{name}" for name in FILES)


def apply_adjustment(survey: Survey, found: Adjustment) -> Survey:
    """The survey with the poses, lenses and water that an adjustment found."""
    views = _views(survey, found.lenses, found.layout, found.state(survey.water))
    tide = survey.observations.tide
    if found.poses.hours is not None and tide is not None and found.water is not None:
        over = {view.name: view.camera.tide for view in views}
        tide = with_shift(replace(tide, over=over), views, survey.require_water()[0])
    survey = replace(
        survey,
        views=views,
        observations=replace(survey.observations, points=found.points, ties=None, tide=tide),
        provenance=replace(survey.provenance, is_adjusted=True),
    )
    if found.layout.finds_readouts and found.readouts_s is not None and len(found.readouts_s) == 1:
        readout = max(found.readouts_s[0], 0.0)
        cameras = replace(survey.config.cameras, rolling_shutter_s=readout, rolling_shutter_std_s=None)
        survey = replace(survey, config=replace(survey.config, cameras=cameras))
    if found.water is None:
        return survey
    config = replace(survey.config, water=found.water)
    return replace(survey, config=config, water=water_plane(survey.frame, found.water))


def at_state(survey: Survey, prior: PriorKnowledge, state: State) -> Survey:
    """The survey at a state of its adjustment."""
    lenses = [lens_with(lens, state.lenses[i]) for i, lens in enumerate(prior.lenses)]
    return replace(
        survey,
        views=_views(survey, lenses, prior.layout, state),
        water=state.water,
        observations=replace(survey.observations, points=state.points),
        provenance=replace(survey.provenance, is_adjusted=True),
    )


def _views(survey: Survey, lenses: Sequence[Lens], layout: Layout, state: State) -> tuple[View, ...]:
    """The views with the lenses (L,) of a state, and its poses, motions and tides."""
    views, tides = [], state.tides(layout)
    for number, (view, lens) in enumerate(zip(survey.views, (lenses[k] for k in layout.lens_of), strict=True)):
        if layout.finds_focals:
            lens = enlarged(lens, 1.0 + float(state.focals[number]))
        tide = 0.0 if tides is None else float(tides[number])
        camera = replace(lens.camera(state.centres[number], state.rotations[number]), tide=tide)
        if layout.velocity_per_row is not None and layout.velocity_per_row[number].any():
            readout = state.readouts[layout.lens_of[number]]
            camera = replace(camera, motion=layout.velocity_per_row[number] * readout)
        views.append(replace(view, camera=camera, lens=lens))
    return tuple(views)


def write_cameras(folder: Path, survey: Survey, found: Adjustment | None = None) -> None:
    """Write cameras.csv (positions in crs; omega, phi, kappa) and a COLMAP model (topocentric) into a folder.

    The points of the model are those of the adjustment, where straight rays from the adjusted cameras meet: programs
    that read the model know no others, and would find the true places of points under water, which are in
    adjustment.npz, several pixels off. The model says in its first lines how survey.toml gives it back. Where shutters
    roll, cameras.csv has how far each camera flew from the first row to the last [m], true east, north and up.
    """
    (folder / MODEL_FOLDER).mkdir(exist_ok=True)
    ties = None if found is None else _straight_ties(survey, found)
    write_model(folder / MODEL_FOLDER, survey.views, head=_settings_of_model(survey), points=_HEAD, ties=ties)
    write_text(folder / CAMERAS, _opk(survey))


def _straight_ties(survey: Survey, found: Adjustment) -> TiePoints:
    """Tie points of an adjustment with the places where straight rays intersect."""
    order = np.argsort(found.residuals.point, kind="stable")
    point, view = found.residuals.point[order].astype(np.int64), found.residuals.view[order].astype(np.int64)
    ties = TiePoints(found.points, point, view, found.residuals.at_px[order], least_track(len(survey.views)))
    pixel = original_pixels(ties, found.lenses, found.poses.lens_of)
    centres, rays = np.empty((len(point), 3)), np.empty((len(point), 3))
    for number, each in enumerate(survey.views):
        of_view = view == number
        centres[of_view], rays[of_view] = each.camera.centres(pixel[of_view]), each.camera.directions(pixel[of_view])
    # Relative to the true place of the point, so that distant centres cost no digits.
    normals, rights = equations_of_lines(centres - found.points[point], rays)
    normal, right = np.zeros((len(found.points), 3, 3)), np.zeros((len(found.points), 3))
    np.add.at(normal, point, normals)
    np.add.at(right, point, rights)
    eigenvalues = np.linalg.eigvalsh(normal)
    sound = eigenvalues[:, 0] > _PARALLEL * eigenvalues[:, 2]
    places = found.points.copy()
    places[sound] += np.linalg.solve(normal[sound], right[sound][..., None])[..., 0]
    straight = replace(ties, start=places, pixel=pixel)
    return straight.only(sound[point] & np.isfinite(places[point]).all(axis=1))


def _settings_of_model(survey: Survey) -> str:
    origin = ", ".join(repr(float(v)) for v in survey.frame.origin)
    shutter = ""
    if any(view.camera.motion is not None for view in survey.views):
        shutter = f", rolling_shutter_s = {survey.config.cameras.rolling_shutter_s!r}"
    return f'# In survey.toml: [cameras] poses = "sparse"{shutter} and [local] origin = [{origin}]\n'


def _opk(survey: Survey) -> str:
    centres = survey.frame.crs_from_local(np.array([view.camera.centre for view in survey.views]))
    decimals = _DECIMALS_DEG if is_geographic(survey.frame.crs) else _DECIMALS_M
    places = (decimals, decimals, _DECIMALS_M)
    rolls = any(view.camera.motion is not None for view in survey.views)
    lines = ["image,easting,northing,height,omega,phi,kappa" + (",flown_east,flown_north,flown_up" if rolls else "")]
    for view, centre, axes in zip(survey.views, centres, survey.frame.local_from_grid(centres), strict=True):
        r = axes.T @ view.camera.cam_from_local.T @ CAM_FROM_OPK_CAM
        angles = (math.atan2(-r[1, 2], r[2, 2]), math.asin(r[0, 2]), math.atan2(-r[0, 1], r[0, 0]))
        numbers = [f"{v:.{digits}f}" for v, digits in zip(centre, places, strict=True)]
        numbers += [f"{math.degrees(v):.10f}" for v in angles]
        if rolls:
            per_row = np.zeros(3) if view.camera.motion is None else view.camera.motion
            numbers += [f"{v:.{_DECIMALS_M}f}" for v in per_row * rows_between(view.lens.height)]
        lines.append(",".join([view.name, *numbers]))
    return "\n".join([*lines, ""])
