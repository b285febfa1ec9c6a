"""Several models as one, which is shown a picture and answers with the outputs of all."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, final

from torch import Tensor

from advsearch.models.model import Model, Preprocessing, joined

Outputs = tuple[Any, ...]
"""What each of several models answers to one picture."""


@final
class Ensemble:
    """Asks several models; what `Model.module` is of `together`.

    Args:
        models: at least one; each resizes and normalises for itself.
    """

    def __init__(self, models: Sequence[Model]) -> None:
        self.models = tuple(models)

    def __call__(self, images: Tensor) -> list[Any]:
        """Return the output of each model for pictures (N, H, W, 3) sRGB in [0, 1]."""
        return [model(images) for model in self.models]


def together(models: Sequence[Model], size: tuple[int, int] | None = None) -> Model:
    """Return several models as one, whose output is a list with a tuple of the models' outputs for each picture.

    Args:
        models: at least one.
        size: (height, width) in pixels of the pictures; None for the largest that a model takes.
    """
    high, wide = (max(model.input_size[side] for model in models) for side in (0, 1))
    return Model(
        module=Ensemble(models),
        name=" and ".join(model.name for model in models),
        labels=(),
        preprocessing=Preprocessing(size or (high, wide), layout="NHWC"),
        differentiable=all(model.differentiable for model in models),
        read=by_picture,
    )


def by_picture(answer: list[Any], count: int) -> list[Outputs]:
    """Return the outputs by picture of `count` pictures, from those by model."""
    return [tuple(output[k : k + 1] for output in answer) for k in range(count)]


def of_each(outputs: Sequence[Outputs]) -> list[Any]:
    """Return the output of each model for N pictures, from what each of them got."""
    return [joined(parts) for parts in zip(*outputs, strict=True)]
