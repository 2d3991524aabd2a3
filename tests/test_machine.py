"""What this machine has, asked of the machine that the tests run on."""

from __future__ import annotations

import os
import resource
from types import SimpleNamespace

import pytest

from survey import machine


def test_free_memory_is_part_of_all_memory_and_a_limit_of_the_container_counts(tmp_path, monkeypatch):
    monkeypatch.setattr(machine, "_CGROUP", ())
    assert 0 < machine.free_memory_bytes() <= machine.memory_bytes()
    limit = tmp_path / "memory.max"
    monkeypatch.setattr(machine, "_CGROUP", (tmp_path / "none", limit))
    everything = machine.memory_bytes()
    limit.write_text("max\n")
    assert machine.memory_bytes() == everything
    limit.write_text("100000\n")
    assert machine.memory_bytes() == machine.free_memory_bytes() == 100000


def test_where_the_system_does_not_tell_all_memory_counts_as_free(tmp_path, monkeypatch):
    monkeypatch.setattr(machine, "_MEMINFO", tmp_path / "none")
    assert machine.free_memory_bytes() == machine.memory_bytes()


def test_room_on_the_disk_is_that_of_the_nearest_folder_that_exists(tmp_path):
    assert machine.free_disk_bytes(tmp_path / "a" / "b" / "c") > 0
    assert 1 <= machine.num_cores() <= os.cpu_count()


def test_the_age_of_the_process_rises_and_is_known_where_the_system_does_not_tell(tmp_path, monkeypatch):
    first = machine.process_age_s()
    assert 0.0 <= first <= machine.process_age_s()
    monkeypatch.setattr(machine, "_STAT", tmp_path / "none")
    assert machine.process_age_s() > 0.0


def test_limits_of_the_process_leave_less_memory_than_they_say_where_they_count_what_is_only_mapped(monkeypatch):
    limits = {resource.RLIMIT_DATA: resource.RLIM_INFINITY, resource.RLIMIT_AS: resource.RLIM_INFINITY}
    monkeypatch.setattr(machine.resource, "getrlimit", lambda kind: (limits[kind], limits[kind]))
    assert machine.allowed_memory_bytes() == float("inf")
    limits[resource.RLIMIT_AS] = 4_000_000_000
    assert 0.5e9 < machine.allowed_memory_bytes() < 4e9
    limits[resource.RLIMIT_DATA] = 300_000_000
    assert machine.allowed_memory_bytes() == 3e8


def test_a_machine_with_twice_the_work_is_twice_as_slow(monkeypatch):
    seconds = iter([0.0, 1.0, 5.0, 7.0])
    monkeypatch.setattr(machine, "time", SimpleNamespace(monotonic=lambda: next(seconds)))
    assert machine.slowness() == pytest.approx(0.5 * machine.slowness())
