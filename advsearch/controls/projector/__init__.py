"""The controls `projector` and `spot`, which project light onto the object.

A spot is a projector with the image of a round spot.
"""

from __future__ import annotations

from advsearch.controls.projector.projector import ProjectorControl as ProjectorControl
from advsearch.controls.projector.spot import SpotControl as SpotControl
