"""Sphinx: the site that `make docs` builds from the Markdown files of the repository, its root the source."""

from __future__ import annotations

import re

import g2ard

project = "g2ard"
author = "the authors of g2ard"
version = release = g2ard.__version__

extensions = ["myst_parser", "sphinx_design", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
root_doc = "docs/index"
include_patterns = ["*.md", "docs/**", "benchmarks/record/**"]
exclude_patterns = ["docs/conf.py"]

html_theme = "furo"
html_title = "g2ard"
html_extra_path = ["llms.txt"]  # an index for language models
html_copy_source = False
html_show_copyright = False

myst_heading_anchors = 3
myst_enable_extensions = ["colon_fence"]

autodoc_member_order = "bysource"
autodoc_typehints = "none"  # signatures would repeat what Args say
autodoc_class_signature = "separated"
default_role = "code"  # docstrings quote names as Markdown does
napoleon_use_rtype = False
napoleon_use_ivar = True


def as_rst(app, what, name, obj, options, lines) -> None:
    """Docstrings are plain text with `code`: what reStructuredText would read as markup is escaped."""
    for i, line in enumerate(lines):
        if not line.lstrip().startswith((">>>", "...")):
            parts = re.split(r"(`[^`]+`)", line)  # every second one is code
            parts[::2] = [re.sub(r"([*|])", r"\\\1", part) for part in parts[::2]]
            lines[i] = "".join(parts)


def setup(app) -> None:
    app.connect("autodoc-process-docstring", as_rst, priority=100)
