"""The place of the sun against published values and what geometry says of any."""

import math
from datetime import UTC, datetime, timedelta, timezone

import pytest

from geo.sun import sun_at

# What Michalsky states for his formulas.
GOOD_TO_DEG = 0.01


def test_the_sun_stands_where_the_solar_position_algorithm_has_it():
    # I. Reda and A. Andreas (NREL/TP-560-34302, 2008), table A5.1: 39.742476 N, 105.1786 W; without refraction.
    time = datetime(2003, 10, 17, 12, 30, 30, tzinfo=timezone(timedelta(hours=-7)))
    sun = sun_at(time, 39.742476, -105.1786)
    assert math.degrees(sun.azimuth) == pytest.approx(194.340241, abs=GOOD_TO_DEG / math.cos(sun.elevation))
    assert math.degrees(sun.elevation) == pytest.approx(39.872046, abs=GOOD_TO_DEG)


@pytest.mark.parametrize("latitude", [-60.0, -10.0, 35.0, 70.0])
def test_noon_is_due_south_or_north_and_as_high_as_latitude_and_declination_say(latitude):
    day = datetime(2026, 6, 21, tzinfo=UTC)
    suns = [sun_at(day + timedelta(minutes=minute), latitude, 13.0) for minute in range(0, 1440)]
    noon = max(suns, key=lambda sun: sun.elevation)
    # 0.25 degrees a minute; the declination of the solstice is the obliquity of the ecliptic.
    assert math.degrees(noon.elevation) == pytest.approx(90.0 - abs(latitude - 23.44), abs=0.02)
    toward = 0.0 if latitude < 23.0 else 180.0
    away = (math.degrees(noon.azimuth) - toward + 180.0) % 360.0 - 180.0
    assert abs(away) < 1.0


def test_the_direction_is_of_length_one_and_points_up_by_day():
    sun = sun_at(datetime(2026, 6, 21, 12, tzinfo=UTC), 50.0, 0.0)
    assert math.hypot(*sun.direction) == pytest.approx(1.0)
    assert sun.direction[2] == pytest.approx(math.sin(sun.elevation))
    assert sun_at(datetime(2026, 6, 21, 0, tzinfo=UTC), 50.0, 0.0).elevation < 0.0


def test_a_time_without_its_zone_is_refused():
    with pytest.raises(ValueError, match="no time zone"):
        sun_at(datetime(2026, 6, 21, 12), 50.0, 0.0)
