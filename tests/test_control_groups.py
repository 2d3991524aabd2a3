"""Memory limits of control groups, on made-up trees of /proc and /sys/fs/cgroup."""

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
        self.process, self.groups = path / "cgroup", path / "sys fs" / "cgroup"

    def place(self, *lines: str) -> None:
        self.process.write_text("\n".join(lines) + "\n")

    def memories(self) -> list[GroupMemory]:
        return group_memories(self.process, self.groups)

    def group(self, path: str, **files: int | str) -> None:
        folder = self.groups / path
        folder.mkdir(parents=True, exist_ok=True)
        for name, value in files.items():
            (folder / name.replace("__", ".")).write_text(f"{value}\n")


def test_version_2_takes_the_limits_of_all_groups_on_the_way_up(tree):
    tree.place("0::/system.slice/slurmd/job_7/step_0/user/task_0")
    job = "system.slice/slurmd/job_7"
    tree.group(f"{job}/step_0/user/task_0", memory__max="max", memory__high="max", memory__current=1)
    tree.group(f"{job}/step_0", memory__max=8000, memory__high="max", memory__current=3000)
    stat = "anon 2000\nfile 900\ninactive_file 700"
    tree.group(job, memory__max=9000, memory__high=7000, memory__current=3500, memory__stat=stat)
    # The root has no limits and no files of them.
    assert tree.memories() == [GroupMemory(8000, 3000), GroupMemory(7000, 2800)]
    assert min(group.free for group in tree.memories()) == 4200


def test_version_1_is_read_where_the_memory_hierarchy_is_mounted(tree):
    tree.place("9:name=systemd:/", "4:cpu,memory:/slurm/uid_5/job_7", "1:cpuset:/slurm", "0::/")
    tree.group("memory", memory__limit_in_bytes=UNLIMITED_V1, memory__usage_in_bytes=90_000)
    tree.group("cpuset/slurm", memory__limit_in_bytes=1)
    tree.group("memory/slurm/uid_5", memory__limit_in_bytes=6000, memory__usage_in_bytes=5000)
    tree.group("memory/slurm/uid_5/job_7", memory__limit_in_bytes=4000, memory__stat="total_inactive_file 10")
    assert tree.memories() == [GroupMemory(4000, 0), GroupMemory(6000, 5000), GroupMemory(UNLIMITED_V1, 90_000)]


@pytest.mark.parametrize("path", ["/docker/3f2a", "/", "/../other"])
def test_a_container_sees_its_group_as_the_mount(tree, path):
    tree.place(f"4:memory:{path}")
    tree.group("memory", memory__limit_in_bytes=2000, memory__usage_in_bytes=500)
    assert tree.memories() == [GroupMemory(2000, 500)]


def test_without_groups_there_is_no_limit(tree):
    assert tree.memories() == []
    tree.place("0::/")
    assert tree.memories() == []
