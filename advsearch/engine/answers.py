"""What is true of a scene, for a task to judge by; and where nothing says so, what the model answers to it.

What is true of the configurations of a search is remembered where only base colours tell them apart.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import torch
from torch import Tensor

from advsearch.config import SceneConfig
from advsearch.controls import Space
from advsearch.described import Value
from advsearch.engine.loading import Scene
from advsearch.engine.rendering import pictures_of, render, sight_of
from advsearch.errors import InputError
from advsearch.models import Model
from advsearch.report.phrases import seen_text
from advsearch.scene.renderer import Renderer
from advsearch.scene.surfaces import Surfaces
from advsearch.scene.transport.matrix import linear_inputs
from advsearch.tasks import Answer, Facts, Task
from advsearch.tasks.base import Truth

LOOK_SPP = 16
"""Samples a pixel of the clean picture that the model is shown."""

Described = Callable[[], Mapping[str, Value]]
"""What says the configuration in named values, when it is asked."""


Looked = Callable[[], Surfaces]
"""What says what the camera sees, when it is asked."""


def facts_of(scene: Scene, name: str, label: str | None, describe: Described, look: Looked | None = None) -> Facts:
    """Return what a scene gives a task to judge by.

    Args:
        scene: with the object.
        name: the object's, for messages.
        label: what was said to be right.
        describe: says the configuration; what it does not say has the value that the scene was given.
        look: says what is seen in the configuration; None where there is none.
    """
    fixed = {key: value for key, value in scene.description.values.items() if value is not None}

    def numbers() -> dict[str, float]:
        said = {key: one["value"] for key, one in describe().items()}
        return {key: float(v) for key, v in {**fixed, **said}.items() if isinstance(v, (int, float))}

    sight = None if look is None else lambda: sight_of(look())
    return Facts(name, label, scene.description.object.label, numbers, sight)


def shown(task: Task, model: Model, scenes: Sequence[Scene], config: SceneConfig) -> Task:
    """Return the task after it has seen what its model answers to clean pictures, where it asks for that (`looks`).

    Args:
        task, model, config: as for `check_truth`.
        scenes: at least one; the next is shown where those before leave open how answers are to be read.

    Raises:
        InputError: no scene shows it, so it has to be said.
    """
    if not task.looks:
        return task
    for scene in scenes:
        view = render(scene, model, task=task, label=config.label, spp=LOOK_SPP, **pictures_of(config)).views[0]
        task = task.seeing(view.output, view.truth)
        if not task.unsaid:
            return task
    raise InputError(f"model {model.name}: {task.unsaid}")


def check_truth(task: Task, model: Model, scene: Scene, facts: Facts, config: SceneConfig) -> None:
    """Refuse a scene of which the task cannot say what is right, before anything is prepared.

    Args:
        task: on the model.
        model: whose answers it judges.
        scene: with the object.
        facts: of the scene.
        config: says how it is rendered.

    Raises:
        InputError: what `Task.check` raises; where no label was given, with the model's first answers to a clean
            picture.
    """
    try:
        task.check(facts)
    except InputError as error:
        if facts.label is not None:
            raise
        raise InputError(f"{error}; {_advice(task, model, scene, config)}") from None


def one_label_for_several(models: Sequence[Model], label: str | None, objects: Mapping[str, str | None]) -> list[str]:
    """Return a sentence if a label that was given for several objects is not what some of them are called.

    Args:
        models: whose classes.
        label: what was given for all objects; None where each has its own.
        objects: by name, the label that each has of its own, or None.
    """
    if label is None or len(objects) < 2:
        return []
    others = [f"{name} (its own is {own!r})" for name, own in objects.items() if own and _differs(models, label, own)]
    if not others:
        return []
    return [
        f"The label {label!r} is taken as the right answer for every object, also for {', '.join(others)}; without a "
        "label, each object has its own."
    ]


def _differs(models: Sequence[Model], label: str, own: str) -> bool:
    """Whether a model has classes for both labels, and none in common."""
    for model in models:
        try:
            known = set(model.label_set(own).indices)
        except InputError:
            continue
        if not known & set(model.label_set(label).indices):
            return True
    return False


def _advice(task: Task, model: Model, scene: Scene, config: SceneConfig) -> str:
    """What the model answers to a clean picture, and how to take the first of these for right."""
    looked = render(scene, model, task=task, spp=LOOK_SPP, **pictures_of(config))
    answers = looked.views[0].answers
    listed = ", ".join(seen_text(task.name, replace(answer, label=repr(answer.label))) for answer in answers)
    return (
        f"model {model.name} calls a clean picture of it {listed}; name what is right, such as "
        f'`label="{_term(model, answers[0])}"`'
    )


def _term(model: Model, answer: Answer) -> str:
    """What names the class of an answer and no other: its label, or else its number."""
    try:
        known = model.label_set(answer.label).indices == (answer.index,)
    except InputError:
        known = False
    return answer.label if known else f"#{answer.index}"


MOST_NUMBERS, MOST = 64, 512
"""Numbers, beside base colours, of a configuration whose truth is remembered; and truths that are."""


@dataclass
class KnownTruths:
    """What is true of configurations.

    Attributes:
        task: says what is true.
        space: of the configurations.
        renderer: of the scene.
        facts: what the scene gives the task to judge by, from what describes the configuration and what looks at it.
    """

    task: Task
    space: Space
    renderer: Renderer
    facts: Callable[[Described, Looked], Facts]
    _kept: dict[bytes, Truth] = field(default_factory=dict)

    def at(self, whole: Tensor) -> Truth:
        """Return what is true at (d,) of the whole space. What the camera sees first has nothing to do with base
        colours, so that a truth is remembered where the rest is a few numbers, unless the task asks for numbers."""
        rest = whole.detach()[self._rest]
        key = rest.numpy().tobytes()
        if key in self._kept:
            return self._kept[key]
        facts = self.facts(lambda: self.space.describe(whole), lambda: self.renderer.surfaces(whole))
        truth = self.task.truth(facts)
        if len(rest) <= MOST_NUMBERS and "numbers" not in vars(facts):
            while len(self._kept) >= MOST:
                del self._kept[next(iter(self._kept))]
            self._kept[key] = truth
        return truth

    @cached_property
    def _rest(self) -> Tensor:
        """Which coordinates do more than to colour surfaces, (d,) bool."""
        linear, rest = linear_inputs(self.renderer), torch.ones(len(self.space.start), dtype=torch.bool)
        for group in self.space.groups:
            route = self.renderer.routes.get(group.name)
            rest[group.coordinates] = not route or not route <= linear
        return rest
