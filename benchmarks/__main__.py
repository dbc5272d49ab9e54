"""The program `python -m benchmarks`."""

from __future__ import annotations

from g2ard.system import interrupt

__all__ = ["main"]


def main() -> None:
    interrupt.ends_the_program()
    from benchmarks.commands import app
    from benchmarks.synth.command import synth
    from g2ard.cli import run_program

    if not app.registered_groups:
        app.add_typer(synth, name="synth")
    run_program(app, "benchmarks")


if __name__ == "__main__":
    main()
