"""What this machine has, asked of the machine that the tests run on."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys

import psutil
import pytest

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


def test_limits_of_the_process_leave_less_memory_than_they_say_where_they_count_what_is_only_mapped(monkeypatch):
    limits = {"DATA": float("inf"), "AS": float("inf")}
    monkeypatch.setattr(machine, "limit_bytes", limits.get)
    assert machine.allowed_memory_bytes() == float("inf")
    limits["AS"] = 4e9
    assert 0.5e9 < machine.allowed_memory_bytes() < 4e9
    limits["DATA"] = 3e8
    assert machine.allowed_memory_bytes() == 3e8


@pytest.mark.skipif(not hasattr(psutil, "RLIMIT_AS"), reason="a system without limits of address space")
def test_limits_are_those_of_ulimit():
    assert machine.limit_bytes("AS") == float("inf")
    code = "from survey import machine; print(machine.limit_bytes('DATA'))"
    command = f"ulimit -d 700000; {shlex.join([sys.executable, '-c', code])}"
    ended = subprocess.run(["sh", "-c", command], capture_output=True, text=True, check=True)
    assert ended.stdout == "716800000.0\n"
