"""The bundled object classes: parametric families of household objects, and things of the street, in numpy."""

from __future__ import annotations

from .cars import car
from .family import Instance, ObjectFamily
from .furniture import chair, lamp
from .kitchen import frying_pan, teapot
from .people import person
from .signs import stop_sign
from .things import ball, banana, book
from .tools import dumbbell, hammer
from .vessels import bottle, bowl, mug, vase, wine_glass

_HOUSEHOLD = (
    mug, bowl, bottle, vase, teapot, wine_glass, frying_pan, hammer, banana, ball, chair, lamp, book, dumbbell,
)  # fmt: skip
HOUSEHOLD: dict[str, ObjectFamily] = {family.name: family for family in _HOUSEHOLD}
"""What the reference model is trained on."""

STREET: dict[str, ObjectFamily] = {family.name: family for family in (car, stop_sign, person)}

OBJECTS: dict[str, ObjectFamily] = HOUSEHOLD | STREET

__all__ = ["HOUSEHOLD", "OBJECTS", "STREET", "Instance", "ObjectFamily"]
