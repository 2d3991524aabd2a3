"""The surfaces of the water in photographs that the solver found, as rasters and as a picture."""

import json
import math
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import rasterio
from PIL import Image
from small_report import facts_of
from small_survey import small_survey
from stored_run import plane_stored, run_of

from fields.waves.waves import Waves
from survey.errors import OutputError, SurveyError
from survey.export.export import export
from survey.folder.survey import load_survey
from survey.report.maps import draw_wave_shifts, draw_waves
from survey.run.flight import save_flight
from survey.run.folder import RunDir
from survey.run.stage_solver import SURFACES, WAVES, load_surfaces
from survey.run.stored import save_arrays

SPACING, NODES, AMPLITUDE_M = 0.5, 72, 0.02
# Wave vectors [rad/m], one for each photograph, of a whole number of periods over the nodes.
TURNS = np.array([(3, 1), (-2, 4), (1, -3)])
VECTORS = 2.0 * np.pi / (NODES * SPACING) * TURNS
# Places [m], displacements by waves and what is left of them [m].
SHIFTS = np.random.default_rng(1).uniform(-4.0, 4.0, (400, 6)) * ([1.0] * 2 + [0.01] * 2 + [0.002] * 2)
SEA = {"significant_height_m": 0.06, "slope_rms": 0.01, "peak_length_m": 9.0, "axis_deg": 20.0}


def wave(view: int, place: np.ndarray) -> np.ndarray:
    """Heights (...) [m] at places (..., 2) [m] in the local frame, in which the water of the small survey is level."""
    return AMPLITUDE_M * np.sin(place @ VECTORS[view])


def coefficients(corner: np.ndarray) -> np.ndarray:
    """Those of B-splines with the heights of `wave` at their nodes."""
    node = corner + SPACING * np.stack(np.meshgrid(*[np.arange(NODES)] * 2, indexing="ij"), axis=-1)
    gains = np.prod((2.0 + np.cos(VECTORS * SPACING)) / 3.0, axis=1)
    return np.stack([wave(view, node) / gain for view, gain in enumerate(gains)]).astype(np.float32)


@pytest.fixture(scope="module")
def block(tmp_path_factory):
    """A stored cloud and its survey, whose second photograph was taken 5 cm over the level."""
    folder = tmp_path_factory.mktemp("block") / "small"
    stored, survey = plane_stored(folder), load_survey(small_survey(folder))
    views = [replace(view, camera=replace(view.camera, tide=0.05 * (n == 1))) for n, view in enumerate(survey.views)]
    return stored, replace(survey, views=tuple(views[: len(TURNS)]))


def solved(block, path, *, sea=SEA, has_surfaces=True):
    """A run with the result of the solver."""
    stored, survey = block
    bed = run_of(stored, path)
    with RunDir(bed) as run:
        folder = run.open_stage("solver")
        (folder / WAVES).write_text(json.dumps({"moved_px": 0.04, "sea": sea}))
        if has_surfaces:
            corner = np.full(2, -0.5 * NODES * SPACING)
            names = np.array([view.name for view in survey.views])
            arrays = {"corner": np.tile(corner, (len(names), 1)), "spacing": np.asarray(SPACING)}
            arrays |= {"shown": np.asarray(1), "shifts": SHIFTS}
            save_arrays(folder / SURFACES, names=names, coefficients=coefficients(corner), **arrays)
        folder = run.finish_stage("solver", {}, folder)
        stages = {"bed": run.load_stage("bed"), "solver": folder}
        run.publish(run.open_result("standard"), quality="standard", stages=stages)
    save_flight(path, survey)
    return path, folder


def test_rasters_have_the_heights_of_the_surfaces_where_photographs_show_the_bed(block, tmp_path):
    run, _ = solved(block, tmp_path / "run")
    survey, bed = block[1], block[0].bed.xyz
    assert export(run, waves=tmp_path / "out") == [tmp_path / "out"]
    for view, of in enumerate(survey.views):
        with rasterio.open(tmp_path / "out" / f"{of.name}.tif") as raster:
            height, transform = raster.read(1), raster.transform
            assert (raster.crs.to_epsg(), math.isnan(raster.nodata), raster.units) == (25832, True, ("metre",))
        row, column = np.indices(height.shape) + 0.5
        level = np.full(height.shape, survey.frame.origin[2])
        in_crs = np.stack([transform.c + transform.a * column, transform.f + transform.e * row, level], axis=-1)
        place = survey.frame.local_from_crs(in_crs)[..., :2]
        known = np.isfinite(height)
        # Between the nodes of waves of 11 spacings and more a spline is off by less than a hundredth.
        np.testing.assert_allclose(height[known], wave(view, place[known]), atol=0.01 * AMPLITUDE_M)
        # The crossings lie between the camera and the bed, within what it shows, and there alone.
        shown = bed[of.camera.sees(of.camera.project(bed, survey.water))][:, :2]
        low, high = (limit(np.vstack([shown, of.camera.centre[None, :2]]), axis=0) for limit in (np.min, np.max))
        assert (place[known] > low - 2.0 * SPACING).all()
        assert (place[known] < high + 2.0 * SPACING).all()
        assert known.sum() * (0.5 * SPACING) ** 2 > 0.5 * np.prod(np.ptp(shown, axis=0))


