"""Pages that show scenes in a browser, from disk and without a network: SuperSplat's viewer and what it is to
show, in one file.

`supersplat/` holds the viewer as its makers publish it; its README.md says which version, and how to renew.
"""

from g2ard.viewer.page import Start, check_page_output, write_page

__all__ = ["Start", "check_page_output", "write_page"]
