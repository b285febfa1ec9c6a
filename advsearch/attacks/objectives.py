"""What a search maximises; what counts as success is another thing (`advsearch.tasks`, docs/objectives.md).

An objective is a callable `(output, images, truth) -> values`, the larger the nearer to what the search is after:

- output: of the model for N pictures, as its task takes it; in classification logits (N, C) float32;
- images: (N, H, W, 3) float32 that the model saw, display-referred sRGB in [0, 1];
- truth: what is true of the scene, as the task has it; in classification the indices of the label set Y, every one of
  which is a right answer;
- values: (N,), differentiable.

What `get_objective` returns is called with a fourth argument where there is a configuration: `more`, which gives what a
user's function asks for by the names of its parameters (`advsearch.attacks.own_objective`). Objectives of features, how
far a picture has moved from the clean one in the eyes of the network, are here; those of logits have a module.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, final

import torch
from torch import Tensor
from torch.nn import functional

from advsearch.attacks.logit_objectives import (
    cross_entropy,
    dlr,
    log_odds,
    margin,
    targeted_cross_entropy,
    targeted_dlr,
    targeted_log_odds,
    targeted_margin,
)
from advsearch.attacks.own_objective import More, Objective, checked, form_of, nothing_more
from advsearch.errors import InputError, UnknownNameError
from advsearch.registry import Registry
from advsearch.tasks import TASKS, Classification, Depth, Segmentation, Similarity, Task
from advsearch.tasks.classification import ClassTask
from advsearch.tasks.depth import GOALS as DEPTH_GOALS
from advsearch.tasks.detection import GOALS, Detection
from advsearch.tasks.together import Together

NEARBY = 1e-3
"""Distances under this fraction of the clean features' length count as none: the distance is rounded off there."""

ReadFeatures = Callable[[Tensor], Tensor]
"""From images (N, H, W, 3), display-referred sRGB in [0, 1], to features (N, F): what
`advsearch.models.features.features_of` returns, say."""


def feature_distance(features: ReadFeatures, clean: Tensor) -> Callable[[Tensor, Tensor, tuple[int, ...]], Tensor]:
    """How far the features of the picture lie from those of the clean one, in lengths of the clean ones.

    With f0 the features of the clean picture, e = (f - f0) / |f0|, r a fixed unit vector and h = `NEARBY`,

        sqrt(|e + h r|^2 + h^2) - sqrt(2) h,

    which is |e| to within 3 h, exactly 0 at e = 0, and has a finite gradient everywhere. The plain |e| has none at the
    clean picture, where every search starts, and |e|^2 and a smoothed |e| have their minimum there: a gradient of zero,
    which a search without noise would never leave. Hence r: at the clean picture the gradient is r / (sqrt(2) |f0|), at
    the full strength of a distance, and beyond a few h it is that of |e|. The direction of r (drawn once, from a fixed
    seed) does not matter: every direction leads away, and after the first step the distance itself shows which leads
    away fastest. With a noisy renderer the noise does the same.

    The idea is that of Sabour et al. 2016, who lead a picture's features to those of another one; here they lead away.

    It looks at no label: it needs no right answer, leads to no class in particular, and what counts as success is
    checked by the answer as ever. Where f0 is zero its length counts as 1.

    Args:
        features: differentiable; called once here, and once more per evaluation, which costs one more run of the
            network.
        clean: (H, W, 3) or (N, H, W, 3): the clean picture, or several renders of it, whose features are averaged.
            Take as little noise as you can afford: noise of the search's own renders is a distance as well.

    Returns:
        An objective (logits, images, labels) -> (N,), at least 0 but for h, that looks at the images only.

    Raises:
        InputError: the features are not (N, F), or not finite.
    """
    reference = _reference(features, clean)
    length = torch.linalg.vector_norm(reference)
    scale = torch.where(length > 0.0, length, torch.ones_like(length))
    away = _away(reference)

    def objective(logits: Tensor, images: Tensor, labels: tuple[int, ...]) -> Tensor:
        moved = (features(images) - reference) / scale + away
        squared = moved.square().sum(dim=1) + NEARBY**2
        distance: Tensor = squared.sqrt() - math.sqrt(2.0) * NEARBY
        return distance

    objective.__name__ = objective.__qualname__ = "feature_distance"
    return objective


