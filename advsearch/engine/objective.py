"""What a search maximises, over which domain, and what `printable` takes from it: how rough colours are, and how far
from ink (Sharif et al. 2016, *Accessorize to a Crime*, sections 5.2.2 and 5.2.3). Theirs are sums over pixels, and a
product of distances to all printable colours; these are means, and the distance to the nearest, which is zero at the
same colours."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from advsearch.attacks import Block, Domain, Evaluation, Objective, get_objective
from advsearch.attacks.objectives import OBJECTIVE_KINDS, More, nothing_more
from advsearch.controls import Space
from advsearch.controls.base import Control
from advsearch.errors import InputError, UnknownNameError
from advsearch.models import Model
from advsearch.models.features import features_of
from advsearch.runs.results import PrintTerms
from advsearch.scene.renderer import Renderer
from advsearch.tasks import Task
from advsearch.tasks.together import Ensemble, Outputs, Together, of_each


def domain_of(controls: Sequence[Control], start: Tensor | None = None, **more: Any) -> Domain:
    """Return where a search over some controls may look: the budgets of all their groups, in the order of u, from
    `start` (d,) or the controls' own, which leaves the scene as it is; with `more` fields of `Domain`."""
    blocks = tuple(
        Block(
            group.size,
            group.budget.norm,  # type: ignore[arg-type]
            group.budget.epsilon,
            periodic=group.periodic,
            name=f"{control.name}.{group.parameter}",
            options=group.options,
        )
        for control in controls
        for group in control.groups
    )
    if start is None:
        start = torch.cat([control.start for control in controls]) if controls else torch.zeros(0)
    return Domain(start, blocks, **more)


class Named(Mapping[str, Tensor]):
    """Tensors (N, ...) of N configurations by name; a message says `what` a name stands for that is none."""

    def __init__(self, what: str, each: Sequence[Mapping[str, Tensor]]) -> None:
        self._what, self._each = what, each

    def __getitem__(self, name: str) -> Tensor:
        if name not in self:  # also of `get`
            raise UnknownNameError(self._what, name, self._each[0])
        return torch.stack([tensors[name] for tensors in self._each])

    def __contains__(self, name: object) -> bool:
        return name in self._each[0]

    def __iter__(self) -> Iterator[str]:
        return iter(self._each[0])

    def __len__(self) -> int:
        return len(self._each[0])


class ConfigurationInputs:
    """Gives what is asked for at N configurations (d,) of the whole space, which differ in nothing that is searched;
    `used` says whether anything was. The searched controls come first there."""

    def __init__(self, space: Space, searched: Space, wholes: Sequence[Tensor]) -> None:
        self._space, self._searched, self._wholes = space, searched, wholes
        self.used = False

    def __call__(self, name: str) -> Any:
        """Return what an objective asks for by name: "u", (N, d) of the searched controls; "texture", (N, h, w, 3)
        display-referred sRGB in [0, 1], the searched colours of the control that has some, or (N, h, w, 4) with 1 where
        they are searched and 0 elsewhere; "textures", the same by control, where several have some; "inputs", the scene
        inputs by name; "configuration", the numbers by parameter."""
        self.used = True
        if name == "inputs":
            return Named("input of the scene", [self._space.inputs(whole) for whole in self._wholes])
        if name == "configuration":
            return Named("number of the configuration", [self._space.numbers(whole) for whole in self._wholes])
        u = self._wholes[0][: len(self._searched.start)]
        if name == "u":
            return u.expand(len(self._wholes), *u.shape)
        printed = self._searched.printed(u)
        if name == "textures":
            return Named("control whose colours are searched:", [printed] * len(self._wholes))
        if len(printed) != 1:
            got = ", ".join(printed or (control.name for control in self._searched.controls)) or "nothing"
            instead = "ask for `textures`, which has them by name" if printed else "add `texture` or `patch`"
            raise InputError(
                f"objective: it asks for `texture`, so it needs one control whose colours are searched, got {got}; "
                f"{instead}"
            )
        (colors,) = printed.values()
        return colors.expand(len(self._wholes), *colors.shape)


LOW, HIGH, STEP = 0.1, 0.9, 0.2
"""The printable colours: all 125 of which each channel is 0.1, 0.3, 0.5, 0.7 or 0.9 in sRGB. No printer was measured:
that ink on paper reaches neither the black, nor the white, nor the pure colours of a screen is all that they say."""
WEIGHT = 10.0  # of either term, in the objective's unit (logits for a margin) per unit of sRGB
LEAST = 2.0**-40  # shortest step in sRGB that has a gradient


