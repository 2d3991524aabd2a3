"""The bed from above, from photographs that were painted so that its colours are known."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import rasterio
from painted_survey import ABSORPTION, DEPTH_M, VEIL, painted_survey, pattern, run_over, through_water  # fmt: skip
from plane_survey import look
from pyproj import CRS
from rio_cogeo.cogeo import cog_validate
from small_survey import E0, LEVEL, N0
from stored_run import run_of, stored_points

from geo.frames import LocalFrame
from geo.grid import Grid, Window
from survey.errors import SurveyError
from survey.export.export import export
from survey.export.loaded import Pixels
from survey.export.orthophoto import BedPlaces, HeightBuffer, Mosaic, common_exposure
from survey.export.registry import ExportOptions
from survey.folder.survey import Survey
from survey.run.flight import Flight


def picture(path: Path, survey: Survey) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Colours (K, 3) of the cells of an orthophoto that are seen, the bed's own there, and where all are seen."""
    with rasterio.open(path) as raster:
        bands = raster.read()
        t = raster.transform
        columns, rows = np.meshgrid(np.arange(raster.width) + 0.5, np.arange(raster.height) + 0.5)
        place = np.stack([t.c + t.a * columns, t.f + t.e * rows, np.full(rows.shape, LEVEL - DEPTH_M)], axis=-1)
        assert raster.colorinterp[3] == rasterio.enums.ColorInterp.alpha
    seen = bands[3] == 255
    return np.moveaxis(bands[:3], 0, -1)[seen].astype(float), pattern(survey.frame.local_from_crs(place))[seen], seen


def test_an_orthophoto_shows_the_bed_where_it_is_in_one_exposure(tmp_path):
    survey = painted_survey(tmp_path / "s")
    run = run_over(survey, tmp_path / "s" / "bathynerf")
    export(run, orthophoto=tmp_path / "o.tif")
    found, own, seen = picture(tmp_path / "o.tif", survey)
    assert seen.mean() > 0.85
    # One factor for all, where the photographs differ by up to 1.375; the rest is bilinear interpolation.
    factor = np.median(found / own)
    assert 0.8 < factor < 1.1
    assert np.sqrt(np.mean((found / factor - own) ** 2)) < 3.0
    assert cog_validate(tmp_path / "o.tif", strict=True)[0]


def test_a_run_in_true_colour_gives_an_orthophoto_in_the_bed_s_own_colours(tmp_path):
    survey = painted_survey(tmp_path / "s", exposures=(1.0,) * 4, coloured_water=True)
    water = replace(survey.config.water, absorption_per_m=ABSORPTION, veiling_light=VEIL)
    survey = replace(survey, config=replace(survey.config, water=water))
    run = run_over(survey, tmp_path / "s" / "bathynerf", true_colour="given")
    export(run, orthophoto=tmp_path / "o.tif")
    found, own, _ = picture(tmp_path / "o.tif", survey)
    photographed = through_water(own, np.full(len(own), DEPTH_M), np.zeros(len(own)), 1.333)
    assert np.sqrt(np.mean((photographed - own)[:, 0] ** 2)) > 15.0
    assert np.sqrt(np.mean((found - own) ** 2)) < 5.0
    with rasterio.open(tmp_path / "o.tif") as raster:
        assert raster.tags()["COLOURS"] == "of the bed without its water"


def test_photographs_that_were_moved_are_found_by_the_folder_of_their_survey(tmp_path):
    survey = painted_survey(tmp_path / "s")
    run = run_over(survey, tmp_path / "run")
    export(run, orthophoto=tmp_path / "before.tif")
    (tmp_path / "s").rename(tmp_path / "moved")
    with pytest.raises(SurveyError, match=r"is not there any more; name the folder of the survey with --survey DIR"):
        export(run, orthophoto=tmp_path / "after.tif")
    export(run, options=ExportOptions(survey=str(tmp_path / "moved")), orthophoto=tmp_path / "after.tif")
    np.testing.assert_array_equal(
        picture(tmp_path / "before.tif", survey)[0], picture(tmp_path / "after.tif", survey)[0]
    )


