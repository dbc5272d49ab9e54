"""Levels of detail: the tree, what leaves lose, streamed SOG, and the command."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import g2ard
from g2ard import io
from g2ard.errors import InputError
from g2ard.io import sog
from g2ard.jobs.levels import lod
from g2ard.levels import Cut, cut, save_levels
from g2ard.scene.splats import Splats
from g2ard.scene.transform import join, rotation_matrices
from helpers.commands import refused, succeeds
from helpers.level_files import files_of, leaves_of, scattered
from helpers.photos import photographed
from helpers.scenes import around, checkered_ball


@pytest.mark.parametrize(
    "rule", [Cut(), Cut(most=300), Cut(most=10_000, extent=3, least=50), Cut(most=1)]
)
def test_every_row_of_every_level_lies_in_one_leaf_and_its_box(rule: Cut) -> None:
    levels = [scattered(900), scattered(200, 1), scattered(40, 2)]
    leaves = leaves_of(cut(levels, rule))
    for number, level in enumerate(levels):
        rows = np.concatenate([leaf.rows[number] for leaf in leaves])
        assert sorted(rows) == list(range(len(level)))
    for leaf in leaves:
        means = np.concatenate(
            [level.means[rows] for level, rows in zip(levels, leaf.rows, strict=True)]
        )
        assert len(means) <= rule.most
        assert len(means) <= rule.least or np.ptp(means, axis=0).max() <= rule.extent
        for level, rows in zip(levels, leaf.rows, strict=True):
            for row in rows[:20]:
                axes = rotation_matrices(level.quats[row : row + 1])[0] * level.scales[row]
                corners = np.array(
                    [axes @ (np.array(corner) * 2 - 1) for corner in np.ndindex(2, 2, 2)]
                )
                assert (level.means[row] + corners >= leaf.low - 1e-6).all()
                assert (level.means[row] + corners <= leaf.high + 1e-6).all()


def test_levels_that_do_not_fit_together_are_refused() -> None:
    with pytest.raises(InputError, match="different offsets"):
        cut([scattered(9), scattered(9, offset=5)])
    with pytest.raises(InputError, match="none of them empty"):
        cut([scattered(9), scattered(9).take([])])
    with pytest.raises(InputError, match="extent: "):
        Cut(extent=0)


@pytest.mark.parametrize("offset", [0.0, 500_000.0])
def test_streamed_sog_holds_the_leaves_where_the_tree_says(tmp_path: Path, offset: float) -> None:
    levels = [scattered(900, offset=offset), scattered(200, 1, offset)]
    size = save_levels(tmp_path / "out", levels, cut=Cut(most=250))
    meta = json.loads((tmp_path / "out" / "lod-meta.json").read_text())
    assert size == sum(p.stat().st_size for p in (tmp_path / "out").rglob("*") if p.is_file())
    assert (meta["version"], meta["count"], meta["counts"], meta["lodLevels"]) == (
        1,
        1100,
        [900, 200],
        2,
    )
    files = [sog.Stream(tmp_path / "out" / name).whole() for name in meta["filenames"]]
    assert [len(file) for file in files].count(0) == 0
    nodes, seen = [meta["tree"]], np.zeros((2, 2), int)
    while nodes:
        node = nodes.pop()
        nodes += node.get("children", [])
        low, high = np.array(node["bound"]["min"]), np.array(node["bound"]["max"])
        for level, part in node.get("lods", {}).items():
            rows = files[part["file"]].means[part["offset"] : part["offset"] + part["count"]]
            assert len(rows) == part["count"]
            assert (rows > low - 1e-3).all()
            assert (rows < high + 1e-3).all()
            seen[int(level)] += part["count"], 1
            assert meta["filenames"][part["file"]].startswith(f"{level}_")
    assert seen[:, 0].tolist() == [900, 200]
    back = io.read_splats(tmp_path / "out" / "lod-meta.json")
    assert len(back) == 900
    np.testing.assert_array_equal(back.offset, np.full(3, offset))
    np.testing.assert_allclose(
        np.sort(back.means, axis=0), np.sort(levels[0].means, axis=0), atol=2e-3
    )


def test_files_of_an_earlier_call_go_and_others_stay(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    shN = rng.normal(size=(900, 3, 3))
    fine = Splats.create(scattered(900).means, scales=scattered(900).scales, shN=shN)
    save_levels(tmp_path / "out", [fine, scattered(300, 1)], cut=Cut(most=250))
    own = [tmp_path / "out" / name for name in ("notes.txt", "0_1/notes.txt", "0_9/meta.json")]
    for file in own:
        file.parent.mkdir(exist_ok=True)
        file.write_text("{}")
    save_levels(tmp_path / "out", [scattered(100)], overwrite=True)
    save_levels(tmp_path / "clean", [scattered(100)])
    kept = {str(file.relative_to(tmp_path / "out")) for file in own}
    assert set(files_of(tmp_path / "out")) == kept | set(files_of(tmp_path / "clean"))
    assert {folder.name for folder in (tmp_path / "out").iterdir()} == {
        *("lod-meta.json", "notes.txt", "0_0", "0_1", "0_9")
    }


def test_an_interrupted_lod_resumes_to_the_same_bits(tmp_path: Path) -> None:
    ball = checkered_ball(1200)
    options = {"ratios": (1, 3, 9), "steps": 6, "views": around(8, (48, 36)), "size": 48}
    whole = lod(ball, **options)
    assert [len(level) for level in whole.splats] == [1200, 400, 133]
    assert whole.reports[0].recovered is None
    assert whole.reports[1].recovered is not None

    def stop(line: str) -> None:
        if line.startswith("level 2"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        lod(ball, **options, work=tmp_path / "work", say=stop)
    assert list((tmp_path / "work").rglob("*.npz"))
    again = lod(ball, **options, work=tmp_path / "work")
    assert [level.fingerprint() for level in again.splats] == [
        level.fingerprint() for level in whole.splats
    ]


@pytest.mark.parametrize("ratios", [(), (2, 1), (1, 1), (0.5, 2), (1, float("nan"))])
def test_ratios_are_rising_numbers(ratios: tuple[float, ...]) -> None:
    with pytest.raises(InputError, match="ratios: expected"):
        lod(checkered_ball(50), ratios=ratios)


def test_a_dry_run_tells_the_cost_of_every_level_and_writes_nothing(
    tmp_path: Path, command_line
) -> None:
    g2ard.save(tmp_path / "ball.ply", checkered_ball(400))
    g2ard.save_views(tmp_path / "v.json", around(8, (32, 24)))
    ask = ("lod", "ball.ply", "-r", "1,4,8", "--views", "v.json", "-o", "lod", "--dry-run")
    told = succeeds(command_line, tmp_path, *ask, "--steps", "90", "--json", "-")
    levels = json.loads(told.out)["levels"]
    assert [(one["level"], one["count"], one["steps"]) for one in levels] == [
        (1, 100, 90),
        (2, 50, 90),
    ]
    lines = [line for line in told.err.splitlines() if "roughly" in line]
    assert [line.partition(":")[0] for line in lines] == ["level 1", "level 2", "all levels"]
    merged = succeeds(command_line, tmp_path, *ask, "--merge-only", "-q").err
    assert re.search(r"^level 2: 50 Gaussians: roughly \d+ MB$", merged, re.MULTILINE)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["ball.ply", "v.json"]
    succeeds(command_line, tmp_path, *ask[:-1], "--merge-only")
    succeeds(command_line, tmp_path, *ask)  # also beside a finished output


def test_a_finished_folder_tells_with_which_options(tmp_path: Path, command_line) -> None:
    io.write_splats(tmp_path / "ball.ply", checkered_ball(800))
    g2ard.save_views(tmp_path / "v.json", around(8, (48, 36)))
    given = (
        "lod",
        "ball.ply",
        "-o",
        "deep/out",
        "-r",
        "1,4,8",
        "--merge-only",
        "--views",
        "v.json",
        "--size",
        48,
    )
    succeeds(command_line, tmp_path, *given)
    assert len(io.read_splats(tmp_path / "deep" / "out")) == 800
    assert "already finished" in succeeds(command_line, tmp_path, *given, "--resume").err
    for other in ("1,4", "1,4,16"):
        assert "finished with other options (ratios)" in refused(
            command_line, tmp_path, *given[:5], other, *given[6:], "--resume", status=1
        )


def test_a_stopped_run_with_other_options(
    tmp_path: Path, command_line, monkeypatch: pytest.MonkeyPatch
) -> None:
    io.write_splats(tmp_path / "ball.ply", checkered_ball(800))
    g2ard.save_views(tmp_path / "v.json", around(8, (48, 36)))
    given = (
        "lod",
        "ball.ply",
        "-o",
        "out",
        "-r",
        "1,4",
        "--views",
        "v.json",
        "--steps",
        "3",
        "--size",
        "48",
    )

    def stop(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("g2ard.levels.save_levels", stop)
        status, _, said = command_line(*given, cwd=tmp_path)
    assert (status, "to continue from" in said) == (130, True)
    assert (
        "continues after final, simplified-1"
        in succeeds(command_line, tmp_path, *given[:-1], "64", "--resume").err
    )
    assert {path.name for path in tmp_path.iterdir()} == {"ball.ply", "v.json", "out"}


def test_the_sky_is_the_environment(tmp_path: Path, command_line) -> None:
    ball = checkered_ball(800)
    rays = np.random.default_rng(1).normal(size=(100, 3))
    sky = Splats.create(
        60 * rays / np.linalg.norm(rays, axis=1)[:, None], scales=np.full((100, 3), 8.0)
    )
    io.write_splats(tmp_path / "a.ply", join([ball, sky]))
    g2ard.save_views(tmp_path / "v.json", around(8, (48, 36)))
    words = (
        "lod",
        "a.ply",
        "-o",
        "out",
        "-r",
        "1,8",
        "--merge-only",
        "--views",
        "v.json",
        "--size",
        48,
    )
    io.write_splats(tmp_path / "ball.ply", ball)
    error = succeeds(command_line, tmp_path, "lod", "ball.ply", "--dry-run", "--environment").err
    assert "sky: none" in error
    assert "sky: 100 Gaussians" in succeeds(command_line, tmp_path, *words, "--environment").err
    meta = json.loads((tmp_path / "out" / "lod-meta.json").read_text())
    assert (meta["environment"], meta["counts"]) == ("env/meta.json", [800, 100])
    np.testing.assert_array_less(meta["tree"]["bound"]["max"], 2)
    assert len(io.read_splats(tmp_path / "out" / "env")) == 100
    assert len(io.read_splats(tmp_path / "out")) == 900
    succeeds(command_line, tmp_path, *words, "-w")
    meta = json.loads((tmp_path / "out" / "lod-meta.json").read_text())
    assert ("environment" in meta, meta["counts"]) == (False, [900, 113])
    assert not (tmp_path / "out" / "env").exists()


def test_levels_learn_from_photos_where_views_have_them(tmp_path: Path) -> None:
    """Half of the views have photos, and these are dark."""
    ball = checkered_ball(400)
    views = photographed(tmp_path, ball, around(16, (48, 36)), gain=0.3)
    views = replace(
        views, image_paths=tuple(p if i % 2 else None for i, p in enumerate(views.image_paths))
    )
    levels = {
        photos: lod(ball, ratios=(8,), views=views, photos=photos, steps=20).splats[0]
        for photos in (None, False)
    }
    mixed, renders = (g2ard.render(level, views[1]).image.mean() for level in levels.values())
    assert mixed < 0.95 * renders
