"""Tables of points: any order of columns, any separator and name of the trade give the same points, or an error."""

from itertools import permutations, product

import numpy as np
import pytest

from survey.errors import ControlError, SurveyError
from survey.files.csv_table import read_table
from survey.files.foreign_text import finite_number
from survey.files.point_table import (
    PLACE,
    STDS,
    Units,
    accuracy_warnings,
    point_table,
    read_points,
    require_exact,
    several_heights,
    stated_units,
)
from survey.settings.config import parse_config

POINTS = [("p1", 676120.25, 5311480.5, 581.375), ("p2", 676121.0, 5311481.25, -3.5)]
NAMES = [
    ("name", "easting", "northing", "height"), ("Point", "E", "N", "Z"), ("id", "X", "Y", "Elevation"),
    ("P", "East", "North", "Height_m"), ("Label", "Longitude", "Latitude", "Altitude"), ("no", "x (m)", "y [m]", "alt"),
]  # fmt: skip


def written(path, header, rows, separator) -> None:
    lines = [separator.join(header), *(separator.join(str(cell) for cell in row) for row in rows)]
    path.write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize(("names", "separator"), list(product(NAMES, [",", ";", "\t", "  ", " "])))
def test_every_order_of_columns_gives_the_same_points(tmp_path, names, separator):
    if not separator.strip(" ") and any(" " in name for name in names):
        pytest.skip("a name with a space needs another separator")
    for order in permutations(range(4)):
        path = tmp_path / "points.csv"
        written(path, [names[i] for i in order], [[row[i] for i in order] for row in POINTS], separator)
        found = read_points(point_table(path, SurveyError))
        assert [tuple(row.number(name) for name in PLACE) for row in found] == [row[1:] for row in POINTS]
        assert [row.cells["name"] for row in found] == [row[0] for row in POINTS]


@pytest.mark.parametrize("header", ["lon,lat,E,N,H", "E,N,H,lon,lat", "latitude,longitude,easting,northing,height"])
def test_of_grid_coordinates_and_degrees_the_grid_counts(tmp_path, header):
    values = {"l": "9.5", "e": "676120.25", "n": "5311480.5", "h": "581"}
    path = tmp_path / "points.csv"
    written(path, header.split(","), [[values[name[0].lower()] for name in header.split(",")]], ",")
    (row,) = read_points(point_table(path, SurveyError))
    assert [row.number(name) for name in PLACE] == [676120.25, 5311480.5, 581.0]


@pytest.mark.parametrize("name", ["depth", "Depth (m)", "depth_m", "true_depth", "Depth [m]"])
@pytest.mark.parametrize("separator", [",", ";", "\t", " "])
def test_depths_count_down_from_the_level_of_the_water(tmp_path, name, separator):
    if separator == " " and " " in name:
        pytest.skip("a name with a space needs another separator")
    path = tmp_path / "points.csv"
    header = [name, "northing", "easting"]
    written(path, header, [["2.25", "20.5", "10.5"], ["-0.5", "21.5", "11.5"], ["1", "2", "3"]], separator)
    found = read_points(point_table(path, SurveyError), level=582.5)
    assert [row.number("height") for row in found] == [580.25, 583.0, 581.5]
    assert found[0].number("easting") == 10.5
    with pytest.raises(SurveyError, match=r"has depths, expected heights in crs: give --water-level, or subtract them"):
        read_points(point_table(path, SurveyError), give_level="give --water-level")
    written(path, header, [["-2.25", "20.5", "10.5"]], separator)
    with pytest.raises(SurveyError, match="numbers are negative"):
        read_points(point_table(path, SurveyError), level=582.5)


@pytest.mark.parametrize(
    ("header", "words"),
    [
        ("easting,northing,depth", "has depths, expected heights in crs"),
        ("easting,northing,ellipsoidal,orthometric", "has 2 columns of heights, ellipsoidal and orthometric"),
        ("easting,northing,height,elevation", "has 2 columns of heights, height and elevation"),
        ("easting,northing,height,depth_ft", "has 2 columns of heights, height and depth_ft"),
        ("easting,northing,height,water_depth", "has 2 columns of heights, height and water_depth"),
        ("easting,northing,true_depth,z_ft", "has 2 columns of heights, true_depth and z_ft"),
        ("easting,northing,up_there", "has no column height"),
        ("rechts,hoch,hoehe", "has no column easting, northing, height"),
    ],
)
def test_columns_that_are_not_known_are_no_points(tmp_path, header, words):
    path = tmp_path / "points.csv"
    path.write_text(f"{header}\n" + ",".join(["1.5"] * len(header.split(","))) + "\n")
    with pytest.raises(SurveyError, match=words):
        read_points(point_table(path, SurveyError), by_place=True)


