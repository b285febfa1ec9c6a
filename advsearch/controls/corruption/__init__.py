"""The `corruption` control, and the corruptions."""

from __future__ import annotations

from advsearch.controls.corruption.control import CorruptionControl as CorruptionControl
