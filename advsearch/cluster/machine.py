"""What a worker runs on, as far as it decides the last bits of a row; and whether it is the same advsearch."""

from __future__ import annotations

import hashlib
import json
import platform
from functools import cache
from importlib import metadata
from pathlib import Path

from advsearch.scene.mitsuba_backend.llvm import ensure_llvm

_CPU_INFO = Path("/proc/cpuinfo")
PACKAGES = ("mitsuba", "drjit", "torch", "numpy")
"""Whose versions decide last bits."""

MachineInfo = dict[str, str]


@cache
def this_machine() -> MachineInfo:
    """Return the processor, libLLVM, and versions of packages.

    Raises:
        EnvironmentSetupError: there is no libLLVM that can be used; the message says what to type.
    """
    llvm = ".".join(map(str, ensure_llvm().version))
    return {"processor": processor(), "LLVM": llvm, **{name: _version(name) for name in PACKAGES}}


def machine_name(machine: MachineInfo) -> str:
    """Return a short name of a machine by what it is."""
    return hashlib.sha256(json.dumps(machine, sort_keys=True).encode()).hexdigest()[:8]


@cache
def version() -> str:
    """Return the version of advsearch, with a few digits of what its files say, which no version number tells."""
    digest = hashlib.sha256()
    folder = Path(__file__).resolve().parents[1]
    for path in sorted(folder.rglob("*.py")):
        digest.update(path.relative_to(folder).as_posix().encode() + b"\0" + path.read_bytes())
    return f"{_version('advsearch')}+{digest.hexdigest()[:8]}"


def processor(cpu_info: Path = _CPU_INFO) -> str:
    """Return the processor's name; what the system says where Linux's description has none."""
    try:
        for line in cpu_info.read_text(encoding="utf-8", errors="replace").splitlines():
            key, _, value = line.partition(":")
            if key.strip().lower() == "model name" and value.strip():
                return " ".join(value.split())
    except OSError:
        pass
    return platform.processor() or platform.machine() or "unknown"


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "unknown"
