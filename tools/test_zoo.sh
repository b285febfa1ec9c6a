#!/usr/bin/env bash
# Runs the tests of other libraries' networks with the real timm and torchvision, in an environment of its own: they
# need builds of torch and torchvision that fit each other, and torch is pinned for everything else.
# Usage: tools/test_zoo.sh [PYTHON [VENV [ARGUMENT OF PYTEST ...]]], from the root of the checkout; `make` calls it.
# TORCH_INDEX is an index of torch's CPU wheels, as for tools/setup.sh; PAIR is another pair of versions.
set -euo pipefail

python=${1:-python3}
venv=${2:-build/zoo}
read -r -a pair <<<"${PAIR:-torch==2.14.1 torchvision==0.29.1}"
files=(tests/models/test_zoo.py tests/models/test_real_zoo.py tests/models/test_transformers.py)

index=()
[ "${TORCH_INDEX:-none}" = none ] || index=(--extra-index-url "$TORCH_INDEX")
[ -x "$venv/bin/python" ] || "$python" -m venv "$venv"
grep -v '^torch==' constraints.txt >"$venv/constraints.txt"
pip() { "$venv/bin/python" -m pip --disable-pip-version-check "$@"; }
pip install -qq -c "$venv/constraints.txt" pip setuptools
pip install -qq --no-build-isolation -c "$venv/constraints.txt" "${index[@]}" "${pair[@]}" timm -e '.[dev]'

"$venv/bin/python" - <<'PYTHON'
import timm
import torch
import torchvision
import transformers

print(f"torch {torch.__version__}, torchvision {torchvision.__version__}, timm {timm.__version__}, "
      f"transformers {transformers.__version__}")
PYTHON
"$venv/bin/python" -m pytest -n0 "${files[@]}" "${@:3}"
