"""Self-contained viewer pages: SuperSplat's viewer and the scenes in one HTML file that needs no network.

`supersplat/` holds the published viewer; its README.md tells the version and how to update it.
"""

from g2ard.viewer.page import Start, check_page_output, write_globe_page, write_page, write_stream_page

__all__ = ["Start", "check_page_output", "write_globe_page", "write_page", "write_stream_page"]
