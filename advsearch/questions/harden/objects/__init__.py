"""The bundled classes of objects, which are parametric families in numpy.

There are household objects, which the reference model is trained on, and things of the
street.
"""

from __future__ import annotations

from advsearch.questions.harden.objects.cars import car
from advsearch.questions.harden.objects.family import Instance, ObjectFamily
from advsearch.questions.harden.objects.furniture import chair, lamp
from advsearch.questions.harden.objects.kitchen import frying_pan, teapot
from advsearch.questions.harden.objects.people import person
from advsearch.questions.harden.objects.things import ball, banana, book, stop_sign
from advsearch.questions.harden.objects.tools import dumbbell, hammer
from advsearch.questions.harden.objects.vessels import (
    bottle,
    bowl,
    mug,
    vase,
    wine_glass,
)

_HOUSEHOLD = (
    mug,
    bowl,
    bottle,
    vase,
    teapot,
    wine_glass,
    frying_pan,
    hammer,
    banana,
    ball,
    chair,
    lamp,
    book,
    dumbbell,
)
HOUSEHOLD: dict[str, ObjectFamily] = {family.name: family for family in _HOUSEHOLD}
"""The families that the reference model is trained on."""
STREET: dict[str, ObjectFamily] = {
    family.name: family for family in (car, stop_sign, person)
}
OBJECTS: dict[str, ObjectFamily] = HOUSEHOLD | STREET
__all__ = ["HOUSEHOLD", "OBJECTS", "STREET", "Instance", "ObjectFamily"]
