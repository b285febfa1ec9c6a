"""Networks by the name that a library gives them: ``torchvision:resnet50``,
``timm:resnet50``, ``hf:OWNER/REPOSITORY``.

Each library is imported when one of its networks is asked for, and not before. It
brings the weights, as it does for anybody: from its cache on this machine, else from
where it publishes them. They are read without unpickling.
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
