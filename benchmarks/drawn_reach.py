"""A reach of a river whose water is no plane, drawn, and what is measured of its water."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from evaluation import distance_to_mesh
from geo import read_cloud, read_reference
from survey.folder.survey import load_survey
from survey.simulate.staging.simulate import simulate

ORIGIN, CRS_NAME = (676120.0, 5311480.0, 584.0), "EPSG:25832+7837"
_SCENE = """
name = "{name}"
crs = "{crs}"
origin = {origin}
seed = {seed}
[area]
size_m = {size_m}
[bed]
depth_m = {depth_m}
[texture]
texel_m = 0.025
[water]
slope_east = {slope}
{waves}
[camera]
size_px = {size_px}
focal_px = {focal_px}
[flight]
height_m = {height_m}
patterns = ["nadir"]
forward_overlap = 0.75
side_overlap = 0.6
[sensor]
exposure = 1.7
[render]
mode = "direct"
"""


@dataclass(frozen=True)
class Reach:
    """A reach whose water falls by ``slope`` along east, and stands in waves of amplitude [m], length [m], phase."""

    name: str
    size_m: tuple[float, float]
    depth_m: float
    size_px: tuple[int, int]
    focal_px: float
    height_m: float
    slope: float
    waves: Sequence[tuple[float, float, float]]
    seed: int = 3

    def level(self, east: np.ndarray) -> np.ndarray:
        """Height of the water [m] over the origin at places so far east of it."""
        waves = sum(a * np.sin(2.0 * math.pi / length * east + phase) for a, length, phase in self.waves)
        return self.slope * east + waves

    def draw(self, folder: Path) -> Path:
        """Its survey in a folder, drawn where it is not there yet."""
        survey, scene = folder / self.name, folder / f"{self.name}.toml"
        if not survey.exists():
            waves = [
                f"[[water.waves]]\namplitude_m = {a}\nlength_m = {length}\ntoward_deg = 90.0\n"
                f"phase_deg = {math.degrees(phase)}\n"
                for a, length, phase in self.waves
            ]
            given = {name: list(value) if isinstance(value, tuple) else value for name, value in vars(self).items()}
            scene.write_text(_SCENE.format(**given | {"waves": "".join(waves)}, crs=CRS_NAME, origin=list(ORIGIN)))
            simulate(scene, survey, preview=True)
        return survey

    def write_points(self, path: Path, places: np.ndarray, std_m: float, noise_m: np.ndarray | float = 0.0) -> None:
        """Points of the water at places (N, 2) [m] from the origin, as a table."""
        rows = np.column_stack([places, self.level(places[:, 0]) + noise_m]) + ORIGIN
        text = "".join(f"{e:.3f},{n:.3f},{h:.4f},{std_m}\n" for e, n, h in rows.tolist())
        path.write_text("easting,northing,height,std\n" + text)


def with_measured_water(survey: Path, line: str) -> None:
    """Put a line into [water] in place of the level."""
    settings = re.sub(r"(level_m|level_at|slope_east|slope_north) = .*\n", "", (survey / "survey.toml").read_text())
    (survey / "survey.toml").write_text(settings.replace("[water]\n", f"[water]\n{line}\n"))


@dataclass(frozen=True)
class Errors:
    """Of the N points of a cloud within the bounds: signed distance, place [m], local, std and std_common [m]."""

    off: np.ndarray
    xyz: np.ndarray
    std: np.ndarray
    std_common: np.ndarray


def errors_of(survey: Path, cloud: Path) -> Errors:
    """Errors of a cloud against the truth of its survey."""
    loaded, found = load_survey(survey), read_cloud(cloud)
    assert loaded.bounds is not None
    low, high = loaded.bounds[:2], loaded.bounds[2:]
    inside = ((found.points[:, :2] >= low) & (found.points[:, :2] <= high)).all(axis=1)
    xyz = loaded.frame.local_from_crs(found.points[inside])
    mesh = read_reference(survey / "truth" / "reference.ply")
    off = distance_to_mesh(xyz, loaded.frame.local_from_crs(mesh.vertices), mesh.faces).signed
    return Errors(off, xyz, found.extra["std"][inside], found.extra["std_common"][inside])
