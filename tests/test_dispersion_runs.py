"""A survey drawn in three colours that bend differently: with the wavelength of its index, its bed is where it is."""

import json
from pathlib import Path

import numpy as np
import pytest
from drawn_runs import DrawnRun, drawn, process_quietly

from evaluation import vertical_difference
from survey.simulate.drawn import DrawnScene

DEPTH_M = 6.0
# Pixels of 4.1 cm of the bed: a point is known to a fifth of it, the median of thousands to a millimetre.
DEEP = {"size_m": (5.0, 4.0), "depth_m": DEPTH_M, "image_px": (240, 180), "focal_px": 500.0, "flying_m": 16.0}
BIAS_M = 2e-3
# From 589.3 nm to the light that is matched at this depth, by Quan and Fry: 14 to 16 mm of 10 m, as much is red.
LEAST_SHIFT_M, MOST_SHIFT_M = 1.3e-3 * DEPTH_M, 1.7e-3 * DEPTH_M


@pytest.fixture(scope="module")
def places(tmp_path_factory) -> tuple[Path, Path]:
    """The survey as it is drawn, and without a word on the wavelength of its index."""
    told, untold = (tmp_path_factory.mktemp(name) / "survey" for name in ("told", "untold"))
    for folder in (told, untold):
        drawn(folder, temperature_c=15.0, objects=False, **DEEP)
    lines = (untold / "survey.toml").read_text(encoding="utf-8").splitlines()
    kept = [line for line in lines if not line.startswith("index_wavelength_nm")]
    assert len(kept) == len(lines) - 1
    (untold / "survey.toml").write_text("\n".join(kept), encoding="utf-8")
    return told, untold


def _median_error(folder: Path) -> float:
    """Of the heights of the cloud [m]."""
    assert process_quietly(folder) == 0
    run = DrawnRun(DrawnScene(), folder)
    frame, mesh = run.survey.frame, run.reference
    points, vertices = frame.local_from_crs(run.cloud.points), frame.local_from_crs(mesh.vertices)
    return float(np.nanmedian(vertical_difference(points, vertices, mesh.faces)))


# The mixture of colours is tested in tests/test_matched_light.py.
@pytest.mark.slow
def test_the_bed_is_where_it_is_with_the_wavelength_of_the_index_and_too_high_without(places):
    told, untold = places
    with_it, without = _median_error(told), _median_error(untold)
    assert abs(with_it) < BIAS_M
    assert LEAST_SHIFT_M < without - with_it < MOST_SHIFT_M
    light = json.loads((told / "bathynerf" / "report.json").read_text(encoding="utf-8"))["water"]["light"]
    # Of the red of a lake 6 m deep, exp(-0.17 * 12) of green's exp(-0.042 * 12) is left: a fifth.
    assert light["is_measured"]
    assert light["red"] < 0.25 < 0.6 < light["green"]
    assert light["red"] + light["green"] + light["blue"] == pytest.approx(1.0)
    assert light["over_sodium_m"] == pytest.approx(without - with_it, rel=0.2)
