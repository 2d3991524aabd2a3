"""Small drawn surveys, processed from end to end, for tests that look at what comes out."""

import json
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from std_coverage import WALL_DEG, Coverage, coverage_by_class, slope_below

from evaluation import distance_to_mesh, is_reached, vertical_difference
from evaluation.c2m import MeshDistances
from geo import Cloud, Mesh, read_cloud, read_reference
from geo.las import CLASS_BATHYMETRIC
from survey.folder.survey import Survey, load_survey
from survey.progress import Progress
from survey.run.folder import RunDir
from survey.run.process import process
from survey.simulate.drawn import DrawnScene, draw_survey

# A ground sampling distance of 2.3 cm, a bed 1.2 m deep, views that overlap tenfold: 7 s of work for one core.
SMALL = {
    "size_m": (3.2, 2.6), "depth_m": 1.2, "num_views": 10, "image_px": (200, 150), "focal_px": 300.0,
    "flying_m": 7.0, "noise": 0.0,
}  # fmt: skip
GSD = SMALL["flying_m"] / SMALL["focal_px"]
# Points whose nearest piece of the reference is this close to the water plane are neither wet nor dry.
SHORELINE_M = 0.05


@dataclass(frozen=True)
class DrawnRun:
    """A drawn survey and the run that was made of it."""

    scene: DrawnScene
    folder: Path

    @property
    def run(self) -> RunDir:
        return RunDir(self.folder / "bathynerf")

    @cached_property
    def survey(self) -> Survey:
        return load_survey(self.folder)

    @cached_property
    def cloud(self) -> Cloud:
        """The cloud, cropped to the bounds."""
        cloud = read_cloud(self.run.cloud_path)
        e0, n0, e1, n1 = self.survey.bounds
        e, n, _ = cloud.points.T
        inside = (e >= e0) & (e <= e1) & (n >= n0) & (n <= n1)
        extra = {name: values[inside] for name, values in cloud.extra.items()}
        return Cloud(cloud.points[inside], None, cloud.crs, cloud.classification[inside], extra)

    @cached_property
    def reference(self) -> Mesh:
        return read_reference(self.folder / "truth" / "reference.ply")

    @cached_property
    def distances(self) -> MeshDistances:
        """Of the cropped cloud from the true surface, in the local frame; nothing aligned."""
        frame = self.survey.frame
        vertices = frame.local_from_crs(self.reference.vertices)
        return distance_to_mesh(frame.local_from_crs(self.cloud.points), vertices, self.reference.faces)

    def coverage(self) -> dict[str, Coverage]:
        """Of the vertical errors by the std of the points, where the true surface is no wall; in classes."""
        points, vertices = (
            self.survey.frame.local_from_crs(each) for each in (self.cloud.points, self.reference.vertices)
        )
        error = vertical_difference(points, vertices, self.reference.faces)
        slope = slope_below(points, vertices, self.reference.faces)
        known = np.isfinite(error) & (slope < WALL_DEG)
        is_wet = self.cloud.classification == CLASS_BATHYMETRIC
        std, num_views = self.cloud.extra["std"], self.cloud.extra["num_views"]
        return coverage_by_class(error[known], std[known], num_views[known], slope[known], is_wet[known])

    def height_over_water(self, points_crs: np.ndarray) -> np.ndarray:
        """Vertical distance [m] of points (N, 3) in crs from the water plane as the scene has it, positive above."""
        scene = self.scene
        east, north = (points_crs[:, :2] - scene.origin).T
        return points_crs[:, 2] - (scene.level_m + scene.slope_east * east + scene.slope_north * north)

    def completeness(self, tolerance_m: float, height_m: float = np.inf) -> float:
        """Share of the points that three cameras see, up to `height_m` from the water plane, that the cloud reaches."""
        visible = read_reference(self.folder / "truth" / "visible.ply").points
        visible = visible[np.abs(self.height_over_water(visible)) < height_m]
        frame, cloud = self.survey.frame, read_cloud(self.run.cloud_path)
        reached = is_reached(frame.local_from_crs(visible), frame.local_from_crs(cloud.points), tolerance_m=tolerance_m)
        return float(reached.mean())

    def report(self) -> dict:
        return json.loads(self.run.report_json_path.read_text(encoding="utf-8"))


def drawn(folder: Path, **changes) -> DrawnRun:
    """Draw a small survey; `changes` are those to `SMALL`."""
    scene = DrawnScene(**(SMALL | changes))
    for name, content in _files_of(scene).items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    return DrawnRun(scene, folder)


@cache
def _files_of(scene: DrawnScene) -> dict[Path, bytes]:
    """The files of a drawn survey by their paths in its folder; a scene is drawn once for all tests."""
    with TemporaryDirectory() as place:
        folder = Path(place) / "survey"
        draw_survey(folder, scene)
        return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def processed(folder: Path, **changes) -> DrawnRun:
    """Draw a small survey and process it without a reference; its quality gates have to hold."""
    run = drawn(folder, **changes)
    assert process_quietly(folder) == 0
    return run


def process_quietly(folder: Path, **options) -> int:
    """Process a survey by the sweep alone, without a word; the exit code."""
    with Progress(verbosity=-1):
        return process(folder, field="off", **options)


def inner90(distances: np.ndarray) -> tuple[float, float]:
    """Mean and standard deviation of the 90 % of the distances that are least in size."""
    inner = distances[np.abs(distances) <= np.quantile(np.abs(distances), 0.9)]
    return float(inner.mean()), float(inner.std())