def variation(colors: Tensor) -> Tensor:
    """Return the mean length of the step from a pixel (h, w, 3) to its right and lower neighbours, by channel; of a
    picture (h, w, 4) only between pixels that its last channel has."""
    colors, there = colors[..., :3], colors[..., 3:]
    right, down = colors.diff(dim=1), colors.diff(dim=0)
    if there.shape[-1]:
        right, down = right * there[:, 1:], down * there[1:]
    squared = F.pad(right.square(), (0, 0, 0, 1)) + F.pad(down.square(), (0, 0, 0, 0, 0, 1))
    length = squared.clamp(min=LEAST**2).sqrt() - LEAST
    return length[there[..., 0] > 0.0].mean() if there.shape[-1] else length.mean()


def off_print(colors: Tensor, palette: Tensor | None = None) -> Tensor:
    """Return the mean Euclidean distance in sRGB of pixels (h, w, 3) from the nearest printable colour, of a palette
    (P, 3) where one is given; of a picture (h, w, 4) of those that its last channel has."""
    colors = colors if colors.shape[-1] == 3 else colors[colors[..., 3] > 0][:, None, :3]
    if palette is None:
        nearest = (LOW + STEP * ((colors.detach() - LOW) / STEP).round()).clamp(LOW, HIGH)
    else:
        palette = palette.to(colors)
        nearest = palette[torch.cdist(colors.detach().reshape(-1, 3), palette).argmin(dim=1)].reshape(colors.shape)
    distance: Tensor = torch.linalg.vector_norm(colors - nearest, dim=2).mean()
    return distance


def _terms(space: Space, u: Tensor) -> tuple[Tensor, Tensor]:
    printed = list(space.printed(u).values())
    if not printed:
        raise InputError(
            "printable: expected a search over the colours of a texture or a patch, got "
            f"{', '.join(control.name for control in space.controls)}; add `texture` or `patch`, or leave it out"
        )
    return torch.stack(list(map(variation, printed))).sum(), torch.stack(list(map(off_print, printed))).sum()


def print_terms(space: Space, u: Tensor) -> PrintTerms:
    """Return both terms of a configuration (d,), without their weight."""
    with torch.no_grad():
        rough, off = _terms(space, u)
    return PrintTerms(variation=float(rough), off_print=float(off))


def penalised(found: Evaluation, space: Space, u: Tensor) -> Evaluation:
    """Return an evaluation of u whose objective is less by both weighted terms, and its derivative by theirs."""
    at = u.detach().clone().requires_grad_()
    with torch.enable_grad():
        penalty = WEIGHT * torch.stack(_terms(space, at)).sum()
        (slope,) = torch.autograd.grad(penalty, at)
    derivative = None if found.gradient is None else found.gradient - slope
    return replace(found, objective=found.objective - float(penalty.detach()), gradient=derivative)


AnyObjective = str | Callable[..., Tensor]

Way = Literal["mean", "worst"]

CLEAN_SPP = 64  # samples a pixel of the clean picture that an objective compares features with


def task_for(task: Task, model: Model) -> Task:
    """Return the task, or that of several models where the model is an ensemble of them."""
    if isinstance(task, Together) or not isinstance(model.module, Ensemble):
        return task
    return Together(parts=(task,) * len(model.module.models))


def objective_for(
    wanted: AnyObjective, task: Task, model: Model, renderer: Renderer, seed: int, ensemble: Way | None = None
) -> tuple[Objective, str]:
    """Return what is maximised, and what there is to say about it; one of features is shown the clean picture first.
    The objectives of several models are put together as `ensemble` says; without, their mean, or of several tasks,
    whose units differ, the least."""
    kind = OBJECTIVE_KINDS.get(wanted) if isinstance(wanted, str) else None
    of_features = kind is not None and kind.needs_features
    if isinstance(task, Together):
        if of_features:
            raise InputError(f"objective: {wanted} compares the features of one model; take another for `ensemble`")
        own = wanted == Together.objective
        each = [get_objective(part.objective if own else wanted, part) for part in task.tasks]
        return of_ensemble(each, ensemble or ("worst" if own else "mean")), ""
    if not of_features:
        return get_objective(wanted, task), ""
    features = features_of(model) if task.reads_logits else None  # otherwise they are what the model returns
    with torch.no_grad():
        clean = renderer(renderer.start, seed=seed, spp=CLEAN_SPP)
    note = "" if features is None or features.penultimate else features.source
    return get_objective(wanted, task, features=features or model, clean=clean), note


def of_ensemble(objectives: Sequence[Objective], way: Way) -> Objective:
    """Return the objective of several models: the mean of theirs, or the least of them.

    With "worst" the model that is hardest to mislead is the one that counts, so that the maximum is over 0 only where
    every model is misled. The mean may be large because of one model; its gradient reaches all of them.
    """

    def objective(
        output: Sequence[Outputs], images: Tensor, truth: tuple[Any, ...], more: More = nothing_more, /
    ) -> Tensor:
        each = zip(objectives, of_each(output), truth, strict=True)
        values = torch.stack([value_of(own, images, right, more) for value_of, own, right in each])
        return values.mean(dim=0) if way == "mean" else values.amin(dim=0)

    return objective
