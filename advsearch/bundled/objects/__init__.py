"""The bundled object classes: parametric families of household objects, and things of the street, in numpy."""

from __future__ import annotations

from advsearch.bundled.objects.cars import car
from advsearch.bundled.objects.family import Instance, ObjectFamily
from advsearch.bundled.objects.furniture import chair, lamp
from advsearch.bundled.objects.kitchen import frying_pan, teapot
from advsearch.bundled.objects.people import person
from advsearch.bundled.objects.things import ball, banana, book, stop_sign
from advsearch.bundled.objects.tools import dumbbell, hammer
from advsearch.bundled.objects.vessels import bottle, bowl, mug, vase, wine_glass

_HOUSEHOLD = (
    mug, bowl, bottle, vase, teapot, wine_glass, frying_pan, hammer, banana, ball, chair, lamp, book, dumbbell,
)  # fmt: skip
HOUSEHOLD: dict[str, ObjectFamily] = {family.name: family for family in _HOUSEHOLD}
"""What the reference model is trained on."""
STREET: dict[str, ObjectFamily] = {family.name: family for family in (car, stop_sign, person)}
OBJECTS: dict[str, ObjectFamily] = HOUSEHOLD | STREET
__all__ = ["HOUSEHOLD", "OBJECTS", "STREET", "Instance", "ObjectFamily"]
