"""The `haze` control, its medium, and a path tracer for it."""

from __future__ import annotations

from advsearch.controls.haze.control import HazeControl as HazeControl
