"""Memory limits of containers count, in both versions of control groups."""

import os
from pathlib import Path

import pytest

from g2ard.system.memory import usable_memory

MACHINE = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.parametrize(
    ("groups", "files", "limit"),
    [
        ("0::/\n", {"memory.max": "700000000\n"}, 700_000_000),
        ("0::/a/b\n", {"a/b/memory.max": "max\n", "a/memory.max": "600000000\n"}, 600_000_000),
        ("0::/a\n", {"a/memory.high": "400000000\n", "a/memory.max": "600000000\n"}, 400_000_000),
        (
            "4:memory:/docker/c0\n0::/\n",
            {"memory/docker/c0/memory.limit_in_bytes": "500000000\n"},
            500_000_000,
        ),
        ("4:memory:/of/the/host\n", {"memory/memory.limit_in_bytes": "500000000\n"}, 500_000_000),
        (
            "3:cpuset,memory:/x\n",
            {"memory/x/memory.limit_in_bytes": "9223372036854771712\n"},
            MACHINE,
        ),
        ("2:cpu:/x\n", {"cpu/x/memory.max": "1\n"}, MACHINE),
        ("not a group", {}, MACHINE),
    ],
)
def test_the_smallest_limit_counts(
    groups: str, files: dict[str, str], limit: int, tmp_path: Path
) -> None:
    (tmp_path / "proc/self").mkdir(parents=True)
    (tmp_path / "proc/self/cgroup").write_text(groups)
    for name, text in files.items():
        path = tmp_path / "sys/fs/cgroup" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    assert usable_memory(tmp_path) == limit


def test_without_groups_the_machine_counts(tmp_path: Path) -> None:
    assert usable_memory(tmp_path) == MACHINE
