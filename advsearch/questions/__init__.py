"""Questions that are rooms of their own: all that belongs to one question in one folder, each file of the layer that
its name says (docs/design.md, "Rooms, and who may know whom")."""

from __future__ import annotations

# These list the settings and the answers of every room, and so come before any of them.
import advsearch.config
import advsearch.runs.results  # noqa: F401

ROOMS = ("test",)
"""The questions whose `carry_out.py` stands here, not in `advsearch/api/`."""