def cosine_distance(features: ReadFeatures, clean: Tensor) -> Callable[[Tensor, Tensor, tuple[int, ...]], Tensor]:
    """One minus the cosine of the features and those of the clean picture: from 0 where they are the same to 2.

    That is |e|^2 / 2 for e the difference of both at length 1. Its gradient is zero at the clean picture, where every
    search starts, so `h` e . r is added, with r and `h` as in `feature_distance`: at the clean picture the gradient
    leads along r, and beyond a few `h` it is that of the distance.

    Args:
        features: of the clean picture; called once, here.
        clean: as for `feature_distance`.

    Returns:
        An objective (features (N, F), images, labels) -> (N,), at least 0 but for `h`^2, that looks at the features
        only, whatever their length.

    Raises:
        InputError: as for `feature_distance`.
    """
    reference = functional.normalize(_reference(features, clean), dim=0)
    away = _away(reference)

    def objective(output: Tensor, images: Tensor, labels: tuple[int, ...]) -> Tensor:
        moved = functional.normalize(output, dim=1) - reference.to(output)
        distance: Tensor = moved.square().sum(dim=1) / 2.0 + moved @ away.to(output)
        return distance

    return objective


def _away(reference: Tensor) -> Tensor:
    """Return a fixed direction (F,) of length `NEARBY`."""
    away = torch.randn(reference.shape, generator=torch.Generator().manual_seed(0)).to(reference)
    return away * (NEARBY / float(torch.linalg.vector_norm(away)))


def _reference(features: ReadFeatures, clean: Tensor) -> Tensor:
    """Return the mean features (F,) of the clean pictures."""
    with torch.no_grad():
        found = features(clean if clean.dim() == 4 else clean[None])
    if found.dim() != 2:
        raise InputError(f"objective: expected features of shape (N, F), got {tuple(found.shape)}")
    if not bool(torch.isfinite(found).all()):
        raise InputError(
            "objective: expected finite features of the clean picture, got NaN or infinity; check that the "
            "model answers it"
        )
    return found.mean(dim=0)


__all__ = [
    "OBJECTIVES", "OBJECTIVE_KINDS", "Objective", "ObjectiveKind", "asked_by", "check_objective", "checked",
    "cross_entropy", "dlr", "feature_distance", "get_objective", "log_odds", "margin", "objective_summaries",
    "targeted_margin",
]  # fmt: skip


@final
@dataclass(frozen=True)
class ObjectiveKind:
    """What is known about a named objective.

    Args:
        name: its name.
        summary: one line about it.
        unit: of its values.
        plain: the function of the right answers, which may ask for more as a user's own does; None for one that has to
            be made for a run.
        targeted: the same, of a target in their place; None if it has no such form.
        task: name of the task whose outputs it takes, and of those tasks that are kinds of it; None for any.
        of_features: what makes it from the model's features and a clean picture; None where nothing does.
        of_task: what makes it from the task, which knows of target and direction itself; None where nothing does.
    """

    name: str
    summary: str
    unit: str
    plain: Callable[..., Tensor] | None = None
    targeted: Callable[..., Tensor] | None = None
    task: str | None = Classification.name
    of_features: Callable[[ReadFeatures, Tensor], Callable[..., Tensor]] | None = None
    of_task: Callable[[Any], Objective] | None = None

    @property
    def needs_features(self) -> bool:
        """Whether it is made from features."""
        return self.of_features is not None

    def fits(self, task: str) -> bool:
        """Whether it takes the outputs of the task of that name."""
        return self.task in (None, task) or (
            self.task in TASKS and task in TASKS and issubclass(TASKS[task], TASKS[self.task])
        )

    def form(self, *, targeted: bool) -> Callable[..., Tensor]:
        """Return the plain or the targeted function."""
        found = self.targeted if targeted else self.plain
        if found is None:
            raise InputError(f"objective {self.name!r}: has no {'targeted' if targeted else 'plain'} form; use another")
        return found


