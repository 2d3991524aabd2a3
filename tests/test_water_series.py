"""Series of levels: readings that are no level, gaps, high and low waters, and the forms of services."""

from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from survey.errors import ConfigError
from survey.photos.exif import Exif
from survey.water.gauge_files import read_series, utc_of
from survey.water.series import levels_at
from survey.water.tides import tide_of_levels

NOON = datetime(2026, 6, 1, 12, tzinfo=UTC)
TIDE_H = 12.42


def tide(hours: np.ndarray, range_m: float = 3.0, mean_m: float = 3.75) -> np.ndarray:
    return mean_m - 0.5 * range_m * np.cos(2.0 * np.pi * np.asarray(hours) / TIDE_H)


def levels(path, *, at_h=0.0, zero=None, unit_m=1.0):
    """The levels at 21 photographs over seven minutes about a time."""
    moments = NOON.timestamp() + 3600.0 * at_h + np.linspace(-200.0, 200.0, 21)
    series = read_series(path, unit_m, zero)
    levels_m, std_m, _, findings = levels_at(series, moments)
    return levels_m.mean(), std_m, series.findings.warnings + findings.warnings


def written(path, hours, values, form="{:.3f}"):
    rows = (
        f"{(NOON + timedelta(hours=float(h))).isoformat()},{v if isinstance(v, str) else form.format(v)}"
        for h, v in zip(hours, values, strict=True)
    )
    path.write_text("time,level\n" + "\n".join(rows) + "\n")
    return path


BAD = ["-99.99", "-9999", "-999", "9999", "99.99", "0.000", "999.9", "-32768", "4.2", "-", ""]


@pytest.mark.parametrize("bad", BAD)
@pytest.mark.parametrize("step_h", [0.1, 0.25, 1.0])
@pytest.mark.parametrize("rise", [0.0, 3.0])
def test_a_reading_that_is_no_level_is_left_out_and_named(tmp_path, bad, step_h, rise):
    hours = step_h * np.arange(-18, 20)
    values = [f"{v:.3f}" for v in tide(hours, rise)]
    # At mid water, so that 4.2 m is beside the tide whatever its phase.
    spoilt = [bad if i == 18 else v for i, v in enumerate(values)]
    right, _, _ = levels(written(tmp_path / "right.csv", hours, values))
    level, _, warnings = levels(written(tmp_path / "gauge.csv", hours, spoilt))
    # A tide departs from a straight line over two intervals by its curvature.
    assert level == pytest.approx(right, abs=0.002 + 0.4 * rise / 3.0 * step_h**2)
    assert any("line 20" in text and "left out" in text for text in warnings)


@pytest.mark.parametrize("run", [1, 2, 3])
@pytest.mark.parametrize("size", [0.3, -0.8])
@pytest.mark.parametrize("seed", range(4))
def test_runs_are_left_out_and_noise_and_steps_stay(tmp_path, run, size, seed):
    rng, hours = np.random.default_rng(seed), 0.1 * np.arange(-60, 60)
    values = tide(hours, 1.0) + 0.01 * rng.normal(size=len(hours))
    assert not [text for text in levels(written(tmp_path / "a.csv", hours, values))[2] if "left out" in text]
    spoilt = values.copy()
    spoilt[58 : 58 + run] += size
    level, _, warnings = levels(written(tmp_path / "b.csv", hours, spoilt))
    assert level == pytest.approx(tide(0.0, 1.0), abs=0.05)
    assert any(f"{run} reading" in text and "line 60" in text for text in warnings)
    # A step of the same size is a lock or a weir.
    stepped = values + size * (hours > 1.0)
    assert not [text for text in levels(written(tmp_path / "c.csv", hours, stepped))[2] if "left out" in text]


@pytest.mark.parametrize("at", [0, -1])
@pytest.mark.parametrize("range_m", [0.0, 3.0])
@pytest.mark.parametrize("step_h", [0.1, 0.25])
def test_an_end_that_all_others_contradict_is_left_out(tmp_path, at, range_m, step_h):
    hours = step_h * np.arange(-15, 16)
    values = tide(hours, range_m)
    assert not levels(written(tmp_path / "a.csv", hours, values))[2]
    values[at] += 1.2
    assert any("left out" in text for text in levels(written(tmp_path / "b.csv", hours, values))[2])


@pytest.mark.parametrize("i", [0, 7, 20])
@pytest.mark.parametrize("bad", ["-99.99", "0", "4.2", "2.6", "30"])
def test_a_level_of_a_photograph_that_the_others_contradict_is_refused(tmp_path, i, bad):
    headers = {f"{k:02d}.jpg": Exif((64, 48), None, None, 1, "", None) for k in range(21)}
    rows = [f"{name},{bad if k == i else '3.0'}" for k, name in enumerate(headers)]
    (tmp_path / "levels.csv").write_text("\n".join(["image,level", *rows]))
    with pytest.raises(ConfigError, match=rf"levels.csv, line {i + 2}: the level {bad} is contradicted"):
        tide_of_levels(tmp_path / "levels.csv", headers)


