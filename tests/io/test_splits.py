"""Splits of views into training and held-out ones."""

import json
from pathlib import Path

import pytest

from g2ard.errors import InputError
from g2ard.io.splits import split_mask


def split_names(views: str | Path, names: list[str], which: str) -> list[str]:
    return [
        name for name, chosen in zip(names, split_mask(views, names, which), strict=True) if chosen
    ]


def test_every_eighth_sorted_name_is_test() -> None:
    names = [f"{i:02d}" for i in range(20)][::-1]
    assert split_names("x", names, "test") == ["16", "08", "00"]
    assert set(split_names("x", names, "train")) == set(names) - {"16", "08", "00"}
    assert split_mask("x", names, "all").all()


def test_split_file_wins(tmp_path: Path) -> None:
    split = {"train": ["images/a.jpg", "b.jpg"], "test": ["c.png"], "ood": ["d"]}
    (tmp_path / "split.json").write_text(json.dumps(split))
    names = ["a.jpg", "b.jpg", "c.jpg", "d.jpg"]
    assert split_names(tmp_path, names, "test") == ["c.jpg"]
    assert split_names(tmp_path / "transforms.json", names, "ood") == ["d.jpg"]
    sparse = tmp_path / "sparse" / "0"
    sparse.mkdir(parents=True)
    assert split_names(sparse, names, "train") == ["a.jpg", "b.jpg"]
    # stems alone would confuse
    assert split_names(tmp_path, ["left/b.jpg", "b.jpg"], "train") == ["b.jpg"]
    with pytest.raises(InputError, match=r"no split 'val' \(there are ood, test, train\)"):
        split_names(tmp_path, names, "val")
    with pytest.raises(
        InputError, match=r"its only view is not in split 'test'; add a split\.json that says"
    ):
        split_names(tmp_path, ["b.jpg"], "test")


@pytest.mark.parametrize("content", ['{"train": [1]}', "{}", "[]"])
def test_bad_split_file(tmp_path: Path, content: str) -> None:
    (tmp_path / "split.json").write_text(content)
    with pytest.raises(InputError, match=r"split\.json"):
        split_names(tmp_path, ["a"], "train")
