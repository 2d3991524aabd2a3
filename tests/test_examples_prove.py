"""The example that holds a run against rods: the table of a report, and its sentences of refusal."""

import importlib.util
import json
from pathlib import Path

import pytest

EXAMPLE = Path(__file__).resolve().parent.parent / "examples" / "prove.py"
_spec = importlib.util.spec_from_file_location("prove", EXAMPLE)
prove = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(prove)


def rod(name: str, depth: float, difference: float | None, std: float | None = 0.02) -> dict:
    return {"name": name, "depth_m": depth, "difference_m": difference, "stated_m": None if difference is None else std}


def test_straight_rays_show_as_three_quarters_of_the_depth():
    lines = prove.table([rod(f"r{k}", k / 2, k / 8) for k in range(1, 5)])
    assert "depth found over depth measured: 0.750 +- 0.000" in lines[-1]
    assert "0 of 4 within 1.96" in lines[-2]


def test_rods_without_cloud_are_named_and_left_out():
    lines = prove.table([rod("a", 1.0, 0.01), rod("b", 2.0, -0.03), rod("c", 1.5, None)])
    assert any(line.startswith("c ") and "no point" in line for line in lines)
    assert "2 of 3 rods: mean -0.010 m, rms 0.022 m" in lines
    assert prove.table([rod("c", 1.5, None)])[-1] == "no rod lies under the cloud"


def test_a_run_is_read_and_one_without_check_points_is_refused(tmp_path, capsys):
    report = tmp_path / "report.json"
    report.write_text(json.dumps({"checkpoints": {"rows": [rod("a", 1.0, 0.01)]}}), encoding="utf-8")
    prove.main([str(tmp_path)])
    assert "1 of 1 rods" in capsys.readouterr().out
    report.write_text(json.dumps({"checkpoints": None}), encoding="utf-8")
    with pytest.raises(SystemExit, match="has no check points"):
        prove.main([str(tmp_path)])
    with pytest.raises(SystemExit, match="does not exist"):
        prove.main([str(tmp_path / "nothing")])
