"""What a search works on: a scene, a model, a space and an objective, joined into the calls that `attacks` asks for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from advsearch import seeds
from advsearch.attacks import Block, Domain, Evaluate, Evaluation, Objective, Trial, margin, succeeded
from advsearch.attacks.evaluation import Wanted
from advsearch.controls import Group, Space
from advsearch.models import LabelSet, Model
from advsearch.scene.formation import to_8_bit
from advsearch.scene.renderer import Renderer

OnImage = Callable[[int, Tensor], None]
"""Called with the index and the picture of every evaluation."""


@dataclass
class Problem:
    """The joint of rendering, model and search.

    Attributes:
        renderer: `render(u, seed, spp)`.
        space: the controls behind u.
        model: the network under test.
        labels: the right answers.
        objective: what is maximised.
        spp: samples a pixel while searching.
        seed: root of every stream.
        domain: where a search may look.
    """

    renderer: Renderer
    space: Space
    model: Model
    labels: LabelSet
    objective: Objective
    spp: int
    seed: int
    domain: Domain = field(init=False)

    def __post_init__(self) -> None:
        self.refresh()

    def refresh(self) -> None:
        """Make the domain anew, after the gradient plan has changed."""
        blocks = tuple(_block(control.name, group) for control, group in self.space.groups)
        self.domain = Domain(self.space.start, blocks, gradient_cost=self.renderer.plan.renders, partial_gradients=True)

    def evaluator(self, stream: str, on_image: OnImage | None = None) -> Evaluate:
        """Return the evaluation of configurations whose noise comes from one stream of seeds."""

        def evaluate(u: Tensor, *, index: int, gradient: Wanted) -> Evaluation:
            noise = seeds.stream(self.seed, stream, index)
            before, renders = self.renderer.non_finite, self.renderer.renders
            seen: list[tuple[Tensor, Tensor]] = []

            def loss(image: Tensor) -> Tensor:
                value, logits = self._judge(image)
                seen.append((image.detach(), logits.detach()))
                return value

            if gradient:
                value, derivative = self.renderer.gradient(loss, u, noise, self.spp, free=gradient == "free")
            else:
                derivative = None
                with torch.no_grad():
                    value = loss(self.renderer(u, seed=noise, spp=self.spp))
            image, logits = seen[0]
            if on_image is not None:
                on_image(index, image)
            return Evaluation(
                objective=float(value),
                gradient=derivative,
                logits=logits[0],
                success=bool(succeeded(logits, self.labels.indices)[0]),
                non_finite=self.renderer.non_finite - before,
                cost=self.renderer.renders - renders,
            )

        return evaluate

    def _judge(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """The objective of a picture (H, W, 3), and the logits (1, C) behind it."""
        logits = self.model(image)
        return self.objective(logits, image[None], self.labels.indices)[0], logits

    def loss(self, image: Tensor) -> Tensor:
        """The objective of a picture (H, W, 3) sRGB, as a number with a graph."""
        return self._judge(image)[0]

    def picture(self, u: Tensor, seed: int, spp: int) -> Tensor:
        """Render a configuration as a file would hold it: (H, W, 3) sRGB in [0, 1], rounded to 8 bits."""
        with torch.no_grad():
            return to_8_bit(self.renderer(u, seed=seed, spp=spp))

    def trial(self, u: Tensor, seed: int, spp: int) -> Trial:
        """Render, round to 8 bits, classify: one trial of a verification."""
        with torch.no_grad():
            image = self.picture(u, seed, spp)
            logits = self.model(image)
        worst = float(margin(logits, image[None], self.labels.indices)[0])
        probabilities = logits[0].softmax(dim=0)
        predicted = int(probabilities.argmax())
        return Trial(worst, predicted, float(probabilities[predicted]))


def _block(name: str, group: Group) -> Block:
    budget = group.budget
    return Block(
        group.size,
        budget.norm,  # type: ignore[arg-type]
        budget.epsilon,
        periodic=group.periodic,
        name=name,
        options=group.options,
    )
