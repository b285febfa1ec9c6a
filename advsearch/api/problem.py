"""What a search works on: a scene, a model, a space and an objective, joined into the calls that `attacks` asks for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from advsearch import seeds
from advsearch.attacks import Block, Domain, Evaluate, Evaluation, Objective, Trial, margin, succeeded
from advsearch.controls import Space
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
        blocks = tuple(
            Block(len(control.start), control.budget.norm, control.budget.epsilon, name=control.name)  # type: ignore[arg-type]
            for control in self.space.controls
        )
        self.domain = Domain(self.space.start, blocks)

    def evaluator(self, stream: str, on_image: OnImage | None = None) -> Evaluate:
        """Return the evaluation of configurations whose noise comes from one stream of seeds."""

        def evaluate(u: Tensor, *, index: int, gradient: bool) -> Evaluation:
            noise = seeds.stream(self.seed, stream, index)
            with torch.set_grad_enabled(gradient):
                at = u.clone().requires_grad_(gradient)
                image = self.renderer(at, seed=noise, spp=self.spp)
                logits = self.model(image)
                value = self.objective(logits, image[None], self.labels.indices)[0]
            before = self.renderer.non_finite
            derivative = torch.autograd.grad(value, at)[0] if gradient else None
            if on_image is not None:
                on_image(index, image.detach())
            return Evaluation(
                objective=float(value.detach()),
                gradient=derivative,
                logits=logits.detach()[0],
                success=bool(succeeded(logits.detach(), self.labels.indices)[0]),
                non_finite=self.renderer.non_finite - before,
            )

        return evaluate

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
