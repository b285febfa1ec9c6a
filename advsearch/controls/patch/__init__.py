"""The `patch` control, and where a sticker lies on a mesh."""

from __future__ import annotations

from advsearch.controls.patch.control import PatchControl as PatchControl
