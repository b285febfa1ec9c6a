"""Which answers of a model are right for an object; and where nothing says so, what the model answers to it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from advsearch.config import SceneConfig
from advsearch.engine.loading import Scene
from advsearch.engine.rendering import render
from advsearch.errors import InputError
from advsearch.models import LabelSet, Model
from advsearch.models.model import Answer

LOOK_SPP = 16
"""Samples a pixel of the clean picture that the model is shown."""


def right_answers(model: Model, scene: Scene, name: str, config: SceneConfig) -> LabelSet:
    """Return the right answers for an object: what was said, or else its own label.

    Args:
        model: whose classes.
        scene: with the object.
        name: the object's, for messages.
        config: its `label` is what was said.

    Raises:
        InputError: the model has no such class, or the object has no label; then the message has the model's first
            answers to a clean picture.
    """
    own = scene.description.object.label
    if config.label is not None:
        try:
            return model.label_set(config.label)
        except InputError as error:
            raise InputError(f"label: {error}") from None
    if own is None:
        problem = f"label: expected the right answers for {name}, got none"
    else:
        try:
            return model.label_set(own)
        except InputError as error:
            problem = f"label: the label of {name} itself does not fit the model ({error})"
    raise InputError(f"{problem}; {_advice(model, scene, config)}")


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


def _advice(model: Model, scene: Scene, config: SceneConfig) -> str:
    """What the model answers to a clean picture, and how to take the first of these for right."""
    looked = render(
        scene,
        model,
        resolution=config.resolution,
        spp=LOOK_SPP,
        denoise=config.denoise,
        sampler=config.pixel_sampler,
        seed=config.seed,
    )
    answers = looked.views[0].answers
    listed = ", ".join(f"{answer.label!r} {100 * answer.probability:.1f} %" for answer in answers)
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
