"""The bundled environments: rooms cast in numpy and skies, half of them never used in training."""

from __future__ import annotations

from advsearch.bundled.environments.panorama import EnvironmentFamily
from advsearch.bundled.environments.rooms import ROOMS
from advsearch.bundled.environments.skies import SKIES

ENVIRONMENTS: dict[str, EnvironmentFamily] = {family.name: family for family in (*ROOMS, *SKIES)}

__all__ = ["ENVIRONMENTS", "EnvironmentFamily"]
