"""A survey whose photographs were painted, so that the colours of its bed are known, and a run with its points."""

from pathlib import Path

import numpy as np
import torch
from PIL import Image
from plane_survey import PlaneBed
from small_survey import HEADER, TOML, camera_lines
from stored_run import run_of, stored_points

from fields.image_store import GAMMA
from fields.water_column import WaterColumn
from refract import fresnel_coefficients
from survey.folder.survey import Survey, load_survey
from survey.run.flight import save_flight
from survey.run.folder import RunDir
from survey.settings.config import dump_config

# A pixel covers this of the bed.
GSD_M = 0.2
DEPTH_M, SLOPE = 1.5, 0.1
EXPOSURES = (1.0, 0.8, 1.1, 0.9)
ABSORPTION, VEIL = (0.4, 0.1, 0.05), (0.02, 0.05, 0.06)


def pattern(xy: np.ndarray) -> np.ndarray:
    """The bed's own colours (..., 3), 60 to 180, at local places (..., 2 or more); long against a pixel."""
    x, y = xy[..., 0], xy[..., 1]
    waves = np.stack([np.sin(1.5 * x) * np.cos(1.1 * y), np.cos(1.3 * x + y), np.sin(0.9 * y - x)], axis=-1)
    return 120.0 + 60.0 * waves


def through_water(colour: np.ndarray, depth: np.ndarray, incidence: np.ndarray, n_water: float) -> np.ndarray:
    """Stored colours (N, 3) as a photograph has them of a bed with these of its own."""
    column = WaterColumn(ABSORPTION, VEIL)
    cosine = np.sqrt(1.0 - (np.sin(incidence) / n_water) ** 2)
    mirrored = fresnel_coefficients(np.cos(incidence), n_from=1.0, n_to=n_water).reflectance
    way = column.path_length(torch.as_tensor(depth), torch.as_tensor(depth / cosine))
    with torch.no_grad():
        light = column(torch.as_tensor((colour / 255.0) ** GAMMA), way, torch.as_tensor(mirrored)).numpy()
    return 255.0 * light ** (1.0 / GAMMA)


def bed_height(survey: Survey, xy: np.ndarray) -> np.ndarray:
    """Height (...) [m] of the bed at local places (..., 2 or more)."""
    return survey.water.point[2] - DEPTH_M + SLOPE * xy[..., 0]


def painted_survey(folder: Path, *, exposures=EXPOSURES, coloured_water: bool = False) -> Survey:
    """A survey over a sloped bed under water whose photographs show the pattern, each in its exposure."""
    (folder / "images").mkdir(parents=True)
    lines = [line.replace(".jpg", ".png") for line in camera_lines(len(exposures))]
    (folder / "cameras.csv").write_text("\n".join([HEADER, *lines]) + "\n")
    (folder / "survey.toml").write_text(TOML)
    for i in range(len(exposures)):
        Image.new("RGB", (64, 48)).save(folder / "images" / f"{i:04d}.png")
    survey = load_survey(folder)
    bed = PlaneBed(survey.water, float(bed_height(survey, np.zeros(2))), SLOPE)
    for view, exposure in zip(survey.views, exposures, strict=True):
        path = view.camera.paths(view.camera.pixel_centres(), survey.water)
        points = path.at_height(bed.true_height(view.camera), survey.water)
        colour = pattern(points)
        if coloured_water:
            incidence = np.arccos(-(path.air_direction @ np.array(survey.water.up)))
            depth = survey.water.height(points[..., 0], points[..., 1]) - points[..., 2]
            flat = through_water(colour.reshape(-1, 3), depth.ravel(), incidence.ravel(), survey.water.n_water)
            colour = flat.reshape(colour.shape)
        Image.fromarray(np.clip(np.round(exposure * colour), 0, 255).astype(np.uint8)).save(view.path)
    return survey


def run_over(survey: Survey, path: Path, **parts: str) -> Path:
    """A run with the points of the bed under the middle of the flight."""
    centre = np.mean([view.camera.centre[:2] for view in survey.views], axis=0)
    along = np.arange(-4.0, 4.0, 0.1)
    plan = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2) + centre
    points = survey.frame.crs_from_local(np.column_stack([plan, bed_height(survey, plan)]))
    level = float(survey.frame.crs_from_local(np.array([*centre, survey.water.point[2]]))[2])
    stored = stored_points(points, survey.frame.crs, level_m=level, gsd_m=GSD_M, name=survey.name)
    run = run_of(stored, path, **parts)
    RunDir(run).settings_path.write_text(dump_config(survey.config))
    save_flight(run, survey)
    return run