def test_splines_are_those_of_the_solver(block, tmp_path):
    _, folder = solved(block, tmp_path / "run")
    found = load_surfaces(folder, block[1])
    still = Waves.still(np.zeros((len(TURNS), 3)), np.zeros(len(TURNS)), 1.34)
    waves = replace(still, corner=found.corner, spacing=found.spacing, coefficients=found.coefficients)
    for view, surface in enumerate(found.over(block[0].bed.xyz)):
        place = block[1].frame.local_from_crs(np.dstack([surface.grid.middles(), np.zeros(surface.grid.shape)]))
        at = np.rint((place[..., :2] - found.corner[view]) * 2.0 / SPACING).astype(int)
        known = np.isfinite(surface.height)
        nearest = waves.raster(view)[at[known][:, 1], at[known][:, 0], 0]
        # A quarter of a spacing away at most along either axis, by slopes of 0.02.
        assert np.abs(surface.height[known] - nearest).max() < 0.02 * 0.36 * SPACING


def test_a_folder_of_the_run_is_written_again_and_one_with_other_files_refused(block, tmp_path):
    run, _ = solved(block, tmp_path / "run")
    other, of_others = tmp_path / "out" / "other.tif", tmp_path / "others"
    export(run, waves=other.parent)
    other.write_bytes(b"II*\0")
    export(run, waves=other.parent)
    assert other.read_bytes() == b"II*\0"
    of_others.mkdir()
    (of_others / "other.tif").write_bytes(b"II*\0")
    with pytest.raises(OutputError, match="holds other files"):
        export(run, waves=of_others)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"sea": None, "has_surfaces": False}, r"taken as still \(waves shift its photographs by 0.04 px\)"),
        ({"has_surfaces": False}, "was solved in tiles"),
    ],
)
def test_a_run_without_surfaces_says_why(block, tmp_path, given, words):
    run, _ = solved(block, tmp_path / "run", **given)
    with pytest.raises(SurveyError, match=words):
        export(run, waves=tmp_path / "out")


def test_a_run_without_the_solver_has_no_surfaces(block, tmp_path):
    run = run_of(block[0], tmp_path / "run")
    with pytest.raises(SurveyError, match="made without the solver"):
        export(run, waves=tmp_path / "out")


def test_the_picture_shows_the_surface_without_its_tilt(block, tmp_path):
    stored, survey = block
    _, folder = solved(block, tmp_path / "run")
    surfaces = load_surfaces(folder, survey)
    tilt = 0.01 * SPACING * np.arange(NODES, dtype=np.float32)[:, None]
    tilted = replace(surfaces, coefficients=surfaces.coefficients + tilt)
    for one, other in zip(surfaces.over(stored.bed.xyz), tilted.over(stored.bed.xyz), strict=True):
        np.testing.assert_allclose(one.without_tilt().height, other.without_tilt().height, atol=1e-5)
    for draw in (draw_waves, draw_wave_shifts):
        picture = draw(tmp_path / f"{draw.__name__}.png", facts_of(survey, stored.bed), surfaces)
        with Image.open(picture.path) as image:
            assert np.asarray(image.convert("L")).std() > 5.0


def test_shifts_of_the_photograph_that_waves_displace_most_are_those_of_the_solver(block, tmp_path):
    surfaces = load_surfaces(solved(block, tmp_path / "run")[1], block[1])
    assert surfaces.shown == block[1].views[1].name
    _, before, after = surfaces.shifts_in_crs(10**6)
    # True to scale and north by 0.1 %, as far as the grid is.
    for found, at in ((before, 2), (after, 4)):
        turned = SHIFTS[:, at : at + 2]
        np.testing.assert_allclose(np.sort(np.hypot(*found.T)), np.sort(np.hypot(*turned.T)), rtol=2e-3)
    assert len(surfaces.shifts_in_crs(50)[0]) < 100


def test_the_picture_of_shifts_says_their_length_in_metres_whatever_the_crs_and_the_shape(block, tmp_path):
    facts, surfaces = facts_of(block[1], block[0].bed), load_surfaces(solved(block, tmp_path / "run")[1], block[1])
    # Five times as long as wide: the map is two thirds as wide as long.
    narrow = replace(surfaces, shifts=surfaces.shifts * ([0.2] + [1.0] * 5))
    feet = SimpleNamespace(crs_from_local=lambda points: narrow.frame.crs_from_local(points) / 0.3048)
    in_metres, in_feet = (
        draw_wave_shifts(tmp_path / "shifts.png", facts, replace(narrow, frame=frame)) for frame in (narrow.frame, feet)
    )
    assert in_metres.caption == in_feet.caption
    place, before, _ = narrow.shifts_in_crs(800)
    (wide, long), apart = np.ptp(place, axis=0), np.sqrt(np.prod(np.ptp(place, axis=0)) / len(place))
    assert wide < long / 1.5
    expected = 2.0 * np.sqrt(np.mean(before**2)) / apart * long / 1.5 / 8.0
    found = float(re.search(r"means ([\d.]+)\s*mm", in_metres.caption)[1])
    assert found == pytest.approx(1000.0 * expected, rel=0.1)
