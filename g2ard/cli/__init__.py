"""The command line. Only this package prints; stages, numpy and torch load only when a command runs."""
