"""One module per command, in the order `g2ard --help` lists them."""
