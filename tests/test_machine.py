"""What this machine has, asked of the machine that the tests run on."""

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


@pytest.mark.skipif(not hasattr(psutil, "RLIMIT_AS"), reason="a system without limits of processes")
@pytest.mark.parametrize(("limit", "free", "said"), [
    ("-d 700000", 716_800_000, None),
    ("-d 300000", 307_200_000, "limited to 0.3 GB (ulimit -d), expected at least 0.4 GB; raise the limit"),
    ("-v 2000000", 0, "limited to 2.0 GB (ulimit -v), expected at least 3 GB; raise the limit"),
])  # fmt: skip
def test_limits_of_the_process_leave_memory_or_are_named(limit, free, said):
    code = "from survey import machine; print(machine.free_memory_bytes(), machine.memory_shortage())"
    command = f"ulimit {limit}; {shlex.join([sys.executable, '-c', code])}"
    ended = subprocess.run(["sh", "-c", command], capture_output=True, text=True, check=True).stdout
    assert ended == f"{free} {said and 'the memory of this process is ' + said}\n"
