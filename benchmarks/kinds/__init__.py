"""The kinds of studies, a module each."""
