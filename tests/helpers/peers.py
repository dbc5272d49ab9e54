"""Other people's readers, for tests that hold our files against them.

Looked for in $G2ARD_NODE_MODULES, by default tests/node_modules, which `npm ci --prefix tests` fills from
tests/package-lock.json; tests that need one skip where it is absent.
"""

import json
import os
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers.project import ROOT

_ADOBE = """
import fs from 'node:fs';
const create = (await import('file://' + process.argv[2])).default;
const spz = await create();
const data = new Uint8Array(fs.readFileSync(process.argv[3]));
const cloud = spz.loadSpzFromBuffer(data, { to: spz.CoordinateSystem.RDF });
const keys = ['positions', 'scales', 'rotations', 'alphas', 'colors', 'sh'];
console.log(JSON.stringify(Object.fromEntries(keys.map(key => [key, Array.from(cloud[key])]))));
"""

_VALIDATOR = """
import fs from 'node:fs';
import { createRequire } from 'node:module';
const validator = createRequire(process.argv[2] + '/')('gltf-validator');
const report = await validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[3])));
console.log(JSON.stringify(report));
"""


def _modules() -> Path:
    return Path(os.environ.get("G2ARD_NODE_MODULES", ROOT / "tests" / "node_modules")).absolute()


def package(*parts: str) -> Path:
    """Return a path in the node modules; skip the test if it is absent."""
    root = _modules()
    if not root.joinpath(*parts).exists():
        pytest.skip(f"no {'/'.join(parts)} (npm ci --prefix tests)")
    return root.joinpath(*parts)


def _node() -> str:
    own = _modules() / ".bin" / "node"
    return str(own) if own.exists() else "node"


def _run(*arguments: str | Path) -> str:
    found = subprocess.run([_node(), *map(str, arguments)], capture_output=True, text=True)
    assert found.returncode == 0, found.stdout + found.stderr
    return found.stdout


def splat_transform(*arguments: str | Path) -> None:
    """Run splat-transform; fail with its output."""
    _run(package("@playcanvas", "splat-transform", "bin", "cli.mjs"), "-q", "-w", *arguments)


def adobe_spz(path: Path) -> dict[str, np.ndarray]:
    """Read an .spz with Adobe's library: flat arrays in the axes of a .ply, rotations x y z w."""
    module = package("@adobe", "spz", "dist", "spz.js")
    out = _run("--input-type=module", "-e", _ADOBE, "-", module, path)
    return {key: np.array(values) for key, values in json.loads(out.splitlines()[-1]).items()}


def gltf_report(path: Path) -> dict[str, Any]:
    """Return the report of Khronos' glTF validator."""
    modules = package("gltf-validator").parent
    return json.loads(_run("--input-type=module", "-e", _VALIDATOR, "-", modules, path))
