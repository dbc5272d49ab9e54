"""File formats: Gaussian scenes, coloured point clouds and views, chosen by extension or content.

| reads | from |
|---|---|
| `read_splats`, `Source` | Gaussian scenes |
| `read_points`, `read_cloud` | coloured point clouds |
| `read_views`, `read_view_set` | cameras, of data sets or trainers |

`READERS` in `g2ard.io.detect` lists the formats. The first of each row returns data; the second also has
notes about the file (`Note`).
`find_views` finds the cameras that trainers leave beside a scene. Readers are imported on first use.
"""

from g2ard.io.atomic import atomic_folder, atomic_output, check_output
from g2ard.io.detect import find_views, kind
from g2ard.io.scenes import (
    check_scene_output,
    read_cloud,
    read_points,
    read_splats,
    write_points,
    write_splats,
)
from g2ard.io.source import Source
from g2ard.io.views import check_views_output, read_view_set, read_views, write_views

__all__ = [
    "Source",
    "atomic_folder",
    "atomic_output",
    "check_output",
    "check_scene_output",
    "check_views_output",
    "find_views",
    "kind",
    "read_cloud",
    "read_points",
    "read_splats",
    "read_view_set",
    "read_views",
    "write_points",
    "write_splats",
    "write_views",
]
