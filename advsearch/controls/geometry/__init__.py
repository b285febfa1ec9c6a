"""The `geometry` control, and the smooth displacements it searches."""

from __future__ import annotations

from advsearch.controls.geometry.control import GeometryControl as GeometryControl
