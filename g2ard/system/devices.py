"""The device that kernels run on. A GPU's results are the CPU's within rounding, and repeatable."""

import os
from dataclasses import dataclass

import g2ard._core as _core
from g2ard.errors import require


@dataclass(frozen=True)
class Adapter:
    """A device that a graphics driver offers.

    Args:
        kind: discrete, integrated, virtual, cpu (software) or other.
        backend: vulkan, metal or dx12.
        max_buffer: bytes of its largest buffer.
        max_binding: bytes of a buffer that one kernel can address; larger scenes are processed in pieces.
        max_workgroup_memory: bytes shared by the threads of a workgroup.
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
    """The current device and its usage.

    Args:
        adapter: name of the adapter in use; None on the CPU and before the first kernel runs.
        uploaded_bytes: bytes sent to it; 0 after a fallback to the CPU.
        seconds: time on the device by kernel, if `use` was called with `timed`.
    """

    adapter: str | None
    served: int
    uploaded_bytes: int
    seconds: dict[str, float]


def adapters() -> list[Adapter] | None:
    """Return all adapters, best first, or None if this build has no GPU kernels."""
    _silence_mesa()
    found = _core.adapters()
    return None if found is None else [Adapter(**row) for row in found]


def use(device: str, *, timed: bool = False) -> None:
    """Select the device for all kernels of this process.

    What has no GPU kernel runs on the CPU. If the device fails, the CPU takes over for good and `notes()`
    says so.

    Args:
        device: "cpu" (the initial device); "gpu", the best adapter, even a software one; or "auto", a
            hardware GPU if the scene is large and a quick probe shows that it is correct and faster.
        timed: time every kernel, if the adapter can.

    Raises:
        InputError: unknown device name.

    >>> use("cpu")
    >>> state().adapter is None
    True
    """
    require("device", repr(device), device in ("cpu", "gpu", "auto"), "cpu, gpu or auto")
    _silence_mesa()
    _core.set_device(device, timed=timed)


def _silence_mesa() -> None:
    """Silence a layer of the Mesa drivers that complains on stderr without a desktop session."""
    if "XDG_RUNTIME_DIR" not in os.environ:
        os.environ.setdefault("NODEVICE_SELECT", "1")


def state() -> State:
    """Return the current device and its usage."""
    return State(**_core.device_state())


def is_software() -> bool:
    """Return whether the adapter in use is a software renderer."""
    name = state().adapter
    return any(found.name == name and found.kind == "cpu" for found in adapters() or ())


def notes() -> list[str]:
    """Return and clear pending messages, such as the reason for a fallback to the CPU."""
    return _core.device_notes()
