"""`python -m g2ard`."""

from g2ard.cli import main

main()