def test_a_day_without_data_is_no_level_and_a_jump_faster_than_water_is_refused(tmp_path):
    hours = 0.1 * np.arange(-360, 60)
    values = ["-999" if h < -5.0 else f"{v:.3f}" for h, v in zip(hours, tide(hours), strict=True)]
    with pytest.raises(ConfigError, match="runs from"):
        levels(written(tmp_path / "a.csv", hours, values), at_h=-20.0)
    assert levels(written(tmp_path / "a.csv", hours, values))[0] == pytest.approx(tide(0.0), abs=0.01)
    jump = tide(hours) + 4.0 * (hours > 1.0)
    with pytest.raises(ConfigError, match=r"line 373: the level is .* faster than water rises"):
        levels(written(tmp_path / "b.csv", hours, jump))


@pytest.mark.parametrize("phase", np.arange(0.0, 12.0, 1.5).tolist())
@pytest.mark.parametrize("gap_h", [1.0, 2.0, 3.0, 5.0])
def test_the_std_of_a_gap_is_that_of_the_error_in_it(tmp_path, phase, gap_h):
    hours = 0.1 * np.arange(-90, 90)
    hours = hours[np.abs(hours) > 0.5 * gap_h]
    level, std, warnings = levels(written(tmp_path / "a.csv", hours, tide(hours + phase)))
    # The rms curvature of a tide is 0.7 of the largest, and that over hours a little less.
    assert abs(level - tide(phase)) < 1.8 * std + 0.002
    assert std < 0.25 * gap_h**2 * 0.257 * 1.5
    assert any("h apart" in text for text in warnings) == (std > 0.01)


