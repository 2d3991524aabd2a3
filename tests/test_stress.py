"""The stress campaign: what it draws, how it makes a machine fail, and what it calls a lie."""

import math
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import stress as campaign
import stress_factors
import stress_faults
from method_records import Cost, Errors

from survey.simulate.drawn import DrawnScene, stage_drawing

TINY = DrawnScene.tiny(image_px=(60, 45), focal_px=105.0, objects=False)


def test_waves_move_from_photograph_to_photograph_and_their_truth_is_still_water():
    still = stage_drawing(TINY)
    wavy, calm = (stress_factors.with_waves(still, amplitude) for amplitude in (0.02, 1e-9))
    twice = replace(wavy, cameras=(still.cameras[0],) * 2)
    now, later = (twice.photograph(index).astype(float) for index in (0, 1))
    assert np.abs(now - later).mean() > 2.0
    assert np.abs(calm.photograph(0).astype(float) - still.photograph(0)).max() <= 1.0
    assert wavy.renderer.water is still.renderer.water


def test_a_repeated_pattern_is_the_same_a_period_further_and_nothing_lies_on_its_bed():
    scene = stress_factors.repeated(stage_drawing(DrawnScene.tiny()), 0.4)
    ground = scene.renderer.ground
    assert ground.solids == ()
    points = np.random.default_rng(1).uniform(-1.0, 1.0, (200, 3))
    here, there, between = (
        ground.materials[0].texture.albedo(points + np.array([step, 0.0, 0.0]), np.zeros(200, dtype=int))
        for step in (0.0, 0.4, 0.2)
    )
    np.testing.assert_allclose(here, there, atol=1e-3)
    assert np.abs(here - between).mean() > 0.02


def test_bare_sand_keeps_the_share_of_contrast_that_is_asked_for():
    staged = stage_drawing(TINY)
    whole, faint = (
        stress_factors.bare_sand(staged, share).renderer.ground.materials[0].texture.image for share in (1.0, 0.1)
    )
    assert faint.std(axis=(0, 1)) == pytest.approx(0.1 * whole.std(axis=(0, 1)), rel=1e-3)
    assert faint.mean() == pytest.approx(whole.mean(), rel=1e-4)


def test_rays_of_a_sideways_scene_reach_the_incidence_that_is_asked_for_and_no_more():
    scene = stress_factors.sideways(stress_factors.BASE, 60.0)
    width, height = scene.image_px
    edge = np.array([[0.5 * width, 0.0], [0.5 * width, height]])
    angles = [np.degrees(np.arccos(-camera.directions(edge)[:, 2])) for camera in scene.cameras()]
    assert np.max(angles) == pytest.approx(60.0, abs=0.01)
    assert np.min(angles) == pytest.approx(
        60.0 - 2.0 * math.degrees(math.atan(0.5 * height / scene.focal_px)), abs=0.01
    )


def test_every_factor_has_steps_and_its_own_words():
    factors = stress_factors.FACTORS
    assert len({factor.words for factor in factors.values()}) == len(factors)
    assert all(len(set(factor.values)) == len(factor.values) > 1 for factor in factors.values())
    small = stress_factors.many(stress_factors.BASE, 600.0)
    dense, base = (s.num_views / math.prod(s.size_m) for s in (small, stress_factors.BASE))
    assert dense == pytest.approx(base)


def _errors(coverage: float, median_m: float = 0.0) -> Errors:
    return Errors(1000, 0.0, 0.003, 0.004, {"0.05": 0.99, "0.1": 1.0, "0.2": 1.0}, coverage, median_m, 0.01)


def test_a_lie_is_a_cloud_that_passed_and_is_worse_than_it_says():
    outcome = campaign.Outcome("noise", 2.0, 0, 20.0, _errors(0.95))
    assert (outcome.verdict, outcome.is_lie) == ("true", False)
    small = replace(outcome, errors=_errors(0.8))
    assert (small.verdict, small.is_lie) == ("std too small", True)
    assert not replace(small, exit_code=3).is_lie
    shifted = replace(outcome, errors=_errors(0.95, median_m=0.03))
    assert (shifted.verdict, shifted.is_lie) == ("std_common too small", True)
    assert (replace(outcome, errors=_errors(0.995)).verdict, replace(outcome, errors=_errors(0.995)).is_lie) == (
        "std too large", False,
    )  # fmt: skip
    assert not replace(outcome, errors=None, exit_code=2).is_lie
    assert replace(outcome, errors=None, exit_code=-11).is_lie
    assert campaign.row_of(small).endswith("| 20 s | std too small |")


def test_a_fault_that_changes_the_bytes_or_crashes_is_a_lie(tmp_path):
    resumed = stress_faults.Resumed(2, "error: no room", tmp_path, Cost(1.0, 1.0, 1), is_same=True)
    endings = {
        resumed: False,
        replace(resumed, exit_code=-9): False,
        replace(resumed, exit_code=0): False,
        replace(resumed, is_same=False): True,
        replace(resumed, exit_code=-11): True,
        replace(resumed, exit_code=99): False,
    }
    for ending, is_lie in endings.items():
        outcome = campaign.Outcome("kill", 0.5, 0, 1.0, _errors(0.95), ending=ending.verdict)
        assert outcome.is_lie is is_lie, ending.verdict


def test_outcomes_are_read_as_they_were_written_and_drawn(tmp_path):
    outcome = campaign.Outcome("noise", 2.0, 0, 20.0, _errors(0.95))
    entry = {name: getattr(outcome, name) for name in outcome.__dataclass_fields__}
    entry |= {"errors": dict(vars(outcome.errors)), "verdict": outcome.verdict}
    assert campaign.Outcome.from_json(entry) == outcome
    refused = replace(outcome, value=5.0, errors=None, exit_code=2, words="error: it cannot")
    campaign.draw(tmp_path / "stress.png", [outcome, refused])
    assert (tmp_path / "stress.png").read_bytes().startswith(b"\x89PNG")
    assert "refused: it cannot" in campaign.table([outcome, refused])


@pytest.mark.skipif(sys.platform != "linux", reason="limits and namespaces are those of Linux")
def test_faults_take_memory_and_room_away_and_keep_what_was_on_the_disk(tmp_path):
    take = [sys.executable, "-c", "bytearray(400_000_000)"]
    under = stress_faults.little_memory(0.2, tmp_path, 1.0)
    assert subprocess.run([*under, *take], capture_output=True, check=False).returncode == 1
    assert subprocess.run([*stress_faults.little_memory(2.0, tmp_path, 1.0), *take], check=False).returncode == 0
    if shutil.which("timeout"):
        under = stress_faults.killed(0.5, tmp_path, 0.4)
        code = subprocess.run([*under, "sleep", "30"], check=False).returncode
        assert stress_faults.Resumed(code, "", tmp_path, Cost(1.0, 1.0, 1), is_same=True).is_killed
    place = tmp_path / "disk"
    place.mkdir()
    write = f'printf kept > "{place}/first"; head -c 3000000 /dev/zero > "{place}/large"'
    found = subprocess.run([*stress_faults.little_disk(1.0, place, 1.0), "sh", "-c", write],
                           capture_output=True, text=True, check=False)  # fmt: skip
    if found.returncode == stress_faults.NOT_POSSIBLE or found.stderr.startswith("unshare:"):
        pytest.skip("this system lets no user mount a file system")
    assert found.returncode != 0
    assert (tmp_path / "disk.kept" / "first").read_text() == "kept"
    assert list(place.iterdir()) == []