def test_photographs_are_brought_to_one_exposure():
    points, uv = np.zeros((19_000, 3)), np.random.default_rng(1).uniform(1.0, 99.0, (19_000, 2))
    bed = SimpleNamespace(some=lambda _: points, pixels_of=lambda *_: uv)
    hides_nothing = SimpleNamespace(visible=lambda _, uv: uv)
    shown = [
        SimpleNamespace(camera=None, pixels=lambda grey=grey: Pixels(np.full((100, 100, 3), grey, np.uint8), None))
        for grey in (50, 200)
    ]
    factors = common_exposure(shown, [hides_nothing] * 2, bed, lambda: None)
    np.testing.assert_allclose(factors, np.repeat([[2.0], [0.5]], 3, axis=1))


@pytest.mark.parametrize("side_m", [-1.0, 0.0, float("nan")])
def test_a_side_of_cells_that_is_none_is_refused(tmp_path, side_m):
    run = run_of(stored_points(np.array([[E0, N0, LEVEL]]), CRS("EPSG:25832+5778")), tmp_path / "run")
    with pytest.raises(SurveyError, match=r"--resolution is .*, expected the side of a cell in metres"):
        export(run, options=ExportOptions(resolution_m=side_m), orthophoto=tmp_path / "o.tif")


def test_what_stands_behind_something_is_hidden(tmp_path):
    camera = look((-8.0, 0.0, 8.0), (0.0, 0.0, 0.0), focal=300.0, size=(400, 300), heading=np.pi / 2)
    cells = Grid(CRS("EPSG:25832+5778"), (E0 - 6.0, N0 + 3.0), (0.1, -0.1), 0.1, (60, 120))
    window = Window(0, 60, 0, 120)
    x, y = np.moveaxis(cells.middles(window) - [E0, N0], -1, 0)
    heights = LEVEL + np.where((np.abs(x) < 1.0) & (np.abs(y) < 1.0), 2.0, 0.0)
    flight = Flight(LocalFrame(CRS("EPSG:25832+5778"), (E0, N0, LEVEL)), None, (), None)
    bed = BedPlaces(flight, cells, lambda w: heights[w.slices], tmp_path / "places")
    buffer = HeightBuffer.of(camera, bed, cell_m=0.1, cell_px=300.0 * 0.1 / 11.3)
    ((_, points, uv),) = bed.seen_by(camera)
    seen = np.isfinite(buffer.visible(points, uv)[..., 0])
    # The ray over the far edge of the deck comes down to the bed at x = 4; the deck's own edges are blurred.
    shadow = (x > 1.4) & (x < 3.4) & (np.abs(y) < 0.7)
    assert not seen[shadow].any()
    clear = np.isfinite(uv[..., 0]) & ((x > 4.6) | (x < -1.4) | (np.abs(y) > 1.8) | (heights > LEVEL + 1.0))
    assert seen[clear].mean() > 0.99


def test_a_picture_does_not_depend_on_the_order_of_its_views(tmp_path):
    rng = np.random.default_rng(2)
    cells = Grid(CRS("EPSG:25832+5778"), (E0, N0), (0.1, -0.1), 0.1, (8, 9))
    window = Window(0, 8, 0, 9)
    greys = np.array([50.0, 100.0, 200.0])
    weights = np.where(rng.random((3, 8, 9)) < 0.6, -300.0 * rng.random((3, 8, 9)), np.nan)
    pictures = []
    for order in ([0, 1, 2], [2, 0, 1]):
        folder = tmp_path / f"{order[0]}"
        folder.mkdir()
        mosaic = Mosaic.empty(cells, folder)
        for number in order:
            mosaic.add(
                window, weights[number], np.where(np.isfinite(weights[number]), greys[number], np.nan)[..., None]
            )
        pictures.append(mosaic.rgba(window).astype(int))
    assert np.abs(pictures[0] - pictures[1]).max() <= 1
    unseen = np.isnan(weights).all(axis=0)
    assert unseen.any()
    np.testing.assert_array_equal(pictures[0][3] == 0, unseen)
    # Where one view is far better than the others, it alone counts.
    order = np.sort(np.nan_to_num(weights, nan=-1e9), axis=0)
    clear = ~unseen & (order[2] - order[1] > 12.0)
    best = greys[np.argmax(np.nan_to_num(weights, nan=-1e9), axis=0)]
    assert clear.sum() > 30
    np.testing.assert_array_equal(pictures[0][0][clear], best[clear])
