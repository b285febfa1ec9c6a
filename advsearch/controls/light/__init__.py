"""The `light` control, and its lamp."""

from __future__ import annotations

from advsearch.controls.light.control import LightControl as LightControl
