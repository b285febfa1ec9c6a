"""Whole results that tests change in one place: what a command could have answered, made without doing any work."""

from __future__ import annotations

from typing import Any

from advsearch.runs.results.region import RegionResult

FORMATION: dict[str, Any] = {
    "denoiser": "oidn", "filter": "box", "sampler": "multijitter", "exposure": 0.0, "resolution": [128, 128],
    "gain": 1.0,
}  # fmt: skip
RUN: dict[str, Any] = {
    "environment": "studio",
    "ending": "done",
    "seconds": {"total": 9.0},
    "seed": 0,
    "command_line": "",
}
REGION: dict[str, Any] = {
    **RUN, "schema": 1, "command": "region", "run": "runs/mug-pose-002", "object": "mug", "controls": ["pose"],
    "model": "reference", "verdict": "wrong", "same": 200, "samples": 200, "rate": 1.0, "interval": [0.982, 1.0],
    "volume": 0.12, "spp": 64,
    "box": [{"name": "pose.yaw", "unit": "degrees", "low": 10.0, "high": 55.5, "centre": 30.0}],
    "image_formation": FORMATION, "clean": {"moved": []}, "warnings": [], "renders": {"verification": 300},
}  # fmt: skip


def region(**changes: Any) -> RegionResult:
    """Return a region's result with other fields."""
    return RegionResult.of({**REGION, **changes})
