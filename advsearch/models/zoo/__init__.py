"""Load networks of libraries by name: ``torchvision:resnet50``, ``timm:resnet50``,
``hf:OWNER/REPOSITORY``.

A library is imported only if one of its networks is requested. It loads the weights
from its cache on this machine, or else downloads them from where it publishes them.
They are read without unpickling.
"""

from __future__ import annotations

from advsearch.models.zoo.outputs import find_timm_source as recognize_timm
from advsearch.models.zoo.outputs import load_timm as load_timm
from advsearch.models.zoo.outputs import load_torchvision as load_torchvision
from advsearch.models.zoo.transformers import (
    find_transformers_source as recognize_transformers,
)
from advsearch.models.zoo.transformers import load as load_transformers

__all__ = [
    "load_timm",
    "load_torchvision",
    "load_transformers",
    "recognize_timm",
    "recognize_transformers",
]
