"""The bundled environments: rooms cast in numpy and skies, half of them never used in
training, and streets.
"""

from __future__ import annotations

from .panorama import EnvironmentFamily
from .rooms import ROOMS
from .skies import SKIES
from .streets import STREETS

ENVIRONMENTS: dict[str, EnvironmentFamily] = {
    family.name: family for family in (*ROOMS, *SKIES, *STREETS)
}

__all__ = ["ENVIRONMENTS", "EnvironmentFamily"]
