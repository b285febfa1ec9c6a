"""The bundled object classes: parametric families of household objects, written by hand in numpy."""

from __future__ import annotations

from .family import Instance, ObjectFamily
from .furniture import CHAIR, LAMP
from .kitchen import FRYING_PAN, TEAPOT
from .things import BALL, BANANA, BOOK
from .tools import DUMBBELL, HAMMER
from .vessels import BOTTLE, BOWL, MUG, VASE, WINE_GLASS

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
