"""GPU tests skip on machines without an adapter."""

import os

import pytest

from g2ard.system import devices


def skip_without_gpu() -> None:
    """Skip a test without an adapter, software ones included; fail if the environment requires one."""
    found = devices.adapters()
    if found:
        return
    why = "this build has no GPU kernels" if found is None else "no adapter"
    if os.environ.get("G2ARD_REQUIRE_GPU") == "1":
        pytest.fail(f"{why}, but G2ARD_REQUIRE_GPU=1 is set")
    pytest.skip(f"{why}; install Mesa's lavapipe (mesa-vulkan-drivers)" if found == [] else why)
