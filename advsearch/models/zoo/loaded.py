"""What has been loaded of a network of transformers, for whatever makes a model of it."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import torch
from torch import Tensor, nn

from advsearch.models.model import ModelWarning
from advsearch.models.source import Purpose, Source, source_of
from advsearch.models.zoo.processors import Measured, measured

UNPREPARED = (
    "model {spec} comes without an image processor: pictures are given as they are, RGB in [0, 1]. Say `mean`, `std` "
    "and `input_size` of load_model if it wants them otherwise"
)


@dataclass(frozen=True, eq=False)
class Loaded:
    """A network of transformers, and what comes with it.

    Args:
        network: itself, a `PreTrainedModel`.
        name: what to call it.
        spec: what its user wrote, for messages.
        processor: its image processor; None where it has none.
        part: loads another part by the class of transformers that does it, such as "AutoTokenizer".
    """

    network: Any
    name: str
    spec: str
    processor: Any
    part: Callable[[str], Any]

    @cached_property
    def described(self) -> Measured:
        """What is done to pictures.

        Raises:
            ModelError: see `measured`.

        Warns:
            ModelWarning: it has no image processor.
        """
        if self.processor is None:
            warnings.warn(UNPREPARED.format(spec=self.spec), ModelWarning, stacklevel=4)
            return Measured()
        return measured(self.processor, self.spec)

    def source(self, module: nn.Module, **fields: Any) -> Source:
        """Return the source of a module that is given pictures as the network wants them; `fields` go to `Source`."""
        return source_of(module, self.name, **{**self.described, **fields})

    def when_named(self, named: Callable[[Any, Any, str, Measured, Purpose], Source]) -> Source:
        """Return the source of a network that reads texts, which is built when the user's names are there.

        Args:
            named: makes it of the network, its tokenizer, its name, what is done to pictures, and the purpose.
        """
        tokenizer, described = self.part("AutoTokenizer"), self.described
        side = getattr(getattr(self.network.config, "vision_config", None), "image_size", None)
        if "input_size" not in described and isinstance(side, int):
            described = Measured(**{**described, "input_size": (side, side)})
        finish = partial(named, self.network, tokenizer, self.name, described)
        return Source(self.network, self.name, finish=finish, reads_text=True)


def in_pixels(boxes: Tensor, images: Tensor) -> Tensor:
    """Return boxes (N, K, 4), middle and size as shares of images (N, 3, H, W), as corners x0 y0 x1 y1 in pixels."""
    height, width = images.shape[2:]
    middle, size = boxes.split(2, dim=-1)
    corners = torch.cat([middle - size / 2, middle + size / 2], dim=-1)
    return corners * corners.new_tensor([width, height, width, height])
