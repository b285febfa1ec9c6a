#!/usr/bin/env bash
# Makes the virtual environment with every dependency at the version in constraints.txt, and sees to a libLLVM that works.
# Usage: tools/setup.sh [PYTHON [VENV]], from the root of the checkout; `make` calls it.
set -euo pipefail

python=${1:-python3}
venv=${2:-.venv}

say() { printf 'set-up: %s\n' "$*"; }
stop() { printf 'set-up: %s\n' "$@" >&2; exit 2; }

# A Python of a version that all dependencies have wheels for: the one asked for, or else the newest there is.
right_version() { "$1" -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null; }

choose_python() {
    local candidate
    for candidate in "$python" python3.13 python3.12 python3.11 python3.10; do
        if command -v "$candidate" >/dev/null && right_version "$candidate"; then
            python=$candidate
            return
        fi
    done
    stop "expected Python 3.10 to 3.13, got $("$python" --version 2>&1 || true) for '$python'." \
        "Install one, or name it: make PYTHON=/path/to/python3.12 setup"
}

make_venv() {
    if [ -x "$venv/bin/python" ] && right_version "$venv/bin/python" && "$venv/bin/python" -m pip --version >/dev/null 2>&1; then
        return
    fi
    "$python" -c 'import ensurepip, venv' 2>/dev/null || stop \
        "$python has no venv module. Install it with: apt-get install python3-venv" \
        "(Fedora and Homebrew have it in their python3 package.)"
    say "making $venv with $("$python" --version)"
    rm -rf "$venv"
    "$python" -m venv "$venv"
}

pip() { "$venv/bin/python" -m pip --disable-pip-version-check "$@"; }

# The CPU build of torch: on Linux the package index's own build is the one for CUDA, gigabytes that are of no use here.
# Prints the index to add, if any.
torch_index() {
    local report
    case "${TORCH_INDEX:-}" in
        none) return ;;
        ?*) echo "$TORCH_INDEX"; return ;;
    esac
    [ "$(uname -s)" = Linux ] || return 0
    report=$(pip install --quiet --dry-run --no-deps --ignore-installed --report - -c constraints.txt torch 2>/dev/null)
    case "$report" in *'+cpu"'*) return ;; esac # the machine's own settings lead to a CPU build already
    say "pip takes torch's CUDA build here (gigabytes). For the CPU build stop this and give the address of PyTorch's" >&2
    say "index of CPU wheels, as its 'Get started' page says: make TORCH_INDEX=ADDRESS setup" >&2
}

install_packages() {
    local index
    say "installing the dependencies (some 400 MB and a minute or two the first time)"
    pip install -qq -c constraints.txt pip setuptools
    index=$(torch_index)
    pip install -qq --no-build-isolation -c constraints.txt ${index:+--extra-index-url "$index"} -e '.[dev]'
}

# Dr.Jit needs LLVM 17 or later (advsearch/scene/mitsuba_backend/llvm.py says why); Debian's and Ubuntu's package is installed if we may.
llvm() { "$venv/bin/python" -m advsearch.scene.mitsuba_backend.llvm "$@"; }

as_root() { if [ "$(id -u)" = 0 ]; then "$@"; else sudo -n "$@"; fi; }

may_install() {
    command -v apt-get >/dev/null || return 1
    [ "$(id -u)" = 0 ] || { command -v sudo >/dev/null && sudo -n true 2>/dev/null; }
}

install_command=(apt-get install -y -q --no-install-recommends libllvm19)

install_llvm() {
    export DEBIAN_FRONTEND=noninteractive
    as_root "${install_command[@]}" >/dev/null 2>&1 && return
    say "reading the lists of packages"
    as_root apt-get update -q >/dev/null || true
    as_root "${install_command[@]}" >/dev/null || true
}

ensure_llvm() {
    llvm >/dev/null 2>&1 && return
    if [ -n "${ADVSEARCH_NO_SUDO:-}" ] && [ -z "${DRJIT_LIBLLVM_PATH:-}" ] && command -v apt-get >/dev/null; then
        stop "no libLLVM that Dr.Jit can use, and ADVSEARCH_NO_SUDO forbids to install it. As root type:" \
            "  ${install_command[*]}" "and then make setup again."
    fi
    if [ -z "${DRJIT_LIBLLVM_PATH:-}" ] && may_install; then
        say "no libLLVM that Dr.Jit can use, so this installs a system package as root: ${install_command[*]}"
        say "(ADVSEARCH_NO_SUDO=1 prints the command instead)"
        install_llvm
    fi
    llvm >/dev/null || exit 2
}

[ "${BASH_SOURCE[0]}" = "$0" ] || return 0 # a test reads the functions

choose_python
make_venv
install_packages
ensure_llvm
say "ready: $("$venv/bin/python" --version), libLLVM $(llvm)"
