"""What the weights of a network take of the memory, looked up before they are read."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from advsearch.errors import ModelError

MEMORY = Path("/proc/meminfo")
"""Where Linux says what is free."""


def check_fits(transformers: Any, name: str, where: Mapping[str, Any], spec: str) -> None:
    """Raise a ModelError where the weights of a repository or a folder are larger than the memory that is free.

    They are kept in the type in which they are stored. Nothing is checked where the system does not say what is free.
    """
    size, free = _stored(transformers, name, where), free_bytes()
    if free is not None and size > free:
        raise ModelError(
            f"model {spec}: its weights take {size / 1e9:.3g} GB, and {free / 1e9:.3g} GB of memory are free. Give a "
            "smaller network, one whose weights are stored in bfloat16, or a machine with more memory"
        )


def free_bytes(told: Path | None = None) -> int | None:
    """Return the bytes that can be had without anything else being ended, swap included; None where nobody says."""
    try:
        lines = (told or MEMORY).read_text(encoding="ascii").splitlines()
        kilobytes = {line.partition(":")[0]: int(line.split()[1]) for line in lines if len(line.split()) > 1}
        return 1024 * (kilobytes["MemAvailable"] + kilobytes.get("SwapFree", 0))
    except (OSError, ValueError, KeyError):
        return None


def _stored(transformers: Any, name: str, where: Mapping[str, Any]) -> int:
    """Return the bytes of the weights: as the index of several files says, or the size of one; 0 of none."""

    def kept(file: str) -> str | None:
        found: str | None = transformers.utils.cached_file(
            name, file, _raise_exceptions_for_missing_entries=False, **where
        )
        return found

    index = kept("model.safetensors.index.json")
    if index:
        told = json.loads(Path(index).read_text(encoding="utf-8")).get("metadata", {}).get("total_size", 0)
        return int(told)
    one = kept("model.safetensors")
    return Path(one).stat().st_size if one else 0
