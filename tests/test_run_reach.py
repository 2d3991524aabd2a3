"""A short reach whose water is no plane, drawn and processed: by one plane, and by its surface in one piece and two."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from drawn_runs import inner90

from evaluation import distance_to_mesh
from geo import read_cloud, read_reference
from survey.folder.survey import load_survey
from survey.progress import Progress
from survey.run.process import process
from survey.simulate.staging.simulate import simulate

pytestmark = pytest.mark.slow

E0, N0, LEVEL = 676120.0, 5311480.0, 584.0
AMPLITUDE, LENGTH = 0.06, 8.0
SCENE = f"""
name = "reach"
crs = "EPSG:25832+7837"
origin = [{E0}, {N0}, {LEVEL}]
[area]
size_m = [6.0, 2.4]
[bed]
depth_m = 1.2
[texture]
texel_m = 0.025
[water]
[[water.waves]]
amplitude_m = {AMPLITUDE}
length_m = {LENGTH}
toward_deg = 90.0
phase_deg = 180.0
[camera]
size_px = [200, 150]
focal_px = 300.0
[flight]
height_m = 7.0
patterns = ["nadir"]
forward_overlap = 0.75
side_overlap = 0.6
[sensor]
exposure = 1.7
[render]
mode = "direct"
"""


@pytest.fixture(scope="module")
def reach(tmp_path_factory):
    """The folder of the survey, whose settings have the mean level of the water."""
    folder = tmp_path_factory.mktemp("reach")
    (folder / "scene.toml").write_text(SCENE)
    with Progress(verbosity=-1):
        simulate(folder / "scene.toml", folder / "survey", preview=True)
    return folder / "survey"


def with_points(survey):
    """Replace the level by points of the surface, a metre apart and good to a millimetre."""
    places = np.stack(np.meshgrid(np.arange(-8.0, 8.5), np.arange(-4.0, 4.5)), axis=-1).reshape(-1, 2)
    heights = -AMPLITUDE * np.sin(2.0 * math.pi / LENGTH * places[:, 0])
    rows = np.add(np.column_stack([places, heights]), (E0, N0, LEVEL))
    text = "".join(f"{e:.2f},{n:.2f},{h:.4f},0.001\n" for e, n, h in rows)
    (survey / "water.csv").write_text("easting,northing,height,std\n" + text)
    settings = re.sub(r"(level_m|level_at|slope_east|slope_north) = .*\n", "", (survey / "survey.toml").read_text())
    (survey / "survey.toml").write_text(settings.replace("[water]\n", '[water]\nsurface = "water.csv"\n'))


def errors(survey, run, tiles):
    """Signed errors [m] of the points within the bounds, and their places along the reach [m]."""
    with Progress(verbosity=-1):
        assert process(survey, run, field="off", tiles=tiles) == 0
    frame, bounds = load_survey(survey).frame, load_survey(survey).bounds
    points = read_cloud(run / "cloud.las").points
    xyz = frame.local_from_crs(points[((points[:, :2] >= bounds[:2]) & (points[:, :2] <= bounds[2:])).all(axis=1)])
    truth = read_reference(survey / "truth" / "reference.ply")
    return distance_to_mesh(xyz, frame.local_from_crs(truth.vertices), truth.faces).signed, xyz[:, 0]


def test_points_are_under_the_surface_and_not_under_a_plane(reach, tmp_path):
    def leaning(off, along):
        # Of crest and trough, 1 m of the reach about each.
        west, east = (np.median(off[np.abs(along - at) < 0.5]) for at in (-2.0, 2.0))
        return west - east

    plane, along = errors(reach, tmp_path / "plane", 1)
    # Water that is 6 cm higher than the plane has its bed (n - 1) times as much too high, west, and too low, east; a
    # tenth less as the surface focuses.
    assert leaning(plane, along) == pytest.approx(0.333 * 2.0 * AMPLITUDE, rel=0.3)
    with_points(reach)
    for tiles in (1, 2):
        off, along = errors(reach, tmp_path / f"surface{tiles}", tiles)
        assert abs(leaning(off, along)) < 3e-3
        assert abs(inner90(off)[0]) < 1e-3
        assert len(off) == pytest.approx(len(plane), rel=0.01)
