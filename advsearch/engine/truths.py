"""What is true of the configurations of a search, remembered where only base colours tell them apart."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import torch
from torch import Tensor

from advsearch.controls import Space
from advsearch.engine.answers import Described, Looked
from advsearch.scene.renderer import Renderer
from advsearch.scene.transport.renderer import linear_inputs
from advsearch.tasks import Facts, Task
from advsearch.tasks.base import Truth

MOST_NUMBERS, MOST = 64, 512
"""Numbers, beside base colours, of a configuration whose truth is remembered; and truths that are."""


@dataclass
class KnownTruths:
    """What is true of configurations.

    Attributes:
        task: says what is true.
        space: of the configurations.
        renderer: of the scene.
        facts: what the scene gives the task to judge by, from what describes the configuration and what looks at it.
    """

    task: Task
    space: Space
    renderer: Renderer
    facts: Callable[[Described, Looked], Facts]
    _kept: dict[bytes, Truth] = field(default_factory=dict)

    def at(self, whole: Tensor) -> Truth:
        """Return what is true at (d,) of the whole space. What the camera sees first has nothing to do with base
        colours, so that a truth is remembered where the rest is a few numbers, unless the task asks for numbers."""
        rest = whole.detach()[self._rest]
        key = rest.numpy().tobytes()
        if key in self._kept:
            return self._kept[key]
        facts = self.facts(lambda: self.space.describe(whole), lambda: self.renderer.surfaces(whole))
        truth = self.task.truth(facts)
        if len(rest) <= MOST_NUMBERS and "numbers" not in vars(facts):
            while len(self._kept) >= MOST:
                del self._kept[next(iter(self._kept))]
            self._kept[key] = truth
        return truth

    @cached_property
    def _rest(self) -> Tensor:
        """Which coordinates do more than to colour surfaces, (d,) bool."""
        linear, rest = linear_inputs(self.renderer), torch.ones(len(self.space.start), dtype=torch.bool)
        for group in self.space.groups:
            route = self.renderer.routes.get(group.name)
            rest[group.coordinates] = not route or not route <= linear
        return rest
