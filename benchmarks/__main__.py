"""The program `python -m benchmarks`."""

from __future__ import annotations

import sys

from g2ard.errors import explained
from g2ard.system import interrupt

__all__ = ["main"]


def main() -> None:
    interrupt.ends_the_program()
    try:
        from benchmarks.commands import app
    except ImportError as error:
        sys.exit(f"benchmarks: {explained(error)}")
    from g2ard.cli.main import run_program

    run_program(app, "benchmarks")


if __name__ == "__main__":
    main()
