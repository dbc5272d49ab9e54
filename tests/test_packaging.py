"""Tests of files published beside the wheel: the container, and the site's index for language models."""

import json
import re
import shutil
import subprocess

import pytest

from helpers.project import ROOT

DOCKERFILE = (ROOT / "Dockerfile").read_text(encoding="utf-8")


def test_the_container_is_small_and_without_root() -> None:
    words = [
        line.split(maxsplit=1) for line in DOCKERFILE.splitlines() if line[:1] not in ("", "#")
    ]
    steps = [name for name, _ in words]
    (base,) = (rest for name, rest in words if name == "FROM")
    assert re.fullmatch(r"python:3\.\d+-slim", base)
    assert not re.search(r"\b(gcc|g\+\+|build-essential|rustup|cargo|maturin)\b", DOCKERFILE)
    assert steps.index("USER") > max(i for i, name in enumerate(steps) if name in ("RUN", "COPY"))
    assert dict(words)["USER"] != "root"
    assert json.loads(dict(words)["ENTRYPOINT"]) == ["g2ard"]
    assert "--no-cache-dir" in DOCKERFILE
    assert (ROOT / ".dockerignore").read_text().split() == ["*", "!dist/*.whl"]


def test_the_container_builds_and_runs() -> None:
    docker = shutil.which("docker")
    if docker is None or subprocess.run([docker, "info"], capture_output=True).returncode:
        pytest.skip("no Docker daemon")
    if not list((ROOT / "dist").glob("*.whl")):
        pytest.skip("no wheel in dist (make wheel-linux)")
    subprocess.run([docker, "build", "--quiet", "--tag", "g2ard-test", str(ROOT)], check=True)
    said = subprocess.run(
        [docker, "run", "--rm", "g2ard-test", "--version"], capture_output=True, text=True
    )
    assert said.stdout.startswith("g2ard ")


def test_llms_txt_leads_to_pages_of_the_site() -> None:
    text = (ROOT / "docs/llms.txt").read_text(encoding="utf-8")
    pages = re.findall(r"\]\(([^)]+)\.html\)", text)
    assert len(pages) > 5
    assert [page for page in pages if not (ROOT / f"{page}.md").is_file()] == []
