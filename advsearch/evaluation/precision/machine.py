"""The machine that times were taken on."""

from __future__ import annotations

import platform
import sys
from pathlib import Path

from advsearch import threads
from advsearch.runs.results.precision import Machine

_CPU_INFO = Path("/proc/cpuinfo")


def timing_machine(cpu_info: Path = _CPU_INFO) -> Machine:
    """Return what a time has to be read with: the processor, its cores, and the threads in use.

    Args:
        cpu_info: Linux's description of the processor.
    """
    return Machine(
        cpu=_cpu_name(cpu_info),
        cores=threads.cores(),
        threads=_threads(),
        system=f"{platform.system()} {platform.machine()}",
        python=platform.python_version(),
    )


def _cpu_name(cpu_info: Path) -> str:
    """The processor's name; what the system says where the file has none."""
    try:
        for line in cpu_info.read_text(encoding="utf-8", errors="replace").splitlines():
            key, _, value = line.partition(":")
            if key.strip().lower() == "model name" and value.strip():
                return " ".join(value.split())
    except OSError:
        pass
    return platform.processor() or platform.machine() or "unknown"


def _threads() -> dict[str, int]:
    """Threads of the renderer and of torch, as far as they are loaded."""
    found = {}
    if "drjit" in sys.modules:
        found["render"] = int(sys.modules["drjit"].thread_count())
    if "torch" in sys.modules:
        found["torch"] = int(sys.modules["torch"].get_num_threads())
    return found
