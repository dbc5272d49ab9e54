"""Which device the kernels run on. It changes how long they take, and nothing else."""

from __future__ import annotations

import os
from dataclasses import dataclass

from g2ard import _core
from g2ard.errors import InputError


@dataclass(frozen=True)
class Adapter:
    """A device that a graphics driver offers.

    Args:
        name: the driver's name for it.
        kind: discrete, integrated, virtual, cpu (software) or other.
        backend: vulkan, metal or dx12.
        driver: its name and version.
        max_buffer: bytes of its largest buffer.
        max_binding: bytes that one kernel sees of a buffer; larger scenes go in pieces.
        max_workgroup_memory: bytes that the threads of a workgroup share.
        timestamps: whether it keeps time.
    """

    name: str
    kind: str
    backend: str
    driver: str
    max_buffer: int
    max_binding: int
    max_workgroup_memory: int
    timestamps: bool


@dataclass(frozen=True)
class State:
    """What became of the choice.

    Args:
        adapter: the name of the adapter in use; None on the CPU, and before a kernel asks for one.
        served: how many kernels it has run.
        uploaded_bytes: what it was sent for them; 0 again once it is left.
        seconds: on the device by kernel, where `use` was told to keep time.
    """

    adapter: str | None
    served: int
    uploaded_bytes: int
    seconds: dict[str, float]


def adapters() -> list[Adapter] | None:
    """Every adapter, the one to use first; None where this build has no GPU kernels."""
    _hush()
    found = _core.adapters()
    return None if found is None else [Adapter(**row) for row in found]


def use(device: str, *, timed: bool = False) -> None:
    """Choose where kernels run from now on, in all threads of this process.

    Twins of the kernels exist for `simplify` by the paper's method and for what `select` looks at; all others
    run on the CPU whatever is chosen. A device that fails is left for good, with a line in `notes()`.

    Args:
        device: "cpu", which is what a process starts with; "gpu", the best adapter there is, even in
            software; "auto", a real GPU if the scene is large and a quick probe shows it to be right
            and faster.
        timed: keep time of every kernel, where the adapter can.

    Raises:
        InputError: another name.

    >>> use("cpu")
    >>> state().adapter is None
    True
    """
    if device not in ("cpu", "gpu", "auto"):
        raise InputError(f"expected cpu, gpu or auto, got {device!r}", parameter="device")
    _hush()
    _core.set_device(device, timed=timed)


def _hush() -> None:
    """Where there is no desktop, a layer of Mesa that asks it for the preferred GPU complains on stderr."""
    if "XDG_RUNTIME_DIR" not in os.environ:
        os.environ.setdefault("NODEVICE_SELECT", "1")


def state() -> State:
    """Where kernels run, and what there is to tell."""
    return State(**_core.device_state())


def is_software() -> bool:
    """Whether the adapter in use is a driver that computes on the CPU."""
    name = state().adapter
    return any(found.name == name and found.kind == "cpu" for found in adapters() or ())


def notes() -> list[str]:
    """Lines for the user since last asked, such as why the CPU took over."""
    return _core.device_notes()
