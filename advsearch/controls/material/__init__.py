"""The `material` control, and the named materials."""

from __future__ import annotations

from advsearch.controls.material.control import MaterialControl as MaterialControl
