#!/usr/bin/env bash
# Runs the tests of other libraries' networks with the real torchvision and timm, in an environment of its own: these
# need a torch that fits them, and it is pinned for everything else.
# Usage: tools/test_zoo.sh [PYTHON [VENV [ARGUMENT OF PYTEST ...]]], from the root of the checkout; `make` calls it.
# PAIR names other versions of the two; TORCH_INDEX is an index of CPU wheels, as for tools/setup.sh.
set -euo pipefail

python=${1:-python3}
venv=${2:-build/zoo}
read -r -a pair <<<"${PAIR:-torch==2.14.1 torchvision==0.29.1}"
index=()
[ "${TORCH_INDEX:-none}" = none ] || index=(--extra-index-url "$TORCH_INDEX")

[ -x "$venv/bin/python" ] || "$python" -m venv "$venv"
grep -v '^torch==' constraints.txt >"$venv/constraints.txt"
pip() { "$venv/bin/python" -m pip --disable-pip-version-check "$@"; }
pip install -qq -c "$venv/constraints.txt" pip setuptools
pip install -qq --no-build-isolation -c "$venv/constraints.txt" "${index[@]}" "${pair[@]}" timm -e '.[dev]'

"$venv/bin/python" - <<'PYTHON' # fails where one cannot be imported, so that no test of it is skipped
import importlib

names = ("torch", "torchvision", "timm", "transformers")
print("zoo: " + ", ".join(f"{name} {importlib.import_module(name).__version__}" for name in names))
PYTHON
mapfile -t files < <(grep -lrE 'importorskip\("(torchvision|timm|transformers)"' tests --include='test_*.py')
"$venv/bin/python" -m pytest -n0 tests/models/test_zoo.py "${files[@]}" "${@:3}"
