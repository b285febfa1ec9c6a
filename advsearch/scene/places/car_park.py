"""A car park: rows of bays along two lanes, with trees and lamps, and houses around it. Lengths are metres.

The object stands in a bay at the origin, with its front towards a lane.
"""

from __future__ import annotations

import numpy as np

from advsearch.scene.places.avenue import KERB, Place, Tree, asphalt, level, painted
from advsearch.scene.places.quads import FRONT, TOP, Quads, Wall

DEEP, WIDE, BAYS = 5.0, 2.5, 17
"""Of a bay, and how many are beside each other."""
ROWS = (-18.5, -7.5, -2.5, 8.5, 13.5, 24.5)
"""Where rows begin in x: two back to back, then a lane, and so on."""
LINE = 0.1
(BEGIN, END), HALF, WALK = (-20.0, 31.0), 24.0, 7.0
"""From and to in x, half of what it is in y, and how wide the pavement around it is."""


def _ground() -> Quads:
    quads = Quads()
    asphalt(quads, (BEGIN, END), (-HALF, HALF))
    edges = WIDE * (np.arange(BAYS + 1) - BAYS / 2.0)
    for x in ROWS:
        for y in edges:
            painted(quads, (x, x + DEEP), (y - LINE / 2.0, y + LINE / 2.0))
    for x in (-2.5, 13.5):  # between rows that stand back to back
        painted(quads, (x - LINE / 2.0, x + LINE / 2.0), (edges[0], edges[-1]))
    for ends in ((BEGIN - WALK, BEGIN), (END, END + WALK)):
        level(quads, ends, (-HALF - WALK, HALF + WALK), KERB, (-9.9, -9.9 + WALK))
    for sign in (-1.0, 1.0):
        level(quads, (BEGIN, END), (sign * HALF, sign * (HALF + WALK)), KERB, (-9.9, -9.9 + WALK))
    around = [(BEGIN, HALF, END - BEGIN, (0.0, -1.0)), (END, -HALF, END - BEGIN, (0.0, 1.0))]
    around += [(BEGIN, -HALF, 2.0 * HALF, (1.0, 0.0)), (END, HALF, 2.0 * HALF, (-1.0, 0.0))]
    for x, y, long, (out_x, out_y) in around:  # kerbs
        frame = Wall((x, y, 0.0), (out_x, out_y, 0.0))
        shown = np.array([[0.0, long / 24.0, 0.345, 0.348]])
        quads.boxes(frame, np.array([[0.0, long, 0.0, 0.16, 0.0, KERB]]), shown, (FRONT, TOP))
    return quads


MIDDLE, OUT = (BEGIN + END) / 2.0, HALF + WALK
CAR_PARK = Place(
    _ground,
    (
        (Wall((MIDDLE, OUT, KERB), (0.0, -1.0, 0.0)), -40.0, 40.0, 21),
        (Wall((MIDDLE, -OUT, KERB), (0.0, 1.0, 0.0)), -40.0, 40.0, 22),
        (Wall((BEGIN - WALK, 0.0, KERB), (1.0, 0.0, 0.0)), -40.0, 40.0, 23),
        (Wall((END + WALK, 0.0, KERB), (-1.0, 0.0, 0.0)), -40.0, 40.0, 24),
    ),
    tuple(
        Tree(x, sign * (HALF + 1.8), number, side)
        for side, sign in enumerate((-1.0, 1.0))
        for number, x in enumerate((-16.0, -8.5, 9.0, 17.0, 24.0))
    ),
    (
        *((x, y, y + arm) for x in (-2.5, 13.5) for y, arm in ((-WIDE * 5.5, -1.7), (WIDE * 5.5, 1.7))),
        *((-13.0, sign * (HALF + 0.6), sign * (HALF - 1.1)) for sign in (-1.0, 1.0)),
    ),
)
