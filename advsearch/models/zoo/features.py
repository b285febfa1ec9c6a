"""Networks of transformers as what answers with features: DINOv2, ViT, the half of CLIP that sees pictures."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from torch import Tensor, nn

from advsearch.errors import InputError, ModelError
from advsearch.models.source import Purpose, Source
from advsearch.models.zoo import zero_shot
from advsearch.models.zoo.loaded import Loaded, Measured

TASK = "similarity"
"""The task that compares features."""

ENDINGS = ("Model", "ModelWithProjection")
PARTS = ("image_embeds", "pooler_output", "last_hidden_state")
"""What holds the features in answers of transformers, the best first."""

TOKENS = ("cls_token", "class_embedding", "class_token")
"""How weights of a first token are called that stands for the whole picture."""


def answers_with_features(architecture: str, network: Any) -> bool:
    """Whether a network of transformers, or the class of one, has features of a picture and no head.

    Args:
        architecture: by name, such as Dinov2Model or CLIPVisionModelWithProjection.
        network: of it, or its class; None where transformers has none.
    """
    if network is None or not architecture.endswith(ENDINGS) or zero_shot.compares(network):
        return False
    finds = "encoder_outputs" in inspect.signature(network.forward).parameters or "Detr" in architecture
    return getattr(network, "main_input_name", None) == "pixel_values" and not finds


def source(loaded: Loaded) -> Source:
    """Return the source of a network that has nothing but features."""
    return Source(loaded.network, loaded.name, finish=partial(_finished, loaded, None))


def also(plain: Callable[[Loaded], Source], *, reads_text: bool = False) -> Callable[[Loaded], Source]:
    """Return what makes the source of a network: that of its features where these are compared, else `plain`'s."""

    def made(loaded: Loaded) -> Source:
        return Source(loaded.network, loaded.name, finish=partial(_finished, loaded, plain), reads_text=reads_text)

    return made


def no_classes(name: str, what: str) -> ModelError:
    """Return the error for a network that is asked for classes and has features only.

    Args:
        name: of the model.
        what: it is, such as "is a Dinov2Model".
    """
    return ModelError(
        f"model {name}: {what}, which answers with features and has no classes: use `task={TASK}`, which compares "
        "them with those of other pictures, or give a network with a head"
    )


def _finished(loaded: Loaded, plain: Callable[[Loaded], Source] | None, purpose: Purpose) -> Source:
    if purpose.task == TASK:
        if purpose.prompts is not None:
            raise InputError(f"prompt: task {TASK} compares pictures and reads no text; leave `prompt` out")
        network = loaded.network
        part, config = network, network.config
        if zero_shot.compares(network):
            zero_shot.check_takes_pictures(network, loaded.spec)
            config = getattr(config, "vision_config", config)
        elif "ForImageClassification" in type(network).__name__:
            part = network.base_model if network.base_model is not network else getattr(network, "vision_model", None)
            if part is None:
                raise ModelError(f"model {loaded.spec}: has no part before its head; give its network without one")
        described, side = loaded.described, getattr(config, "image_size", None)
        if "input_size" not in described and isinstance(side, int):
            described = Measured(**{**described, "input_size": (side, side)})
        return loaded.source(_Features(part), **described)
    if plain is None:
        raise no_classes(loaded.name, f"is a {type(loaded.network).__name__}")
    found = plain(loaded)
    return found if found.finish is None else found.finish(purpose)


def pooled(answer: Any, *, token: bool) -> Tensor | None:
    """Return the features (N, D) in an answer of a network; None where there are none.

    Args:
        answer: a tensor (N, D), or what has one of `PARTS`. Maps (N, D, H, W) among these are averaged over their
            positions.
        token: whether the first of several tokens (N, T, D) stands for the picture; otherwise their mean does.
    """
    for part in PARTS:
        value = answer.get(part) if isinstance(answer, Mapping) else getattr(answer, part, None)
        if isinstance(value, Tensor):
            if value.dim() == 3:
                return value[:, 0] if token else value.mean(dim=1)
            return value.flatten(2).mean(dim=2) if value.dim() == 4 else value
    return answer if isinstance(answer, Tensor) else None


class _Features(nn.Module):
    """Features (N, D): those that the network gives, else the first token where that stands for the picture, else the
    mean over positions."""

    def __init__(self, network: Any) -> None:
        super().__init__()
        self.network, self.compares = network, zero_shot.compares(network)
        self.has_token = any(one in name for name, _ in network.named_parameters() for one in TOKENS)

    def forward(self, images: Tensor) -> Tensor:
        asked = self.network.get_image_features if self.compares else self.network
        answer = asked(pixel_values=images)
        found = pooled(answer, token=self.has_token)
        return answer if found is None else found
