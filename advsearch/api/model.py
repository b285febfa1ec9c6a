"""`load_model`, to which a task may be named."""

from __future__ import annotations

import inspect
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypedDict

from torch import nn

from advsearch import models
from advsearch.models import Model
from advsearch.tasks import AnyTask, make_task

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from advsearch.models.model import Read


class ModelKeywords(TypedDict, total=False):
    """What may be said of a model, see `advsearch.models.load_model`."""

    labels: str | os.PathLike[str] | Sequence[str] | None
    prompt: str | Sequence[str] | None
    name: str | None
    input_size: int | Sequence[int] | str | None
    mean: float | Sequence[float] | str | None
    std: float | Sequence[float] | str | None
    value_range: Sequence[float] | str | None
    layout: str | None
    channels: str | None
    max_batch: int | None
    read: Read | None


def load_model(
    spec: str | Path | nn.Module | Model, *, task: AnyTask | None = None, **options: Unpack[ModelKeywords]
) -> Model:
    return models.load_model(spec, task=None if task is None else make_task(task), **options)


load_model.__doc__ = models.load_model.__doc__
load_model.__signature__ = inspect.signature(models.load_model)  # type: ignore[attr-defined]
