"""What this machine has, asked of the machine that the tests run on."""

from __future__ import annotations

import os

from survey import machine
from survey.machine import GroupMemory


def test_free_memory_is_part_of_all_memory_and_limits_of_the_job_count(monkeypatch):
    monkeypatch.setattr(machine, "group_memories", list)
    assert 0 < machine.free_memory_bytes() <= machine.memory_bytes()
    job, machines = GroupMemory(100_000, 60_000), GroupMemory(70_000, 10_000)
    monkeypatch.setattr(machine, "group_memories", lambda: [job, machines])
    assert machine.memory_bytes() == 70_000
    assert machine.free_memory_bytes() == 40_000


def test_room_on_the_disk_is_that_of_the_nearest_folder_that_exists(tmp_path):
    assert machine.free_disk_bytes(tmp_path / "a" / "b" / "c") > 0
    assert 1 <= machine.num_cores() <= os.cpu_count()
