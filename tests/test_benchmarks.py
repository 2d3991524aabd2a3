"""Every benchmark runs at its smallest size."""

import os
import runpy
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
BENCHMARKS = ROOT / "benchmarks"
DATA = os.environ.get("BATHYNERF_DATA")
# Options of each: {survey} is a drawn survey with its truth, {run} a run of it, {work} an empty folder.
SMALLEST = {
    "bench_adjust": "--coverage 1",
    "bench_block_size": "40",
    "bench_bound": "--scenes sand -o {work}",
    "bench_compare": "--points 1000 --triangles 500",
    "bench_conditions": "nothing -o {work} --seeds 1-1 --quality draft",
    "bench_error_time": "{work} --models vm --seconds 0.2",
    "bench_field": "{work} --objects ship --models vm --steps 5 --scale 0.05 --cells 16 --rays 64 --samples 8",
    "bench_infrared": "-o {work} --seeds 1 --views 6",
    "bench_mesh": "{run} {survey} --methods delaunay",
    "bench_methods": "{survey} --methods sweep --qualities draft -o {work}",
    "bench_nerfstudio": "{work} --objects ship --models vm --seconds 0.1 --scale 0.05 --cells 16 --rays 64 --samples 8",
    "bench_optics": "--plain",
    "bench_peers": "--only adjustment c2m laz --photographs 6 --points 1000 --runs 1",
    "bench_random": "--seeds 102-102 -o {work} --quality draft",
    "bench_reach": "{work} --kilometre",
    "bench_solver": "{survey} --ways solver -o {work}",
    "bench_survey_field": "{survey} -o {work} --rows sweep --reference {survey}/truth/reference.ply "
    "--visible {survey}/truth/visible.ply",
    "bench_sweep": "{survey} --quality draft --tables trust steps views once -o {work}",
    "bench_switches": "-o {work} --only none 'density 0.002' 'density as printed 0.002' --steps 2 --seeds 1",
    "bench_tides": "-o {work} --levels -2.4",
    "bench_tiles": "{survey} --tiles 2 -o {work}/tiles.json",
    "bench_true_colour": "{work} --seeds 1",
    "draw_gallery": "dispersion -o {work}",
    "draw_survey": "{run} -o {work}",
    "field_surveys": "{work} --seeds 12-12",
    "given_alarms": "{work} --seeds 0-0",
    "soak_inputs": "--seconds 1 --out {work}",
    "soak_kills": "--kills 1 --out {work}",
    "stress": "index -o {work} --quality draft",
    "table4": "--chains sweep hash --steps 2 --samples 10000 -o {work}",
}
WITH_DATA = {
    "bench_picture_bound": "{data}/quick --every 20",
    "bench_real": "streams -o {work}",
    "bench_real_points": "{data} --every 50",
}
# Why the others are not run.
TOO_LARGE = {
    "bench_drawn": "its smallest part takes an hour; tests/test_bench_parts.py has its table and its picture",
    "draw_held_out": "it draws what bench_survey_field rendered of data/wreck_water",
    "tables": "it writes tables of pages, which tests/test_bench_parts.py compares",
}
PROGRAMS = sorted(path.stem for path in BENCHMARKS.glob("*.py") if "__main__" in path.read_text(encoding="utf-8"))


def test_every_benchmark_is_run_or_has_a_reason():
    assert sorted([*SMALLEST, *WITH_DATA, *TOO_LARGE]) == PROGRAMS


@pytest.mark.parametrize("name", sorted({*PROGRAMS} - {"tables"}))
def test_a_benchmark_says_how_it_is_run(name, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", [f"{name}.py", "--help"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(BENCHMARKS / f"{name}.py"), run_name="__main__")
    assert ended.value.code == 0
    assert "usage:" in capsys.readouterr().out


def command(name: str, options: str, **places: Path | str) -> subprocess.CompletedProcess:
    words = shlex.split(options.format(**places))
    return subprocess.run(
        [sys.executable, str(BENCHMARKS / f"{name}.py"), *words], capture_output=True, text=True, check=False, cwd=ROOT
    )


@pytest.fixture(scope="module")
def places(tmp_path_factory) -> dict[str, Path]:
    """A drawn survey and a run of it."""
    from survey.progress import Progress
    from survey.run.process import process
    from survey.simulate.drawn import DrawnScene, draw_survey

    folder = tmp_path_factory.mktemp("drawn")
    draw_survey(folder / "survey", DrawnScene.tiny())
    with Progress(verbosity=-1):
        process(folder / "survey", folder / "run", quality="draft", field="off")
    return {"survey": folder / "survey", "run": folder / "run"}


@pytest.mark.slow
@pytest.mark.parametrize("name", SMALLEST)
def test_a_benchmark_runs_at_its_smallest_size(name, places, tmp_path):
    done = command(name, SMALLEST[name], work=tmp_path, **places)
    assert done.returncode == 0, done.stderr[-2000:]


@pytest.mark.slow
@pytest.mark.skipif(DATA is None, reason="set BATHYNERF_DATA to the survey data")
@pytest.mark.parametrize("name", WITH_DATA)
def test_a_benchmark_of_the_survey_data_runs_at_its_smallest_size(name, tmp_path):
    done = command(name, WITH_DATA[name], work=tmp_path, data=str(DATA))
    assert done.returncode == 0, done.stderr[-2000:]
