"""``hf:REPOSITORY``: networks of transformers, from the Hugging Face hub or a folder, in safetensors only."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from advsearch.errors import ModelError
from advsearch.files import parse_json, read_text
from advsearch.models.labels import LARGEST
from advsearch.models.preprocessing import Triple
from advsearch.models.source import Source, source_of
from advsearch.models.zoo.library import library, reading

KINDS = {
    "ForImageClassification": "AutoModelForImageClassification",
    "ForSemanticSegmentation": "AutoModelForSemanticSegmentation",
    "ForObjectDetection": "AutoModelForObjectDetection",
}
"""What an architecture may end with, and what builds it."""
ADVICE = "Give a folder that save_pretrained(..., safe_serialization=True) has made as 'hf:FOLDER'"


def load(spec: str) -> Source:
    """Return ``hf:REPOSITORY[@REVISION]`` or ``hf:FOLDER``: a network that classifies, segments or finds objects.

    Its size, normalisation and labels are those that it was published with. Code in a repository is never run, and
    weights are read from safetensors alone.

    Raises:
        ModelError: transformers is missing, the repository cannot be had, or its network is of another kind.
    """
    name, _, revision = spec.partition(":")[2].strip().partition("@")
    transformers = library("transformers", spec, "hf")
    if Path(name).is_dir():
        name = str(Path(name).resolve())
    if not sys.stderr.isatty():
        transformers.utils.logging.disable_progress_bar()
    where = {"revision": revision} if revision else {}
    with reading(spec, ADVICE):
        config = transformers.AutoConfig.from_pretrained(name, trust_remote_code=False, **where)
        architecture = str((getattr(config, "architectures", None) or ["none"])[0])
        kind = next((kind for kind in KINDS if architecture.endswith(kind)), None)
        if kind is None:
            endings = ", ".join(KINDS)
            raise ModelError(f"model {spec}: is a {architecture}; expected a network that ends with one of {endings}")
        maker = getattr(transformers, KINDS[kind])
        network = maker.from_pretrained(name, use_safetensors=True, trust_remote_code=False, **where)
        described = _described(transformers, name, where)
    labels = getattr(config, "id2label", None) or {}
    names = tuple(str(labels[key]) for key in sorted(labels, key=int))
    wrapped: dict[str, Callable[[], nn.Module]] = {
        "ForImageClassification": lambda: _Classifier(network),
        "ForSemanticSegmentation": lambda: _Segmenter(network),
        "ForObjectDetection": lambda: _Detector(network, len(names)),
    }
    module = wrapped[kind]()
    return source_of(module, name.rstrip("/").rpartition("/")[2], labels=names or None, **described)


class _Classifier(nn.Module):
    """Logits (N, classes)."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, images: Tensor) -> Tensor:
        logits: Tensor = self.network(pixel_values=images).logits
        return logits


class _Segmenter(_Classifier):
    """Logits (N, classes, H, W) of each pixel of the input."""

    def forward(self, images: Tensor) -> Tensor:
        return functional.interpolate(super().forward(images), size=images.shape[2:], mode="bilinear")


class _Detector(nn.Module):
    """Boxes (N, queries, 4) in pixels, x0 y0 x1 y1, and scores (N, queries, classes) in [0, 1], overlapping ones too.

    Networks whose last class stands for "nothing" choose one class for each box (Carion et al. 2020); the others judge
    each class by itself.
    """

    def __init__(self, network: nn.Module, classes: int) -> None:
        super().__init__()
        self.network, self.classes = network, classes

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        answer = self.network(pixel_values=images)
        height, width = images.shape[2:]
        middle, size = answer.pred_boxes.split(2, dim=-1)
        corners = torch.cat([middle - size / 2, middle + size / 2], dim=-1)
        boxes = corners * corners.new_tensor([width, height, width, height])
        if answer.logits.shape[-1] > self.classes:
            return boxes, answer.logits.softmax(dim=-1)[..., :-1]
        return boxes, answer.logits.sigmoid()


def _described(transformers: Any, name: str, where: Mapping[str, str]) -> dict[str, tuple[int, int] | Triple]:
    """Return the fields of `Source` that the preprocessing of a repository tells."""
    path = transformers.utils.cached_file(
        name, "preprocessor_config.json", _raise_exceptions_for_missing_entries=False, **where
    )
    told = {} if path is None else parse_json(read_text(Path(path), "a preprocessing in JSON", LARGEST))
    fields: dict[str, tuple[int, int] | Triple] = {}
    size = _sides(told.get("crop_size") if told.get("do_center_crop") else None) or _sides(told.get("size"))
    if size is not None:
        fields["input_size"] = size
    if told.get("do_normalize", True):
        for field, key in (("mean", "image_mean"), ("std", "image_std")):
            numbers = told.get(key)
            if isinstance(numbers, list) and len(numbers) == 3:
                fields[field] = (float(numbers[0]), float(numbers[1]), float(numbers[2]))
    return fields


def _sides(size: Any) -> tuple[int, int] | None:
    """Return height and width of what a preprocessing calls a size: a number, both sides, or the shorter one."""
    if isinstance(size, dict):
        shorter = size.get("shortest_edge")
        height, width = size.get("height", shorter), size.get("width", shorter)
    else:
        height = width = size
    if isinstance(height, int) and isinstance(width, int) and min(height, width) > 0:
        return height, width
    return None
