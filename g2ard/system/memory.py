"""The memory that this process may use: the machine's, or less in a container."""

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

_UNKNOWN_BYTES = 8_000_000_000
"""Memory that is assumed where the system does not tell."""

_LIMITS = {"": ("", "unified"), "memory": ("memory",)}
"""Folders of `/sys/fs/cgroup` that may hold the groups of a controller, "" for all of version 2."""
_LIMIT_FILES = ("memory.max", "memory.high", "memory.limit_in_bytes")
"""Files of a group with a limit; "max" means none."""


def usable_memory(root: Path = Path("/")) -> int:
    """Return the bytes of the machine's memory, or of the smallest limit of this process's control groups.

    Args:
        root: where `proc` and `sys` are.
    """
    try:
        machine = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):
        machine = _UNKNOWN_BYTES
    return min([machine, *_find_group_limits(root)])


def _find_group_limits(root: Path) -> Iterator[int]:
    """Yield the memory limits of this process's control groups and of those above them."""
    with suppress(OSError, ValueError):
        for line in (root / "proc/self/cgroup").read_text(encoding="utf-8").splitlines():
            _, controllers, group = line.split(":", 2)
            for controller in controllers.split(","):
                for folder in _LIMITS.get(controller, ()):
                    yield from _read_limits(root / "sys/fs/cgroup" / folder, Path(group.strip("/")))


def _read_limits(mounted: Path, group: Path) -> Iterator[int]:
    # A container may name a group of its host, of which it sees only the uppermost folder.
    for above in (group, *group.parents):
        for name in _LIMIT_FILES:
            with suppress(OSError, ValueError):
                yield int((mounted / above / name).read_text(encoding="ascii"))