@pytest.mark.parametrize(
    ("line", "is_taken"),
    [
        ("676120.25,5311480.5,581.375", True), ("676120.25 5311480.5 581.375", True),
        ("676120.25;5311480,5;581,375;0.02", True), ("1,5311480.5,676120.25,581.375,rod", False),
        ("1,5311480.5,676120.25,581.375", False), ("p1,676120.25,5311480.5,581.375", False),
    ],
)  # fmt: skip
def test_numbers_alone_are_taken_by_place_where_nothing_else_fits(tmp_path, line, is_taken):
    path = tmp_path / "points.csv"
    path.write_text(f"{line}\n{line}\n")
    if is_taken:
        (first, _) = read_points(point_table(path, SurveyError), by_place=True)
        assert first.number("northing") == pytest.approx(5311480.5)
    else:
        with pytest.raises(SurveyError, match="name the columns in a first line"):
            read_points(point_table(path, SurveyError), by_place=True)


@pytest.mark.parametrize("number", ["1e300", "-1e300", "1e13", "inf", "nan", "9" * 400])
def test_numbers_of_no_place_on_earth_are_refused_at_the_edge(tmp_path, number):
    path = tmp_path / "t.csv"
    path.write_text(f"a\n{number}\n")
    (row,) = read_table(path, ("a",))
    with pytest.raises(SurveyError, match="expected a finite number of at most 1e"):
        row.number("a")
    assert finite_number(float(number)) is None
    with pytest.raises(SurveyError, match="level_m is "):
        parse_config(f'crs = "EPSG:4979"\n[water]\nlevel_m = {"1" if number.isdigit() else ""}{number}\n')


def test_settings_that_are_nested_too_deep_are_refused():
    with pytest.raises(SurveyError, match=r"nested too deeply|not valid TOML"):
        parse_config("a = " + "[" * 5000 + "]" * 5000)


UNITS = {"ft": 0.3048, "m": 1.0, "cm": 0.01, "US survey foot": 1200.0 / 3937.0, "ftUS": 1200.0 / 3937.0, "Feet": 0.3048}


@pytest.mark.parametrize(("pattern", "word"), list(product(["{}_{}", "{} [{}]", "{}({})", "{} ({})"], ["Z", "height"])))
@pytest.mark.parametrize("ours_m", [1.0, 1200.0 / 3937.0])
def test_a_unit_in_the_name_of_a_column_counts(tmp_path, pattern, word, ours_m):
    path, places = tmp_path / "points.csv", {"x": 10.5, "y": 20.5}
    for unit, metres in UNITS.items():
        # A foot that does not say which of the two is that of the CRS.
        metres = ours_m if unit in ("ft", "Feet") and ours_m < 1.0 else metres
        header = [*places, pattern.format(word, unit), pattern.format("std", unit)]
        written(path, header, [[*places.values(), 30.25, 0.5]], ",")
        (row,) = read_points(point_table(path, SurveyError), optional=("std",), units=Units(ours_m, ours_m))
        assert row.number("height") * ours_m == pytest.approx(30.25 * metres, rel=1e-12)
        assert row.number("std") == pytest.approx(0.5 * UNITS[unit], rel=1e-12)
        written(path, [*places, pattern.format("Depth", unit)], [[*places.values(), 2.5]], ",")
        (row,) = read_points(point_table(path, SurveyError), level=100.0, units=Units(ours_m, ours_m))
        assert (100.0 - row.number("height")) * ours_m == pytest.approx(2.5 * metres, rel=1e-12)
        written(path, [pattern.format("X", unit), pattern.format("Y", unit), "z"], [[1, 2, 3]], ",")
        if abs(metres / ours_m - 1.0) > 1e-9:
            with pytest.raises(SurveyError, match="eastings and northings are in units of"):
                read_points(point_table(path, SurveyError), units=Units(ours_m, ours_m))