@pytest.mark.parametrize("count", [3, 4, 5, 9])
@pytest.mark.parametrize("inequality", [0.0, 0.4])
@pytest.mark.parametrize("at", [-0.3, 0.1, 0.4])
def test_high_and_low_waters_are_joined_by_cosines(tmp_path, count, inequality, at):
    hours = 0.5 * TIDE_H * (np.arange(count) - count // 2)
    values = tide(hours) + inequality * np.cos(np.pi * hours / TIDE_H)
    level, std, warnings = levels(written(tmp_path / "a.csv", hours, values), at_h=at * TIDE_H / 2.0)
    right = tide(at * TIDE_H / 2.0) + inequality * np.cos(np.pi * at / 2.0)
    assert abs(level - right) < max(0.2 * inequality, 0.005)
    assert std == pytest.approx(0.05 * 3.0, rel=0.4 * inequality + 1e-3)
    assert not warnings


@pytest.mark.parametrize("hours", [(-6.0, 6.4), (-2.0, 2.0), (-0.8, 0.8)])
def test_two_readings_hours_apart_are_named(tmp_path, hours):
    _, std, warnings = levels(written(tmp_path / "a.csv", hours, tide(np.array(hours) + 2.0)))
    assert any("h apart" in text and "add readings during the flight" in text for text in warnings)
    assert std > 0.01 or hours[1] - hours[0] > 12.0


METRES = [f"{value:.3f}" for value in tide(0.1 * np.arange(-20, 20), 1.0)]
TIMES = [NOON + timedelta(minutes=6 * k) for k in range(-20, 20)]
RIGHT = float(tide(0.0, 1.0))


def scaled(factor, digits=3, comma=False):
    return [f"{float(value) * factor:.{digits}f}".replace(".", "," if comma else ".") for value in METRES]


def lines(head, form, values, shift_h=0.0, separator=","):
    rows = [form.format(t=t + timedelta(hours=shift_h), v=v, s=separator) for t, v in zip(TIMES, values, strict=True)]
    return "\n".join([head, *rows]) + "\n"


USGS = (
    "# retrieved\n#    TS   parameter   Description\n#    42   00060   Discharge, cubic feet per second\n#    43   {}\n"
)
USGS_HEAD = "site_no\tdatetime\ttz_cd\t42_00060\t42_00060_cd\t43_{0}\t43_{0}_cd\n15s\t20d\t6s\t14n\t10s\t14n\t10s"
USGS_ROW = "01\t{t:%Y-%m-%d %H:%M}\tEST\t120\tP\t{v}\tP"
NOAA_HEAD = '"Date","Time (GMT)","Predicted ({0})","Preliminary ({0})","Verified ({0})"'
FORMS = {
    "metres": ("time,level_m", "{t:%Y-%m-%dT%H:%M:%SZ},{v}", METRES, 0),
    "centimetres": ("time,level (cm)", "{t:%Y-%m-%d %H:%M}+00:00,{v}", scaled(100), 0),
    "feet": ("Time (UTC),Level [ft]", "{t:%Y-%m-%d %H:%M},{v}", scaled(1 / 0.3048, 4), 0),
    "decimal comma": ("timestamp;value_cm", "{t:%Y-%m-%dT%H:%M:%S}+02:00;{v}", scaled(100, 1, True), 2),
    "pegelonline": ("timestamp;value (cm)", "{t:%Y-%m-%dT%H:%M:%S}+02:00;{v}", scaled(100, 1), 2),
    "german": ("Datum;Uhrzeit (MEZ);Wasserstand (cm)", "{t:%d.%m.%Y};{t:%H:%M};{v}", scaled(100, 1, True), 1),
    "noaa export": (NOAA_HEAD.format("m"), '"{t:%Y/%m/%d}","{t:%H:%M}","9.9","8.8","{v}"', METRES, 0),
    "noaa feet": (NOAA_HEAD.format("ft"), '"{t:%Y/%m/%d}","{t:%H:%M}","9.9","{v}","-"', scaled(1 / 0.3048, 4), 0),
    "noaa api": ("Date Time (GMT), Water Level (m), Sigma, Quality", "{t:%Y-%m-%d %H:%M},{v},0.003,p", METRES, 0),
    "usgs rdb": (USGS.format("00065   Gage height, feet") + USGS_HEAD.format("00065"), USGS_ROW,
                 scaled(1 / 0.3048, 4), -5),
    "usgs metres": (USGS.format("99065   Gage height, meters") + USGS_HEAD.format("99065"), USGS_ROW, METRES, -5),
    "unit column": ("time,value,unit_of_measure", "{t:%Y-%m-%dT%H:%M:%S}-05:00,{v},ft", scaled(1 / 0.3048, 4), -5),
    "zone behind": ("time,level_m", "{t:%Y-%m-%d %H:%M} CEST,{v}", METRES, 2),
}  # fmt: skip


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("zero", [None, 100.0])
def test_forms_of_services_give_the_same_level(tmp_path, form, zero):
    head, row, values, shift = FORMS[form]
    path = tmp_path / "gauge.csv"
    path.write_text(lines(head, row, values, shift))
    level, _, warnings = levels(path, zero=zero)
    # Half a millimetre or centimetre of rounding, and the curvature of the tide.
    assert level == pytest.approx(RIGHT + (zero or 0.0), abs=0.002)
    is_own = form in ("metres", "centimetres", "feet", "zone behind")
    assert any("gauge_zero_m" in text for text in warnings) == (not is_own and zero is None)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.csv", lines("Date Time, Water Level, Sigma", "{t:%Y-%m-%d %H:%M}Z,{v},0.003", METRES), r"no unit .*\(cm\)"),
        ("a.csv", lines("timestamp;value", "{t:%Y-%m-%dT%H:%M}Z;{v}", METRES), "states no unit"),
        ("a.csv", lines("Date Time,Water Level (m)", "{t:%Y-%m-%d %H:%M},{v}", METRES), r"no time zone.*time \(UTC\)"),
        ("a.csv", lines("Time (LST/LDT),Level_m", "{t:%Y-%m-%d %H:%M},{v}", METRES), "column time|no time zone"),
        ("a.csv", lines("time,verified_m,verified_ft", "{t:%Y-%m-%d %H:%M}Z,{v},{v}", METRES), "2 columns of verified"),
        ("a.csv", lines("time,salinity", "{t:%Y-%m-%d %H:%M}Z,{v}", METRES), "no column level"),
        ("a.csv", lines("time,level_m", "{t:%m/%d/%Y %H:%M},{v}", METRES), "is not a time"),
        ("a.json", "[]", "fetch the same series as CSV"),
    ],
)
def test_what_a_file_does_not_state_is_asked_for(tmp_path, name, content, words):
    path = tmp_path / name
    path.write_text(content)
    with pytest.raises(ConfigError, match=words):
        levels(path)


def test_predictions_alone_are_named(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(lines("Date Time (GMT),Prediction (m)", "{t:%Y-%m-%d %H:%M},{v}", METRES))
    assert any("predictions and no observations" in text for text in levels(path)[2])


@pytest.mark.parametrize(
    ("text", "hour"),
    [
        ("2026-06-01T12:00:00Z", 12), ("2026-06-01 12:00+02:00", 10), ("2026/06/01 12:00 UTC", 12),
        ("01.06.2026 12:00 MESZ", 10), ("2026-06-01T12:00:00.000-04:00", 16), ("2026-05-31T24:00:00Z", 0),
        ("20260601T1200Z", 12),
    ],
)  # fmt: skip
def test_times(text, hour):
    assert utc_of(text, "a.csv, line 2") == datetime(2026, 6, 1, hour, tzinfo=UTC)
