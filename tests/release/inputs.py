"""Write small inputs under the names that README's *Use* section reads, with the installed package.

python inputs.py FOLDER
"""

import sys
from dataclasses import replace
from pathlib import Path

import g2ard

sys.path.append(str(Path(__file__).resolve().parents[1]))

from helpers.feature_scenes import blotched
from helpers.photos import cloud_of, photos_of
from helpers.scenes import around


def main(folder: Path) -> None:
    """Write scene.ply, room.ply, tree.spz, cloud.laz, cloud.ply, photos/, new/ and rough.json."""
    folder.mkdir(parents=True, exist_ok=True)
    scene = blotched(6000).with_sh_degree(0)
    g2ard.save(folder / "scene.ply", scene)
    g2ard.save(folder / "room.ply", scene.take(slice(900)))
    g2ard.save(folder / "tree.spz", scene.take(slice(900, 1600)))
    cloud_of(folder / "cloud.laz", scene)
    cloud_of(folder / "cloud.ply", blotched(260_000))
    photos_of(folder / "photos", scene=scene, views=around(24, (96, 72)))
    photos_of(folder / "new", scene=scene, views=around(4, (400, 300), 2.6))
    new = g2ard.load_views(folder / "new")
    moved = new.viewmats.copy()
    moved[:, :3, 3] += 0.02
    g2ard.save_views(folder / "rough.json", replace(new, viewmats=moved))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