def _plain(function: Callable[[Any, Tensor, Any], Tensor]) -> Objective:
    """An objective that asks for nothing more."""

    def plain(output: Any, images: Tensor, truth: Any, more: More = nothing_more, /) -> Tensor:
        return function(output, images, truth)

    return plain


def _score_of(task: Task) -> Objective:
    return _plain(lambda output, images, truth: task.score(output, truth))


def _pixel_margin_of(task: Segmentation) -> Objective:
    return _plain(lambda output, images, truth: task.pixel_margin(output, truth))


_OWN = {
    kind.name: kind
    for kind in (
        ObjectiveKind(
            "margin", "the largest wrong logit minus the largest right one", "logits (log-odds)", margin,
            targeted_margin,
        ),
        ObjectiveKind(
            "log_odds", "the log-odds of a wrong answer, over all classes", "logits (log-odds)", log_odds,
            targeted_log_odds,
        ),
        ObjectiveKind(
            "cross_entropy", "minus the logarithm of the probability of the right answers", "nats", cross_entropy,
            targeted_cross_entropy,
        ),
        ObjectiveKind(
            "dlr", "the margin over a distance between logits: independent of their scale", "none (a ratio)", dlr,
            targeted_dlr,
        ),
        ObjectiveKind(
            "feature_distance", "how far the features lie from those of the clean picture",
            "lengths of the clean features", of_features=feature_distance,
        ),
        ObjectiveKind(
            "distance", "how far the features lie from those of the clean picture, by the angle", "1 - cosine",
            task=Similarity.name, of_features=cosine_distance,
        ),
        ObjectiveKind(
            "score", "the task's own score, over 0 where an answer is what is sought; in classification the margin",
            "that of the task", task=None, of_task=_score_of,
        ),
        *(
            ObjectiveKind(name, f"sought: {summary}", "log-odds", task=Detection.name, of_task=_score_of)
            for name, summary in GOALS.items()
        ),
        ObjectiveKind(
            Together.objective, "of several tasks at once: each task's own objective, put together by `ensemble`",
            "those of the tasks", task=Together.name, of_task=_score_of,
        ),
        *(
            ObjectiveKind(name, f"sought: {summary}", "logarithm of a factor", task=Depth.name, of_task=_score_of)
            for name, summary in DEPTH_GOALS.items()
        ),
        ObjectiveKind(
            "pixel_margin", "the largest wrong logit minus the largest right one, mean over the object's pixels",
            "logits (log-odds)", task=Segmentation.name, of_task=_pixel_margin_of,
        ),
    )
}  # fmt: skip

OBJECTIVE_KINDS: Registry[ObjectiveKind] = Registry(
    "advsearch.objectives",
    _OWN,
    "an ObjectiveKind whose name is that of the entry point",
    lambda name, entry: isinstance(entry, ObjectiveKind) and entry.name == name,
)
"""Every objective that has a name."""

OBJECTIVES: dict[str, Callable[..., Tensor]] = {
    name: kind.plain for name, kind in _OWN.items() if kind.plain is not None
}
"""Those of our own that need nothing but logits, in their plain form."""


def objective_summaries() -> dict[str, str]:
    """Return one line about every objective that has a name."""
    return {name: kind.summary for name, kind in OBJECTIVE_KINDS.items()}


# ---- from names and functions to objectives -------------------------------------------------------------------------


