#!/usr/bin/env bash
# Installs the wheel in dist/ into an environment of its own and runs a small job from an empty folder.
# Before: python -m build. PYTHON is the interpreter of the new environment, python3 unless set.
set -euo pipefail
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
version=$(sed -n 's/^__version__ = "\(.*\)"$/\1/p' "$root/src/plab/__init__.py")
wheel="$root/dist/plab-$version-py3-none-any.whl"
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT

"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet -c "$root/constraints.txt" "$wheel"
mkdir "$folder/empty"
cd "$folder/empty"
"$folder/venv/bin/python" -m plab.run --help > /dev/null
"$folder/venv/bin/python" -m plab.run task=Rope method=adam method.iterations=2 progress=false \
    sim.grid_size=16 sim.horizon=3 sim.substeps=5 sim.dt=4e-4 sim.particles_scale=0.03
"$folder/venv/bin/python" -m plab.results check results
"$folder/venv/bin/python" -m plab.status results
echo "The wheel of plab $version works in an environment and a folder of its own."
