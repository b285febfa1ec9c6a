"""The bundled places: streets, a road, a car park and a room, as glTF files with YAML
files beside them.
"""

from __future__ import annotations

from collections.abc import Callable

from .avenue import AVENUE, make_street
from .crossing import CAR_PARK, CROSSING
from .models import PlaceModel, place_files
from .road import make_road
from .room import make_room

PLACES: dict[str, Callable[[], PlaceModel]] = {
    "avenue": lambda: make_street(AVENUE),
    "crossing": lambda: make_street(CROSSING),
    "car-park": lambda: make_street(CAR_PARK),
    "road": make_road,
    "room": make_room,
}
"""What makes each place, by its name."""

__all__ = ["PLACES", "PlaceModel", "place_files"]
