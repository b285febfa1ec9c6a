#!/usr/bin/env bash
# Builds the wheel, installs it in a new environment and uses it from another folder: scenes and weights travel inside.
# Usage: tools/check_wheel.sh [VENV], from the root of the checkout; VENV (.venv) is the environment that builds.
set -euo pipefail

builder=$PWD/${1:-.venv}/bin/python
constraints=$PWD/constraints.txt
notebook=$PWD/docs/notebook.ipynb
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

rm -rf build
"$builder" -m pip wheel --quiet --no-deps --no-build-isolation --wheel-dir "$work" .
ls -l "$work"/*.whl
"$builder" -m venv "$work/venv"
"$work/venv/bin/python" -m pip install -qq -c "$constraints" pip

# the first cell of the notebook, as somebody runs it who has nothing but the wheel
cd "$work"
PIP_CONSTRAINT=$constraints "$work/venv/bin/python" -c 'import json, sys
cells = json.load(open(sys.argv[1]))["cells"]
exec(next("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"))' "$notebook"

"$work/venv/bin/advsearch" --help >/dev/null
"$work/venv/bin/advsearch" doctor
"$work/venv/bin/advsearch" attack --object mug --control light --steps 2 --trials 6 --resolution 32 --quiet
"$work/venv/bin/python" - <<'PYTHON'
import importlib.util
import pathlib

import numpy as np

import advsearch
from advsearch.questions.harden.objects import OBJECTS
from advsearch.models import load_model
from advsearch.scene.library import list_environments, list_objects, load_environment, load_object

assert "venv" in pathlib.Path(advsearch.__file__).parts, advsearch.__file__
assert importlib.util.find_spec("scenes") is None, "the scripts that make the bundled files are in the wheel"
for name in list_objects():
    load_object(name)
    OBJECTS[name].generate(np.random.default_rng(1))  # as `advsearch harden` does
for name in list_environments():
    load_environment(name)
model = load_model("reference")
print(f"wheel: {len(list_objects())} objects, {len(list_environments())} environments, {len(model.labels)} labels")
PYTHON
echo "wheel: works from $work"
