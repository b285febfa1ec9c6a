"""The bundled object classes: parametric families of household objects, and things of the street, in numpy."""

from __future__ import annotations

from .cars import CAR
from .family import Instance, ObjectFamily
from .furniture import CHAIR, LAMP
from .kitchen import FRYING_PAN, TEAPOT
from .people import PERSON
from .signs import STOP_SIGN
from .things import BALL, BANANA, BOOK
from .tools import DUMBBELL, HAMMER
from .vessels import BOTTLE, BOWL, MUG, VASE, WINE_GLASS

HOUSEHOLD: dict[str, ObjectFamily] = {
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
"""What the reference model is trained on."""

STREET: dict[str, ObjectFamily] = {family.name: family for family in (CAR, STOP_SIGN, PERSON)}

OBJECTS: dict[str, ObjectFamily] = HOUSEHOLD | STREET

__all__ = ["HOUSEHOLD", "OBJECTS", "STREET", "Instance", "ObjectFamily"]
