"""What a search maximises, for one model or for several at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal

import torch
from torch import Tensor

from advsearch.attacks import Objective, get_objective
from advsearch.attacks.objectives import OBJECTIVE_KINDS
from advsearch.attacks.own_objective import More, nothing_more
from advsearch.errors import InputError
from advsearch.models import Model
from advsearch.models.ensemble import Ensemble, Outputs, of_each
from advsearch.models.features import features_of
from advsearch.scene.renderer import Renderer
from advsearch.tasks import Task
from advsearch.tasks.together import Together

AnyObjective = str | Callable[..., Tensor]
"""An objective: its name, or the user's own function."""

Way = Literal["mean", "worst"]
"""How the objectives of several models are put together."""

CLEAN_SPP = 64
"""Samples a pixel of the clean picture that an objective compares features with."""


def task_for(task: Task, model: Model) -> Task:
    """Return the task, or that of several models where the model is an ensemble of them."""
    if isinstance(task, Together) or not isinstance(model.module, Ensemble):
        return task
    return Together(parts=(task,) * len(model.module.models))


def objective_for(
    wanted: AnyObjective,
    task: Task,
    model: Model,
    renderer: Renderer,
    seed: int,
    ensemble: Way | None = None,
) -> tuple[Objective, str]:
    """Return what is maximised, and what there is to say about it; one of features is shown the clean picture first.

    Args:
        wanted: its name, or the user's own function.
        task: on the model.
        model: that is attacked.
        renderer: of the whole space.
        seed: of the clean picture.
        ensemble: how the objectives of several models are put together; None for the mean, or the least of those of
            several tasks, whose units differ.

    Raises:
        InputError: an objective of features, of several models.
    """
    kind = OBJECTIVE_KINDS.get(wanted) if isinstance(wanted, str) else None
    of_features = kind is not None and kind.needs_features
    if isinstance(task, Together):
        if of_features:
            raise InputError(f"objective: {wanted} compares the features of one model; take another for `ensemble`")
        own = wanted == Together.objective
        each = [get_objective(one.objective if own else wanted, one) for one in task.tasks]
        return of_ensemble(each, ensemble or ("worst" if own else "mean")), ""
    if not of_features:
        return get_objective(wanted, task), ""
    features = features_of(model) if task.reads_logits else None  # otherwise they are what the model answers with
    with torch.no_grad():
        clean = renderer(renderer.start, seed=seed, spp=CLEAN_SPP)
    note = "" if features is None or features.penultimate else features.source
    return get_objective(wanted, task, features=features or model, clean=clean), note


def of_ensemble(objectives: Sequence[Objective], way: Way) -> Objective:
    """Return the objective of several models: the mean of theirs, or the least of them.

    With "worst" the model that is hardest to mislead is the one that counts, so that the maximum is over 0 only where
    every model is misled. The mean may be large because of one model; its gradient reaches all of them.

    Args:
        objectives: of each model, with its own truth.
        way: "mean" or "worst".
    """

    def objective(
        output: Sequence[Outputs], images: Tensor, truth: tuple[Any, ...], more: More = nothing_more, /
    ) -> Tensor:
        each = zip(objectives, of_each(output), truth, strict=True)
        values = torch.stack([one(own, images, right, more) for one, own, right in each])
        return values.mean(dim=0) if way == "mean" else values.amin(dim=0)

    return objective
