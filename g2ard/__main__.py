"""The program: `g2ard`, or `python -m g2ard`."""

from g2ard import interrupt

__all__ = ["main"]


def main() -> None:
    """Entry point."""
    interrupt.ends_the_program()
    from g2ard.cli import main as command_line

    try:
        command_line()
    except SystemExit as end:
        if end.code in interrupt.STATUSES:
            interrupt.leave()
        raise


if __name__ == "__main__":
    main()