@pytest.mark.parametrize("mark", ["-9999", "-99999.0", "-32767", "1e6", "65535"])
@pytest.mark.parametrize("name", ["height", "height_ft", "depth", "depth_ft"])
def test_a_mark_of_no_data_is_no_height_and_no_depth(tmp_path, mark, name):
    path = tmp_path / "points.csv"
    written(path, [*PLACE[:2], name], [[1.0, 2.0, 3.0], [1.0, 2.0, mark], [1.0, 2.0, 3.0]], ",")
    with pytest.raises(SurveyError, match=rf"line 3: the {name[:5]}.* is .*, a no-data value; remove the line"):
        read_points(point_table(path, SurveyError), level=100.0, units=Units(1.0, 1.0))


@pytest.mark.parametrize("names", [("height", "depth_ft"), ("depth_ft", "height")])
def test_a_table_with_heights_has_the_unit_of_the_heights(tmp_path, names):
    path = tmp_path / "points.csv"
    written(path, [*PLACE[:2], *names], [[1.0, 2.0, 100.0, 6.0]], ",")
    assert stated_units(point_table(path, SurveyError)) == Units()


@pytest.mark.parametrize("header", ["x,y,easting,northing,height", "e,n,depth,depth_m", "e,n,n,h", "lon,x,y,z,e"])
def test_two_columns_of_one_meaning_are_refused(tmp_path, header):
    path = tmp_path / "points.csv"
    path.write_text(f"{header}\n" + ",".join(["1.5"] * len(header.split(","))) + "\n")
    with pytest.raises(SurveyError, match="may be the"):
        read_points(point_table(path, SurveyError), level=5.0)


@pytest.mark.parametrize("header", ["x_m,y_ft,z", "x,y_ft,z", "x_ft,y,z", "lon,x_m,y,z,lat"])
def test_two_units_in_plan_are_refused(tmp_path, header):
    path = tmp_path / "points.csv"
    path.write_text(f"{header}\n" + ",".join(["1.5"] * len(header.split(","))) + "\n")
    with pytest.raises(SurveyError, match="expected one unit: convert one, or name it in both"):
        read_points(point_table(path, SurveyError))


def test_degrees_beside_grid_coordinates_have_no_unit_in_plan(tmp_path):
    path = tmp_path / "points.csv"
    path.write_text("lon,x_m,y_m,z,lat\n1,2,3,4,5\n")
    assert stated_units(point_table(path, SurveyError)) == Units(plan_m=1.0)


@pytest.mark.parametrize("name", ["wse", "WSE (m)", "water_level", "Water_Surface_Elevation"])
@pytest.mark.parametrize("level", [None, 590.0])
def test_depths_count_down_from_the_level_that_the_table_has_beside_them(tmp_path, name, level):
    path, unit = tmp_path / "points.csv", " (m)" if "(m)" in name else ""
    written(path, ["x", "y", name, f"depth{unit}"], [[10.5, 20.5, 582.25, 1.5], [11.5, 20.5, 582.0, 1.5]], ",")
    factor = 1.0 / 0.3048 if unit else 1.0
    given = None if level is None else factor * level
    rows = read_points(point_table(path, SurveyError), level=given, units=Units(1.0, 0.3048))
    assert [row.number("height") for row in rows] == pytest.approx([580.75 * factor, 580.5 * factor])


def test_levels_and_depths_in_two_units_are_refused(tmp_path):
    path = tmp_path / "points.csv"
    written(path, ["x", "y", "wse_ft", "depth_m"], [[10.5, 20.5, 582.25, 1.5]], ",")
    with pytest.raises(SurveyError, match=r"depth is in units of 1 m and level in units of 0.3048 m"):
        read_points(point_table(path, SurveyError))


@pytest.mark.parametrize("mark", ["#", "//"])
def test_a_comment_names_columns_as_programs_write_it(tmp_path, mark):
    path = tmp_path / "points.xyz"
    path.write_text(f"{mark}X Y Z R G B\n10.5 20.5 30.25 1 2 3\n")
    (row,) = read_points(point_table(path, SurveyError), by_place=True)
    assert [row.number(name) for name in ("easting", "northing", "height")] == [10.5, 20.5, 30.25]


def test_levels_of_another_datum_than_that_of_the_water_are_refused_and_those_beside_heights_are_not_read(tmp_path):
    path = tmp_path / "points.csv"
    written(path, ["x", "y", "depth", "water_level"], [[1.0, 2.0, 0.5, 0.85]], ",")
    with pytest.raises(SurveyError, match=r"levels of the water about 0.85 .* the water stands at 584.2"):
        read_points(point_table(path, SurveyError), level=584.2)
    written(path, ["x", "y", "height", "wse", "water_level"], [[1.0, 2.0, 0.5, 0.85, 0.9]], ",")
    (row,) = read_points(point_table(path, SurveyError), level=584.2)
    assert row.number("height") == 0.5


