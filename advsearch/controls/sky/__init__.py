"""The `sky` control, and its environment map."""

from __future__ import annotations

from advsearch.controls.sky.control import SkyControl as SkyControl
