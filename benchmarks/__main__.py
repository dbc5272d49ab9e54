"""The program `python -m benchmarks`."""

from __future__ import annotations

from g2ard.system import interrupt

__all__ = ["main"]


def main() -> None:
    interrupt.ends_the_program()
    from benchmarks.commands import app
    from g2ard.cli import run_program

    run_program(app, "benchmarks")


if __name__ == "__main__":
    main()
