"""The `occlusion` control, and the things it puts between camera and object."""

from __future__ import annotations

from advsearch.controls.occlusion.control import OcclusionControl as OcclusionControl
