"""Memory limits of control groups, on made-up trees of /proc and /sys/fs/cgroup."""

from __future__ import annotations

from pathlib import Path

import pytest

from survey.machine import GroupMemory, group_memories

UNLIMITED_V1 = 9223372036854771712


@pytest.fixture
def tree(tmp_path):
    return Tree(tmp_path)


class Tree:
    """A process, and the control groups that it is in."""

    def __init__(self, path: Path):
        self.process, self.groups, self._mounted = path / "proc", path / "sys fs" / "cgroup", []
        self.process.mkdir()

    def place(self, *lines: str) -> None:
        (self.process / "cgroup").write_text("\n".join(lines) + "\n")

    def mount(self, kind: str, name: str, root: str = "/", options: str = "rw") -> None:
        folder = str(self.groups / name).replace(" ", "\\040")
        self._mounted.append(f"31 23 0:28 {root} {folder} rw,relatime shared:9 - {kind} {kind} {options}")
        (self.process / "mountinfo").write_text("22 1 8:1 / / rw - ext4 /dev/sda1 rw\n" + "\n".join(self._mounted))

    def group(self, path: str, **files: int | str) -> None:
        folder = self.groups / path
        folder.mkdir(parents=True, exist_ok=True)
        for name, value in files.items():
            (folder / name.replace("__", ".")).write_text(f"{value}\n")


def test_version_2_takes_the_limits_of_all_groups_on_the_way_up(tree):
    tree.place("0::/system.slice/slurmd/job_7/step_0/user/task_0")
    tree.mount("cgroup2", "unified")
    job = "unified/system.slice/slurmd/job_7"
    tree.group(f"{job}/step_0/user/task_0", memory__max="max", memory__high="max", memory__current=1)
    tree.group(f"{job}/step_0", memory__max=8000, memory__high="max", memory__current=3000)
    stat = "anon 2000\nfile 900\ninactive_file 700"
    tree.group(job, memory__max=9000, memory__high=7000, memory__current=3500, memory__stat=stat)
    # The root has no limits and no files of them.
    assert group_memories(tree.process) == [GroupMemory(8000, 3000), GroupMemory(7000, 2800)]
    assert min(group.free for group in group_memories(tree.process)) == 4200


def test_version_1_is_read_where_the_memory_hierarchy_is_mounted(tree):
    tree.place("9:name=systemd:/", "4:cpu,memory:/slurm/uid_5/job_7", "1:cpuset:/slurm", "0::/")
    tree.mount("cgroup", "cpuset", options="rw,cpuset")
    tree.mount("cgroup", "memory", options="rw,cpu,memory")
    tree.mount("cgroup2", "unified")
    tree.group("memory", memory__limit_in_bytes=UNLIMITED_V1, memory__usage_in_bytes=90_000)
    tree.group("cpuset/slurm", memory__limit_in_bytes=1)
    tree.group("memory/slurm/uid_5", memory__limit_in_bytes=6000, memory__usage_in_bytes=5000)
    tree.group("memory/slurm/uid_5/job_7", memory__limit_in_bytes=4000, memory__stat="total_inactive_file 10")
    found = group_memories(tree.process)
    assert found == [GroupMemory(4000, 0), GroupMemory(6000, 5000), GroupMemory(UNLIMITED_V1, 90_000)]


@pytest.mark.parametrize("path", ["/docker/3f2a", "/docker/3f2a/inner", "/elsewhere", "/../other"])
def test_a_container_sees_its_group_as_the_mount(tree, path):
    tree.place(f"4:memory:{path}")
    tree.mount("cgroup", "memory", root="/docker/3f2a", options="rw,memory")
    tree.group("memory", memory__limit_in_bytes=2000, memory__usage_in_bytes=500)
    tree.group("memory/inner", memory__limit_in_bytes=1000)
    inner = [GroupMemory(1000, 0)] if path.endswith("inner") else []
    assert group_memories(tree.process) == [*inner, GroupMemory(2000, 500)]


def test_without_groups_there_is_no_limit(tree):
    assert group_memories(tree.process) == []
    tree.place("0::/")
    tree.mount("cgroup2", "unified")
    assert group_memories(tree.process) == []
