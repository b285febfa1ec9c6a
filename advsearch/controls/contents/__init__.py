"""The `contents` control, and the inside of a vessel."""

from __future__ import annotations

from advsearch.controls.contents.control import ContentsControl as ContentsControl