def get_objective(
    objective: str | Callable[..., Tensor],
    task: Task | None = None,
    *,
    features: ReadFeatures | None = None,
    clean: Tensor | None = None,
) -> Objective:
    """Return the objective of that name, or the user's own function wrapped so that its mistakes are explained.

    What comes back is called with the truth, whatever the search is after. With a target, a named objective takes its
    targeted form, and the user's function gets the target in place of the truth. To minimise, either is negated.

    Args:
        objective: a name, or a function of (output, images, truth) or of (output, labels), which may ask for more.
        task: judges the model; classification of any wrong answer if None.
        features: for an objective that `needs_features`: `advsearch.models.features.features_of(model)`.
        clean: likewise: the clean picture (H, W, 3), or renders of it (N, H, W, 3).

    Raises:
        UnknownNameError, InputError: as for `check_objective`; no features.
    """
    task = task or Classification()
    targeted = task.target is not None
    check_objective(objective, task.name, targeted=targeted, minimise=task.minimise)
    kind, of_answers = _kind_of(objective), False
    if kind is None:
        found = checked(objective)  # type: ignore[arg-type]
    elif kind.of_task is not None:
        return kind.of_task(task)
    elif kind.of_features is not None:
        if features is None or clean is None:
            raise InputError(
                f"objective {kind.name!r}: expected the model's features and a clean picture, got none; use "
                "get_objective(name, features=advsearch.models.features.features_of(model), clean=picture)"
            )
        found = _plain(kind.of_features(features, clean))
    else:
        form = kind.form(targeted=targeted)
        found = _plain(form) if _OWN.get(kind.name) is kind else checked(form)
        of_answers = isinstance(task, Similarity) or (isinstance(task, ClassTask) and bool(task.nothing))

    def sought(output: Any, images: Tensor, truth: Any, more: More = nothing_more, /) -> Tensor:
        wanted = task.target if targeted else truth
        value = found(task.answerable(output, wanted) if of_answers else output, images, wanted, more)
        return -value if task.minimise else value

    return sought


def check_objective(
    objective: object, task: str = Classification.name, *, targeted: bool = False, minimise: bool = False
) -> None:
    """Check, before anything is loaded, that there is such an objective and that it can do what is asked.

    Args:
        objective: a name, or a function.
        task: name of the task whose outputs it will get.
        targeted: whether there is a target.
        minimise: whether a right answer is sought.

    Raises:
        UnknownNameError: no such name.
        InputError: neither a name nor a function of three arguments; an objective of another task; a target to
            minimise; an objective of features with either of them.
    """
    if targeted and minimise:
        raise InputError(
            "minimise: expected no `target` beside it; to make the object easier to recognise as something else, "
            "give that as `label`"
        )
    if isinstance(objective, str) and objective not in OBJECTIVE_KINDS:
        hint = "From Python, objective= also takes a function (output, images, truth), or (output, labels)."
        raise UnknownNameError("objective", objective, OBJECTIVE_KINDS, hint)
    if not isinstance(objective, str) and not callable(objective):
        raise InputError(f"objective: expected a name or a function (output, images, truth), got {objective!r}")
    kind = _kind_of(objective)
    if kind is None:
        form_of(objective)  # type: ignore[arg-type]
        return
    if not kind.fits(task):
        fitting = [name for name, one in OBJECTIVE_KINDS.items() if one.fits(task)]
        raise InputError(
            f"objective: expected one of task {task} ({', '.join(fitting)}), got {kind.name}, which takes outputs of "
            f"{kind.task}"
        )
    if kind.needs_features and (targeted or minimise):
        setting, reason = "minimise", "it is least at the start already"
        if targeted:
            setting, reason = "target", "it leads away from the clean picture, to no class in particular"
        expected = f"expected `objective` {' or '.join(OBJECTIVES)}"
        raise InputError(f"{setting}: {expected}, got {kind.name}; {reason}")


def asked_by(objective: str | Callable[..., Tensor]) -> tuple[str, ...]:
    """Return what an objective, checked already, asks for beside output, images and truth."""
    kind = _kind_of(objective)
    function = objective if kind is None else kind.plain
    return form_of(function).asked if callable(function) else ()


def _kind_of(objective: object) -> ObjectiveKind | None:
    """Return the kind of a name, or of a function that has one; None for the user's own."""
    if isinstance(objective, str):
        return OBJECTIVE_KINDS[objective]
    return next((kind for kind in OBJECTIVE_KINDS.values() if kind.plain is objective), None)
