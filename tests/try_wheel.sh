#!/bin/sh
# Installs a wheel (or an sdist) beside its dependencies but torch into a fresh environment, makes a small scene
# there and simplifies it, so that nothing but the wheel is tried:
#
#     sh tests/try_wheel.sh dist/g2ard-….whl
#
# PYTHON is the interpreter to make the environment with, DEPENDENCIES what to install; pip's own variables
# (PIP_NO_INDEX, PIP_FIND_LINKS) say where from.
set -eu
wheel=$(cd "$(dirname "$1")" && pwd)/$(basename "$1")
folder=$(mktemp -d)
trap 'cd / && rm -rf "$folder"' EXIT # Windows removes no folder that one is in
cd "$folder"
"${PYTHON:-python3}" -m venv venv
bin=venv/bin
[ -d "$bin" ] || bin=venv/Scripts # Windows
"$bin/python" -m pip install --quiet ${DEPENDENCIES:-numpy pillow plyfile rich typer}
"$bin/python" -m pip install --quiet --no-deps "$wheel"
"$bin/g2ard" --version
"$bin/g2ard" synth city -o city --points 3k --views 8 --size 32x24
"$bin/g2ard" lift city/cloud.ply -o dense.ply
"$bin/g2ard" simplify dense.ply -n 500 -o small.ply
"$bin/g2ard" info small.ply | grep -F "500"
"$bin/python" - <<'EOF'
import hashlib, platform, sys
digest = hashlib.sha256(open("small.ply", "rb").read()).hexdigest()
print(platform.machine(), platform.libc_ver(), sys.version.split()[0], "small.ply", digest[:16])
EOF
