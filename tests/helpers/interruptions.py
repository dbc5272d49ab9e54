"""Runs interrupted at a chosen point."""

import signal

from g2ard.progress import Progress


def interrupt_at(stage: str, step: int = 0) -> Progress:
    """Return a progress callback that interrupts a stage after a number of steps."""

    def progress(now: str, done: int, total: int, info: object = None) -> None:
        if now == stage and done >= step:
            raise KeyboardInterrupt

    return progress


def press_ctrl_c_at(stage: str, step: int) -> Progress:
    """Return a progress callback that sends SIGINT at a step of a stage that runs in the main thread."""

    def progress(now: str, done: int, total: int, info: object = None) -> None:
        if now == stage and done == step:
            signal.raise_signal(signal.SIGINT)

    return progress
