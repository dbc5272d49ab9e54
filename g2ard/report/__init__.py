"""Self-contained HTML: charts as SVG, images inline, one page that needs no network."""
