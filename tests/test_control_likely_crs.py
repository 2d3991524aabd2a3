"""Control in another CRS than crs: the message names the likely one, of the file or of the place; `init` takes it."""

import tomllib

import numpy as np
import pytest
from pyproj import CRS, Transformer
from small_survey import write_image

from geo.compatibility import likely_crs
from survey.control.points import GivenPoint
from survey.control.reading import require_near
from survey.display.quantities import distance_text
from survey.errors import ControlError
from survey.init.draft import draft
from survey.settings.tables import InitOptions

# Places with the national grid there, and the UTM zone with heights that a survey may have.
PLACES = [
    (10.9, 49.4, 31468, 25832), (16.3, 48.2, 31256, 25833), (7.5, 46.9, 2056, 25832), (-3.1, 55.9, 27700, 32630),
    (2.3, 48.8, 2154, 25831), (5.3, 52.1, 28992, 25831), (-122.3, 47.6, 2285, 32610), (139.7, 35.7, 6677, 32654),
    (172.6, -43.5, 2193, 32759), (19.0, 47.5, 23700, 32634),
]  # fmt: skip


def points_in(code: int, lon: float, lat: float, *, crs: CRS | None = None) -> list[GivenPoint]:
    east, north = Transformer.from_crs("EPSG:4326", f"EPSG:{code}", always_xy=True).transform(lon, lat)
    places = [(east + 20.0 * i, north - 15.0 * i, 3.0 + i) for i in range(3)]
    return [GivenPoint(f"p{i}", f"gcps.csv, line {i + 2}", place, crs) for i, place in enumerate(places)]


@pytest.mark.parametrize(("lon", "lat", "grid", "utm"), PLACES)
def test_control_in_the_grid_of_the_country_is_recognised_and_the_remedy_is_named(lon, lat, grid, utm):
    crs = CRS(f"EPSG:{utm}+5773")
    cameras = np.array([[*Transformer.from_crs("EPSG:4326", f"EPSG:{utm}", always_xy=True).transform(lon, lat), 40.0]])
    with pytest.raises(ControlError) as error:
        require_near(points_in(grid, lon, lat), cameras, crs)
    assert f"EPSG:{grid} (" in str(error.value)
    assert "if that is the CRS of the file, state it in its first line (# EPSG:" in str(error.value)
    assert '+5773" in survey.toml' in str(error.value)
    assert require_near(points_in(utm, lon, lat), cameras, crs) == []


def test_control_of_nowhere_and_of_a_stated_crs_have_other_remedies():
    crs, cameras = CRS("EPSG:25832+5773"), np.array([[589000.0, 5194000.0, 40.0]])
    nowhere = [GivenPoint("a", "gcps.csv, line 2", (1234567.0, 2345678.0, 3.0))]
    with pytest.raises(ControlError, match="or state the CRS of the file"):
        require_near(nowhere, cameras, crs)
    stated = GivenPoint("a", "g.csv, line 2", (1.0, 2.0, 3.0), CRS("EPSG:25833"))
    wrong = GivenPoint("a", "g.csv, line 2", (9e5, 5e6, 3.0), as_read=stated)
    with pytest.raises(ControlError, match="the file states ETRS89 / UTM zone 33N: correct that"):
        require_near([wrong], cameras, crs)


def test_the_datum_of_the_survey_comes_first():
    east, north = Transformer.from_crs("EPSG:4326", "EPSG:25832", always_xy=True).transform(10.9, 49.4)
    found = likely_crs(np.array([[east, north]]), (10.9, 49.4), 3000.0, CRS("EPSG:25833"))
    assert found[0].to_epsg() == 25832


@pytest.mark.parametrize("states", [True, False])
@pytest.mark.parametrize(("lon", "lat", "grid", "utm"), [PLACES[1], PLACES[2], PLACES[4]])
def test_init_takes_the_crs_of_the_control(tmp_path, lon, lat, grid, utm, states):
    to_small = Transformer.from_crs("EPSG:4326", "EPSG:25832", always_xy=True)
    for i in range(3):
        place = to_small.transform(lon + 1e-4 * i, lat)
        write_image(tmp_path / "images" / f"{i}.jpg", gps=(*place, 60.0))
    head = f"# EPSG:{grid}\n" if states else ""
    rows = [f"{point.name},{','.join(f'{v:.3f}' for v in point.place)}" for point in points_in(grid, lon, lat)]
    (tmp_path / "gcps.csv").write_text(head + "name,easting,northing,height\n" + "\n".join(rows) + "\n")
    settings = tomllib.loads(draft(tmp_path, InitOptions(level_m=2.0)))
    if states:
        assert settings["crs"].startswith(f"EPSG:{grid}+")
    else:
        code = int(settings["crs"].split("+")[0].removeprefix("EPSG:"))
        own, theirs = (Transformer.from_crs(f"EPSG:{c}", "EPSG:4326", always_xy=True) for c in (code, grid))
        place = points_in(grid, lon, lat)[0].place
        # Grids that differ by their datum put points within some hundred metres.
        assert np.abs(np.subtract(own.transform(*place[:2]), theirs.transform(*place[:2]))).max() < 0.03


@pytest.mark.parametrize(
    ("metres", "text"),
    [(0.04, "0.0 m"), (3.26, "3.3 m"), (149.6, "150 m"), (999.4, "999 m"), (999.6, "1 km"), (9_940.0, "9.9 km"),
     (9_960.0, "10 km"), (850_400.0, "850 km"), (5_194_736.0, "5,195 km"), (float("inf"), "an unknown distance")],
)  # fmt: skip
def test_distances_are_written_as_people_do(metres, text):
    assert distance_text(metres) == text
