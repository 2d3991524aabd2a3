"""What a run will take: as its parts do, against the memory of three surveys, and against what the machine has."""

import re
from dataclasses import replace

import numpy as np
import pytest
from small_survey import E0, N0, TOML, rows_of, small_survey, unposed

from fields.sweep.block import Overlap
from survey import machine
from survey.errors import SurveyError
from survey.folder.survey import load_survey
from survey.plan import workload as workload_module
from survey.plan.area import local_area
from survey.plan.check import check_survey
from survey.plan.choices import Choices
from survey.plan.plan import make_plan
from survey.plan.sweep_block import camera_of
from survey.plan.workload import Amounts, Workload, parts_s, room_warnings, workload_of, workload_of_images

GIGA = 1e9


@pytest.fixture(autouse=True)
def two_cores(monkeypatch):
    monkeypatch.setattr(machine, "num_cores", lambda: 2)


def warnings_of(sections) -> list[str]:
    (section,) = [section for section in sections if section.title == "Warnings"]
    return [text for _, text in section.rows]


AMOUNTS = Amounts(
    photographs_px=np.full(20, 4e5), view_px=np.full(20, 2e5), map_px=np.full(20, 2e5), points=3e5, poses="check",
    field="off",
)  # fmt: skip


def run_s(amounts: Amounts, num_cores: int) -> float:
    return sum(parts_s(amounts, num_cores).values())


def test_the_time_grows_with_all_that_there_is_to_do_and_more_cores_shorten_only_what_they_share():
    one = run_s(AMOUNTS, 1)
    for name in ("photographs_px", "map_px", "points"):
        more, most = (run_s(replace(AMOUNTS, **{name: n * getattr(AMOUNTS, name)}), 1) for n in (2.0, 3.0))
        assert more > one
        assert most - more == pytest.approx(more - one), name
    assert run_s(replace(AMOUNTS, field="solver"), 1) > one
    assert run_s(replace(AMOUNTS, field="mdw"), 1) > one
    assert run_s(replace(AMOUNTS, poses="fixed"), 1) < one < run_s(replace(AMOUNTS, poses="refine"), 1)
    halves = [run_s(AMOUNTS, cores) for cores in (1, 2, 4)]
    assert halves[0] - halves[1] == pytest.approx(2.0 * (halves[1] - halves[2]))
    assert halves[2] > 0.25 * one


@pytest.mark.parametrize("poses", ["check", "refine", "fixed"])
@pytest.mark.parametrize("field", ["off", "solver", "mdw"])
def test_the_parts_of_a_run_are_its_stages(poses, field):
    parts = parts_s(replace(AMOUNTS, poses=poses, field=field), 2)
    assert {"check": "Poses", "refine": "Adjustment"}.get(poses, "Sweep") in parts
    assert [name for name in ("Solver", "Field") if name in parts] == {
        "solver": ["Solver"],
        "mdw": ["Solver", "Field"],
    }.get(field, [])
    assert all(seconds >= 0.0 for seconds in parts.values())


def test_the_maps_are_those_of_the_views_that_cover_the_area_and_better_qualities_take_more(tmp_path):
    survey = load_survey(small_survey(tmp_path / "s"))
    found = []
    for quality in ("draft", "standard", "fine"):
        plan = replace(make_plan(survey, Choices(quality=quality, device="cpu")), device="llvm")
        found.append(workload_of(survey, plan))
        overlap = Overlap([camera_of(view, plan) for view in survey.views], survey.water, 0.0)
        assert found[-1].num_maps == len(overlap.cover(*plan.recipe.times_seen, local_area(survey)))
    assert found[0].seconds < found[1].seconds <= found[2].seconds
    assert found[0].num_maps <= found[1].num_maps <= found[2].num_maps <= len(survey.views)


@pytest.mark.parametrize(
    ("name", "quality", "memory_gb"),
    [("quick", "draft", 0.62), ("river", "draft", 1.08), ("wreck_water", "standard", 1.25)],
)
def test_the_memory_of_three_surveys_is_estimated_as_it_was_measured(data_dir, name, quality, memory_gb):
    survey = load_survey(data_dir / name)
    plan = replace(make_plan(survey, Choices(quality=quality, device="cpu")), device="llvm")
    assert workload_of(survey, plan).memory_bytes / GIGA == pytest.approx(memory_gb, rel=0.15)


def test_the_field_and_ground_without_bounds_take_more(tmp_path):
    bounds = f"[area]\nbounds = [{E0 - 1}, {N0 - 1}, {E0 + 1}, {N0 + 1}]\n"
    inside, everywhere = (load_survey(small_survey(tmp_path / t[:1], toml=TOML + t)) for t in (bounds, "# all\n"))
    plans = [replace(make_plan(inside, Choices(device="cpu", field=field)), device="llvm") for field in ("off", "mdw")]
    without, with_field = (workload_of(inside, plan) for plan in plans)
    assert with_field.seconds > without.seconds
    assert with_field.memory_bytes > without.memory_bytes
    assert workload_of(everywhere, plans[0]).disk_bytes > without.disk_bytes


