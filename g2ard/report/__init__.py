"""Self-contained HTML reports: SVG charts and inline images on one page that needs no network."""
