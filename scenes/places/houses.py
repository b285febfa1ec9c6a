"""Houses of a street: fronts with recessed windows, doors, shops, cornices and roofs.
Lengths are metres.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from advsearch.scene.assets import BoolArray, Float64Array
from scenes.places import paint
from scenes.places.quads import FRONT, SHOWN, SIDES, TOP, Quads, Wall

DEPTH = 11.0
REVEAL = 0.17  # how far windows stand back
SHOP_REVEAL = 0.32
ATTIC = 0.75  # of the front above the last floor
DOOR = (0.7, 1.9, 0.0, 2.75)
SHOP = (0.25, 2.35, 0.5, 2.95)
WINDOW = (0.7, 1.9, 1.05, 2.85)
"""Openings of a ground floor: from and to along its bay, and in height."""
LIT = 0.3  # share of windows that are lit by night


@dataclass(eq=False)
class Fronts:
    """Fronts in a row, collected before they are built: masonry, frames and roofs; and
    panes of dwellings without (`dark`) and with light behind them by night, and of
    shops.
    """

    walls: Quads = field(default_factory=Quads)
    dark: Quads = field(default_factory=Quads)
    lit: Quads = field(default_factory=Quads)
    shops: Quads = field(default_factory=Quads)

    def build(self, frame: Wall, begin: float, end: float, seed: int) -> None:
        """Build houses from `begin` to `end` along a wall, the last of them as wide as
        fits.
        """
        rng = np.random.Generator(np.random.PCG64(seed))
        before = -1
        while end - begin > paint.BAY:
            bays = min(int(rng.integers(3, 7)), int((end - begin) / paint.BAY))
            kind = int(rng.integers(len(paint.WALLS)))
            kind = (kind + (kind == before)) % len(paint.WALLS)
            self._house(frame, begin, bays, int(rng.integers(3, 6)), kind, rng)
            begin = begin + bays * paint.BAY
            before = kind

    def _house(
        self,
        frame: Wall,
        at: float,
        bays: int,
        floors: int,
        kind: int,
        rng: np.random.Generator,
    ) -> None:
        wide = bays * paint.BAY
        high = paint.GROUND_FLOOR + paint.FLOOR * (floors - 1) + ATTIC
        shop = bool(rng.random() < 0.55)
        door = int(rng.integers(bays))
        trim = int(rng.choice([paint.STONE, paint.WHITE, paint.GREY]))
        color = int(rng.choice([paint.WHITE, paint.WHITE, paint.DARK, paint.GREEN]))
        sign = int(rng.integers(paint.RED, len(paint.TRIMS)))
        cells: list[tuple[float, ...]] = []
        openings: list[Float64Array] = []
        for floor in range(floors):
            low = 0.0 if floor == 0 else paint.GROUND_FLOOR + paint.FLOOR * (floor - 1)
            top = low + (
                paint.GROUND_FLOOR
                if floor == 0
                else paint.FLOOR + ATTIC * (floor == floors - 1)
            )
            for bay in range(bays):
                left = at + paint.BAY * bay
                cells.append((left, left + paint.BAY, low, top))
                opening = (0.72, 1.88, 0.8, 2.55 if floor == 1 else 2.35)
                if floor == 0:
                    opening = DOOR if bay == door else SHOP if shop else WINDOW
                openings.append(np.array([left, left, low, low]) + opening)
        holes = np.array(openings)
        deep = np.where(np.arange(len(holes)) < bays, SHOP_REVEAL, REVEAL)
        self._masonry(frame, np.array(cells), holes, deep, kind)
        is_door = np.arange(len(holes)) == door
        is_shop = (np.arange(len(holes)) < bays) & ~is_door & shop
        self._windows(
            frame, holes[~is_door], deep[~is_door], is_shop[~is_door], color, rng
        )
        self._door(
            frame,
            holes[door],
            int(rng.choice([paint.GREEN, paint.RED, 5, paint.DARK, paint.WHITE])),
            trim,
        )
        left, right, low, upper = holes[bays:].T
        zero = 0.0 * left
        sills = np.column_stack(
            [left - 0.1, right + 0.1, zero, zero + 0.13, low - 0.09, low]
        )
        heads = np.column_stack(
            [left - 0.14, right + 0.14, zero, zero + 0.05, upper, upper + 0.2]
        )
        self._trim(frame, np.concatenate([sills, heads]), trim)
        end = at + wide
        mould = [(0.16, 3.72, 3.95), (0.09, 3.60, 3.72)]
        mould += [
            (0.22, high - 0.50, high - 0.36),
            (0.34, high - 0.36, high - 0.2),
            (0.46, high - 0.2, high),
        ]
        self._trim(
            frame,
            np.array([(at, end, 0.0, out, base, top) for out, base, top in mould]),
            trim,
        )
        self._trim(
            frame,
            np.array([(at, end, 0.0, 0.06, 0.0, 0.35)]),
            paint.GREY,
            faces=(FRONT, TOP),
        )
        if shop:
            first, last = (
                (at + paint.BAY * (door + 1), end)
                if door < bays / 2
                else (at, at + paint.BAY * door)
            )
            if last - first > 1.0:
                self._trim(
                    frame,
                    np.array([(first + 0.2, last - 0.2, 0.0, 0.14, 3.02, 3.52)]),
                    sign,
                )
                if rng.random() < 0.5:
                    self._awning(
                        frame,
                        first + 0.25,
                        last - 0.25,
                        int(rng.integers(paint.RED, len(paint.TRIMS))),
                    )
        self._roof(frame, at, end, high, kind, rng)

    def _masonry(
        self,
        frame: Wall,
        cells: Float64Array,
        holes: Float64Array,
        deep: Float64Array,
        kind: int,
    ) -> None:
        left, right, low, high = cells.T
        in_left, in_right, in_low, in_high = holes.T
        around = np.concatenate(
            [
                np.stack([left, in_left, low, high], 1), np.stack([in_right, right, low, high], 1),
                np.stack([in_left, in_right, low, in_low], 1), np.stack([in_left, in_right, in_high, high], 1),
            ]
        )  # fmt: skip
        around = around[around[:, 3] - around[:, 2] > 1e-6]
        uvs = np.column_stack(
            [around[:, :2] / paint.PERIOD, paint.wall_row(kind, around[:, 2:])]
        )
        self.walls.wall(frame, around, 0.0, uvs)
        zero = 0.0 * in_left
        u = (
            np.stack([in_left, in_left, in_left + deep, in_left + deep], 1)
            / paint.PERIOD
        )
        out = np.stack([zero, zero, -deep, -deep], 1)
        up = np.stack([in_low, in_high, in_high, in_low], 1)
        for at, turn in ((in_left, -1), (in_right, 1)):  # the reveals
            self.walls.at(
                frame,
                at[:, None],
                out,
                up,
                np.stack([u, paint.wall_row(kind, up)], -1),
                turn,
            )
        along = np.stack([in_left, in_right, in_right, in_left], 1)
        for at, turn in ((in_low, 1), (in_high, -1)):
            v = paint.wall_row(kind, at[:, None] + 0.3 * out)
            self.walls.at(
                frame,
                along,
                out,
                at[:, None],
                np.stack([along / paint.PERIOD, v], -1),
                turn,
            )

    def _windows(
        self,
        frame: Wall,
        holes: Float64Array,
        deep: Float64Array,
        shop: BoolArray,
        color: int,
        rng: np.random.Generator,
    ) -> None:
        kinds = np.where(
            shop,
            rng.integers(paint.PANES // 2, paint.PANES, len(holes)),
            rng.integers(0, paint.PANES // 2, len(holes)),
        )
        uvs = np.column_stack(
            [
                kinds / paint.PANES + 0.004,
                (kinds + 1) / paint.PANES - 0.004,
                0 * kinds + 0.01,
                0 * kinds + 0.99,
            ]
        )
        lit = ~shop & (rng.random(len(holes)) < LIT)
        for panes, chosen in (
            (self.shops, shop),
            (self.lit, lit),
            (self.dark, ~shop & ~lit),
        ):
            if chosen.any():
                panes.wall(frame, holes[chosen], -deep[chosen], uvs[chosen])
        left, right, low, high = holes.T
        middle = (left + right) / 2.0
        bar = np.where(shop, 0.05, 0.065)
        across = low + 0.7 * (high - low)
        bars = [
            (left, left + bar, low, high), (right - bar, right, low, high), (left, right, low, low + bar),
            (left, right, high - bar, high), (middle - bar / 2, middle + bar / 2, low, high),
            (left, right, across - bar / 2.5, across + bar / 2.5),
        ]  # fmt: skip
        rows = [
            np.column_stack([x0, x1, -deep, 0.045 - deep, z0, z1])
            for x0, x1, z0, z1 in bars
        ]
        self._trim(frame, np.concatenate(rows), color, faces=(FRONT,))

    def _door(self, frame: Wall, hole: Float64Array, color: int, trim: int) -> None:
        left, right, low, high = hole
        back = 0.01 - SHOP_REVEAL
        boxes = [(left, right, back - 0.05, back, low, high)]
        for row, top in ((0.25, 0.95), (1.1, 2.0)):
            for at in (left + 0.14, left + 0.66):
                boxes.append((at, at + 0.4, back, back + 0.025, low + row, low + top))
        self._trim(frame, np.array(boxes), color)
        around = [
            (left - 0.16, left, 0.0, 0.07, low, high + 0.16),
            (right, right + 0.16, 0.0, 0.07, low, high + 0.16),
        ]
        around += [
            (left - 0.24, right + 0.24, 0.0, 0.2, high + 0.16, high + 0.32),
            (left, right, 0.0, 0.07, high, high + 0.16), (left - 0.2, right + 0.2, 0.0, 0.34, low, low + 0.13),
        ]  # fmt: skip
        self._trim(frame, np.array(around), trim)

    def _awning(self, frame: Wall, left: float, right: float, kind: int) -> None:
        along = np.array([[left, right, right, left]])
        out = np.array([[1.15, 1.15, 0.14, 0.14]])
        up = np.array([[2.45, 2.45, 2.98, 2.98]])
        low, high = paint.trim_rows(kind, 0.5)
        uvs = np.stack(
            [along / paint.PERIOD, np.array([[low, low, high, high]])], axis=-1
        )
        self.walls.at(frame, along, out, up, uvs)
        self.walls.at(frame, along[:, ::-1], out[:, ::-1], up[:, ::-1] - 0.01, uvs)
        self._trim(
            frame,
            np.array([(left, right, 1.14, 1.15, 2.25, 2.45)]),
            kind,
            faces=(FRONT,),
        )

    def _roof(
        self,
        frame: Wall,
        left: float,
        right: float,
        high: float,
        kind: int,
        rng: np.random.Generator,
    ) -> None:
        ridge = high + float(rng.uniform(2.0, 3.4))
        low, top = paint.tile_rows(5.0)
        along = np.array([[left, right, right, left]])
        up = np.array([[high, high, ridge, ridge]])
        uvs = np.stack(
            [along / paint.PERIOD, np.array([[low, low, top, top]])], axis=-1
        )
        for edge, turn in ((0.46, 1), (-DEPTH, -1)):
            out = np.array([[edge, edge, -DEPTH / 2.0, -DEPTH / 2.0]])
            self.walls.at(frame, along, out, up, uvs, turn)
        for at, turn in ((left, -1), (right, 1)):  # gables, down to the ground
            out = np.array(
                [[0.0, -DEPTH, -DEPTH, 0.0], [0.0, -DEPTH, -DEPTH / 2.0, 0.0]]
            )
            up = np.array([[0.0, 0.0, high, high], [high, high, ridge, high]])
            uvs = np.stack(
                [
                    -out / paint.PERIOD,
                    paint.wall_row(
                        kind, np.minimum(0.4 * up + paint.GROUND_FLOOR, 16.9)
                    ),
                ],
                axis=-1,
            )
            self.walls.at(frame, np.array(at), out, up, uvs, turn)
        back = np.array([[right, left, left, right]])
        up = np.array([[0.0, 0.0, high, high]])
        uvs = np.stack(
            [back / paint.PERIOD, paint.wall_row(kind, 0.7 * up + paint.GROUND_FLOOR)],
            axis=-1,
        )
        self.walls.at(frame, back, np.array(-DEPTH), up, uvs)
        for place in rng.uniform(left + 1.0, right - 1.0, 2):
            chimney = (place - 0.45, place + 0.45, -6.2, -5.4, ridge - 0.6, ridge + 1.1)
            self._trim(frame, np.array([chimney]), paint.RED, (FRONT, SIDES, TOP))

    def _trim(
        self, frame: Wall, rows: Float64Array, kind: int, faces: tuple[str, ...] = SHOWN
    ) -> None:
        low, high = paint.trim_rows(kind, rows[:, 5] - rows[:, 4])
        self.walls.boxes(
            frame,
            rows,
            np.column_stack([rows[:, :2] / paint.PERIOD, low + 0.0 * high, high]),
            faces,
        )
