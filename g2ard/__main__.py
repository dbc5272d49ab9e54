"""The program: `g2ard`, or `python -m g2ard`."""

import sys
import warnings

from g2ard.system import interrupt


def main() -> None:
    """Entry point."""
    interrupt.ends_the_program()
    if not sys.warnoptions:
        # an error is one line; of what is no error we tell in our own words
        warnings.simplefilter("ignore")
    try:
        from g2ard.cli.main import main as command_line

        command_line()
    except SystemExit as end:
        if end.code in interrupt.STATUSES:
            interrupt.leave()
        raise
    except ImportError as error:
        if error.name != "g2ard._core":
            raise
        from g2ard.errors import explained

        sys.exit(f"g2ard: {explained(error)}")


if __name__ == "__main__":
    main()