def test_the_time_is_not_guessed_for_devices_that_were_not_measured(tmp_path):
    survey = load_survey(small_survey(tmp_path / "s"))
    workload = workload_of(survey, replace(make_plan(survey, Choices(device="cpu")), device="torch"))
    assert workload.seconds is None
    assert str(workload).endswith("no time was measured on such a device")


def test_the_estimate_in_words():
    workload = Workload(42, 40, 173.0, 2, 2_070_000_000, 870_000_000)
    words = (
        "about 3 minutes on 2 idle cores, about 2.1 GB of memory and 870 MB on the disk; "
        "40 of 42 views get a height map"
    )
    assert str(workload) == words
    assert str(replace(workload, seconds=31.0, num_cores=1)).startswith("about 40 seconds on 1 idle core, ")
    assert str(replace(workload, seconds=9000.0)).startswith("about 2.5 hours on 2 idle cores, ")


def test_too_little_disk_or_memory_is_a_warning_of_check(tmp_path, monkeypatch):
    folder = small_survey(tmp_path / "s")
    monkeypatch.setattr(machine, "free_memory_bytes", lambda: 300_000_000)
    sections = check_survey(folder, chosen=Choices(device="cpu"))
    assert "views get a height map" in rows_of(sections, "Plan")["workload"]
    assert "of memory, and 300 MB are free" in rows_of(sections, "Warnings")[""]
    monkeypatch.setattr(machine, "free_disk_bytes", lambda _folder: 1_000_000)
    (disk, memory) = warnings_of(check_survey(folder, chosen=Choices(device="cpu")))
    assert re.search(r"the run needs about \d+ MB in .*bathynerf, and 0 MB are free there", disk)
    assert "of memory, and 300 MB are free" in memory


def test_what_an_earlier_run_left_counts_as_room(tmp_path, monkeypatch):
    workload = Workload(3, 3, None, 2, 0, 2000)
    monkeypatch.setattr(machine, "free_disk_bytes", lambda _folder: 1500)
    with pytest.raises(SurveyError, match="are free there"):
        room_warnings(workload, tmp_path, refuses=True)
    (tmp_path / "stages" / "sweep").mkdir(parents=True)
    (tmp_path / "stages" / "sweep" / "maps.npz").write_bytes(bytes(600))
    assert room_warnings(workload, tmp_path, refuses=True) == []


def test_a_limit_of_the_process_below_what_the_run_needs_is_refused_before_kernels_crash(tmp_path, monkeypatch):
    workload = Workload(3, 3, None, 2, 600_000_000, 0)
    monkeypatch.setattr(machine, "allowed_memory_bytes", lambda: 5e8)
    with pytest.raises(SurveyError, match=r"needs about 600 MB of memory, and limits of this process .* leave 500 MB"):
        room_warnings(workload, tmp_path, refuses=True)
    # A bound may be far too high: only said.
    assert "limits of this process" in room_warnings(replace(workload, is_bound=True), tmp_path, refuses=True)[0]
    monkeypatch.setattr(machine, "allowed_memory_bytes", lambda: float("inf"))
    assert room_warnings(workload, tmp_path, refuses=True) == []


def test_more_views_than_can_be_chosen_from_make_it_a_bound(tmp_path, monkeypatch):
    survey = load_survey(small_survey(tmp_path / "s"))
    plan = replace(make_plan(survey, Choices(device="cpu")), device="llvm")
    chosen = workload_of(survey, plan)
    monkeypatch.setattr(workload_module, "_MOST_VIEWS", 3)
    bound = workload_of(survey, plan)
    assert (chosen.is_bound, bound.is_bound, bound.num_maps) == (False, True, 4)
    assert str(bound).startswith("at most ")
    assert "4 of 4 views get a height map" in str(bound)


def test_without_poses_the_estimate_is_a_bound_that_refuses_nothing(tmp_path, monkeypatch):
    workload = workload_of_images([(4000, 3000)] * 100, Choices())
    assert re.match(
        r"about \d+ minutes on 2 idle cores, \d+ minutes of them for structure from motion, ", str(workload)
    )
    assert "; at most " in str(workload)
    finer = workload_of_images([(4000, 3000)] * 100, Choices(quality="fine"))
    assert finer.disk_bytes > 4 * workload.disk_bytes - 2e9
    monkeypatch.setattr(machine, "free_disk_bytes", lambda _folder: 1_000_000)
    sections = check_survey(unposed(tmp_path / "s"), chosen=Choices(device="cpu"))
    assert "of them for structure from motion" in rows_of(sections, "Plan")["workload"]
    assert "the run needs at most" in rows_of(sections, "Warnings")[""]


def test_check_plans_for_the_image_scale_that_is_asked_for(tmp_path):
    half = Choices(device="cpu", image_scale=0.5)
    sections = check_survey(small_survey(tmp_path / "s"), chosen=half)
    assert rows_of(sections, "Plan")["image scale"].startswith("0.5: set by --image-scale")
    whole, smaller = (
        workload_of_images([(4000, 3000)] * 100, Choices(quality="fine", image_scale=each)) for each in (1.0, 0.5)
    )
    assert whole.disk_bytes > 3 * smaller.disk_bytes
