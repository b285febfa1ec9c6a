"""The controls `projector` and `spot`: light thrown onto the object; a spot is a
projector of a round image.
"""

from __future__ import annotations

from advsearch.controls.projector.projector import ProjectorControl as ProjectorControl
from advsearch.controls.projector.spot import SpotControl as SpotControl
