"""What water costs those who ignore it: straight rays end above the bed, by the amount that geometry predicts.

To each camera a point of the bed appears along a straight ray in air. The apparent rays of several cameras nearly meet
above the point, and least squares says where: no image is needed to know that place. So this holds the whole chain
against a number that owes nothing to it.
"""

from dataclasses import dataclass

import numpy as np
import pytest
from drawn_runs import GSD, DrawnRun, drawn, inner90, process_quietly
from scipy.spatial import cKDTree

from geo import read_cloud, read_reference
from refract import FlatWater, PinholeCamera
from survey.simulate.drawn import stage_drawing

# Runs of a drawn survey.
pytestmark = pytest.mark.slow

# Asked for are 5 %. Views that look straight down hide refraction so well that matching finds the place of the least
# squares itself; measured 0.2 % with two seeds.
SHARE = 0.01
# Views that look down lean by less than this, convergent ones by more than 10 degrees.
PLUMB_DEG = 5.0
# So far from the nearest body [m] windows show bed alone; the objects are a fifth as large as those of the demo.
CLEAR_M = 0.2
MIN_VIEWS = 3
# At 0.2 m; the bed is 0.3 m off.
COMPLETENESS = 0.05


@dataclass(frozen=True)
class Ignored:
    """A survey under water that was processed with straight rays.

    Attributes
    ----------
    bias : (N,) [m]
        How much the cloud lies above the bed, for points of the bed.
    predicted : (N,) [m]
        The same of the least-squares meeting places of their apparent rays.
    depth : (N,) [m]
    run : DrawnRun
    """

    bias: np.ndarray
    predicted: np.ndarray
    depth: np.ndarray
    run: DrawnRun


def meeting_places(points: np.ndarray, cameras: list[PinholeCamera], water: FlatWater) -> np.ndarray:
    """Where the apparent rays of points (N, 3) [m], local, meet in least squares: (N, 3), NaN with too few rays.

    The rays of all cameras that see the point count alike; minimised are the squared distances from the rays.
    """
    normal, right, num = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3)), np.zeros(len(points))
    for camera in cameras:
        pixels = camera.project(points, water)
        seen = ((pixels > 0.0) & (pixels < (camera.width, camera.height))).all(axis=1)
        ray = camera.directions(pixels)
        across = np.where(seen[:, None, None], np.eye(3) - ray[:, :, None] * ray[:, None, :], 0.0)
        normal, right, num = normal + across, right + across @ camera.centre, num + seen
    places = np.full(points.shape, np.nan)
    enough = num >= MIN_VIEWS
    places[enough] = np.linalg.solve(normal[enough], right[enough][..., None])[..., 0]
    return places


def process_ignoring_water(folder, max_lean_deg: float) -> Ignored:
    """Draw a survey, process the views that lean less than `max_lean_deg` with an index of 1, and compare."""
    run = drawn(folder)
    drawing = stage_drawing(run.scene)
    cameras = {
        name: camera
        for name, camera in zip(drawing.names, drawing.cameras, strict=True)
        if -camera.cam_from_local[2, 2] > np.cos(np.radians(max_lean_deg))
    }
    head, *lines = (folder / "cameras.csv").read_text(encoding="utf-8").splitlines()
    lines = [line for line in lines if line.split(",")[0] in cameras]
    (folder / "cameras.csv").write_text("\n".join([head, *lines, ""]), encoding="utf-8")
    settings = (folder / "survey.toml").read_text(encoding="utf-8")
    assert settings.count("refractive_index = 1.333") == 1
    settings = settings.replace("refractive_index = 1.333", "refractive_index = 1.0")
    (folder / "survey.toml").write_text(settings, encoding="utf-8")
    process_quietly(folder)

    bed = drawing.frame.local_from_crs(read_reference(folder / "truth" / "visible.ply").points)
    for solid in drawing.renderer.ground.solids:
        bed = bed[np.linalg.norm(bed - solid.centre, axis=1) > solid.radius + CLEAR_M]
    places = meeting_places(bed, list(cameras.values()), drawing.water)
    cloud = drawing.frame.local_from_crs(read_cloud(run.run.cloud_path).points)
    known = np.isfinite(places).all(axis=1)
    away, nearest = cKDTree(cloud[:, :2]).query(np.where(known[:, None], places, np.inf)[:, :2])
    there = away < GSD
    assert there.sum() > 0.98 * known.sum() > 3000
    bias = cloud[nearest[there], 2] - bed[there, 2]
    return Ignored(bias, (places - bed)[there, 2], -bed[there, 2], run)


@pytest.fixture(scope="module")
def plumb(tmp_path_factory) -> Ignored:
    """The views that look straight down."""
    return process_ignoring_water(tmp_path_factory.mktemp("plumb") / "survey", PLUMB_DEG)


@pytest.fixture(scope="module")
def convergent(tmp_path_factory) -> Ignored:
    """All views, tilted by up to 35 degrees."""
    return process_ignoring_water(tmp_path_factory.mktemp("convergent") / "survey", 90.0)


def test_straight_rays_from_above_end_where_the_apparent_rays_meet(plumb):
    predicted = np.median(plumb.predicted)
    assert predicted > 0.25 * np.median(plumb.depth)
    assert np.median(plumb.bias) == pytest.approx(predicted, rel=SHARE)


def test_the_amount_follows_the_depth_point_by_point(plumb):
    """Not only the median: what is left after the prediction is the noise of matching, as it is with bent rays."""
    left = plumb.bias - plumb.predicted
    assert np.std(plumb.predicted) > 0.2 * GSD
    assert inner90(left)[1] < 0.3 * GSD


def test_straight_rays_of_convergent_views_end_between_the_nadir_limit_and_the_least_squares(convergent):
    """They do not meet, and matching takes the half of the views that agree best: the steep ones."""
    nadir = np.median(convergent.depth) * (1.0 - 1.0 / convergent.run.scene.n_water)
    assert nadir < np.median(convergent.bias) < np.median(convergent.predicted)


@pytest.mark.parametrize("name", ["plumb", "convergent"])
def test_without_refraction_hardly_anything_of_the_bed_is_reached(name, request):
    assert request.getfixturevalue(name).run.completeness(0.2) < COMPLETENESS
