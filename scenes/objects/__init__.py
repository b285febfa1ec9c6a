"""The bundled object classes: parametric families of household objects, written by hand in numpy."""

from __future__ import annotations

from advsearch.bundled.objects.family import Instance, ObjectFamily
from advsearch.bundled.objects.furniture import CHAIR, LAMP
from advsearch.bundled.objects.kitchen import FRYING_PAN, TEAPOT
from advsearch.bundled.objects.things import BALL, BANANA, BOOK
from advsearch.bundled.objects.tools import DUMBBELL, HAMMER
from advsearch.bundled.objects.vessels import BOTTLE, BOWL, MUG, VASE, WINE_GLASS

OBJECTS: dict[str, ObjectFamily] = {
    family.name: family
    for family in (
        MUG,
        BOWL,
        BOTTLE,
        VASE,
        TEAPOT,
        WINE_GLASS,
        FRYING_PAN,
        HAMMER,
        BANANA,
        BALL,
        CHAIR,
        LAMP,
        BOOK,
        DUMBBELL,
    )
}

__all__ = ["OBJECTS", "Instance", "ObjectFamily"]
