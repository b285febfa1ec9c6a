"""Pictures of a sweep that differ in light alone: put together from basis pictures, once these pay (docs/transport.md).

A group is a pose, say, under all of its light, and has basis pictures of its own.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from advsearch.engine.sweeps.predicting import PAYS, SweptPredictor
from advsearch.engine.transport import CHECK_SPP, Deviation, deviation_under_light
from advsearch.files import scaled
from advsearch.scene.transport.lights import NOISE, BasisRenderer, Lights, lighting
from advsearch.scene.transport.renderer import MOST_BYTES, SPP


@dataclass
class SweptLight(SweptPredictor):
    """Predicts pictures of one scene at one size from basis pictures."""

    way: ClassVar[str] = "basis pictures"
    samples: ClassVar[int] = SPP
    checks: ClassVar[tuple[int, int]] = (3, 1)
    for_a_check: ClassVar[int] = 2

    def _follows(self) -> frozenset[str]:
        self._moving, self._lights = lighting(self.renderer), 0
        return frozenset(self._moving.groups)

    def _reason(self) -> str | None:
        if not any(self._moving.groups.values()):
            return ""
        if not self.specialise:
            return "nothing is left out"
        if self.renderer.formation.denoiser != "oidn":
            return NOISE
        groups, inputs = self._groups, self.renderer.scene.assembly(self.renderer.space.inputs(self.renderer.start))
        self._lights = len(Lights(self.renderer, self._moving, inputs).alone)
        samples = self._lights * SPP + self._checks * (CHECK_SPP + self.spp)
        least = math.ceil(PAYS * samples / self.spp)
        if groups.size < least:
            return f"basis pictures pay where {least} pictures or more differ in light alone; here {groups.size} do"
        height, width = self.renderer.formation.resolution
        if groups.at_once * self._lights * 8 * height * width > scaled(MOST_BYTES):
            return f"basis pictures of {groups.count} groups take too much memory; make light the last axes of the grid"
        return None

    @property
    def _traced(self) -> int:
        return self._lights

    @property
    def _bytes(self) -> int:
        return sum(one.bytes for one in self._held.values() if one is not None)

    @property
    def not_finite(self) -> int:
        return sum(one.non_finite for one in self._held.values() if one is not None)

    def _made(self, u: Tensor, seed: int) -> BasisRenderer:
        return BasisRenderer(self.renderer, u, seed, moving=self._moving)

    def _predicted(self, made: BasisRenderer, us: Sequence[Tensor]) -> list[Tensor]:
        return [made(u) for u in us]

    def _compared(self, made: BasisRenderer, shown: Sequence[tuple[Tensor, int]]) -> list[Deviation]:
        found = []
        for u, seed in shown:

            def loss(picture: Tensor, u: Tensor = u) -> float:
                return self.score(picture, u)

            found.append(deviation_under_light(self.renderer, loss, made, u, seed, self.spp))
        return found