@pytest.mark.parametrize("form", ["{:.6g}", "{:.5e}", "{}"])
def test_places_that_went_through_few_digits_are_refused(tmp_path, form):
    places = np.random.default_rng(1).uniform((676100.0, 5311400.0, 581.0), (676200.0, 5311500.0, 583.0), (30, 3))
    path = tmp_path / "points.csv"
    rows = [",".join((form.format(e), form.format(n), f"{h:.3f}")) for e, n, h in np.round(places, 3).tolist()]
    path.write_text("\n".join(["easting,northing,height", *rows]))
    points = read_points(point_table(path, ControlError))
    if form == "{}":
        require_exact(points, point_table(path, ControlError))
        return
    with pytest.raises(ControlError, match=r"numbers of \d digits"):
        require_exact(points, point_table(path, ControlError))


def test_a_standard_deviation_of_metres_asks_for_its_unit(tmp_path):
    path = tmp_path / "points.csv"
    path.write_text("easting,northing,height,sigma\n1,2,3,12\n")
    with pytest.raises(ControlError, match="std_mm"):
        read_points(point_table(path, ControlError), optional=("std",))
    path.write_text("easting,northing,height,sigma_mm\n1,2,3,12\n")
    assert read_points(point_table(path, ControlError), optional=("std",))[0].number("std") == pytest.approx(0.012)


@pytest.mark.parametrize(("unit_m", "apart", "is_named"), [(1.0, 0.05, False), (1.0, 0.3, True), (0.3048, 0.3, False)])
def test_two_heights_at_one_place_are_named(unit_m, apart, is_named):
    """Of one point measured twice heights may differ a little."""
    names = ["a", "b", "c", "d"]
    places = np.array([[1.0, 2.0, 5.0], [1.0, 2.5, 9.0], [1.0, 2.0, 5.0 + apart], [3.0, 2.0, 1.0]])
    found = several_heights(names, places, unit_m)
    assert found == ([f"a (5.00) and c ({5.0 + apart:.2f})"] if is_named else [])
    assert several_heights([], np.empty((0, 3))) == []


@pytest.mark.parametrize(
    ("names", "stds"),
    [
        (("Easting RMS", "Northing RMS", "Elevation RMS"), STDS), (("sde(m)", "sdn(m)", "sdu(m)"), STDS),
        (("std_e", "std_n", "std_h"), STDS), (("rms_e", "rms_n", "rms_u"), STDS),
        (("HRMS", "VRMS"), ("std_horizontal", "std_height")),
        (("Lateral RMS", "Vertical RMS"), ("std_horizontal", "std_height")),
        (("Accuracy",), ("std",)), (("RMS",), ("std",)), (("CQ 3D",), None), (("Hz Precision", "Vt Precision"), None),
        (("3D Quality",), None), (("CEP 95",), None), (("sigma position",), None), (("antenna height",), ()),
    ],
)  # fmt: skip
def test_a_column_that_states_an_accuracy_is_read_or_named(tmp_path, names, stds):
    """``stds`` is None where it is named, and empty where there is none."""
    path = tmp_path / "points.csv"
    written(path, ["name", *PLACE, *names], [["a", 1.0, 2.0, 3.0, *[0.25] * len(names)]], ",")
    (row,) = read_points(point_table(path, SurveyError), optional=("name", "std", "std_horizontal", *STDS))
    warnings = accuracy_warnings(point_table(path, SurveyError))
    assert bool(warnings) == (stds is None)
    assert all(name.lower() in text for text in warnings for name in names)
    assert all(row.number(name) == 0.25 for name in stds or ())


@pytest.mark.parametrize(
    ("word", "is_named"), [("FIX", 0), ("Fixed", 0), ("FLOAT", 1), ("single", 1), ("DGPS", 1), ("", 0)]
)
def test_a_solution_that_is_not_fixed_is_named(tmp_path, word, is_named):
    path = tmp_path / "points.csv"
    written(path, ["name", *PLACE, "Solution status"], [["a", 1.0, 2.0, 3.0, "FIX"], ["b", 1.0, 2.0, 3.0, word]], ",")
    warnings = accuracy_warnings(point_table(path, SurveyError))
    assert len(warnings) == is_named
    assert all(f"1 of 2 points are {word}" in text for text in warnings)
