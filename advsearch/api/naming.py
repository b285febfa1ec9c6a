"""From what a configuration names to things, as every command that loads a scene and a model does it."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Any

from advsearch import threads
from advsearch.config import SceneConfig
from advsearch.errors import InputError
from advsearch.models import LabelSet, Model, ModelWarning, load_model


def scene_settings(fixed: Mapping[str, Any] | None, exposure: float | None) -> dict[str, Any]:
    """Return the parameters that a scene is loaded with: those of `set`, and the exposure.

    Raises:
        InputError: both say what the exposure is.
    """
    given = dict(fixed or {})
    if exposure:
        if "camera.exposure" in given:
            raise InputError("`exposure` and `set` camera.exposure say the same thing; leave one of them out")
        given["camera.exposure"] = exposure
    return given


def load_models(models: Sequence[Any], config: SceneConfig) -> tuple[tuple[Model, ...], list[str]]:
    """Load models in the threads that are asked for; their warnings become sentences of the run."""
    threads.configure(1 if config.deterministic else config.threads)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", ModelWarning)
        loaded = tuple(load_model(one, labels=config.labels) for one in models)
    said = [str(one.message) for one in caught if issubclass(one.category, ModelWarning)]
    for one in caught:
        if not issubclass(one.category, ModelWarning):
            warnings.warn_explicit(one.message, one.category, one.filename, one.lineno)
    return loaded, said


def different(names: Sequence[str], setting: str) -> Sequence[str]:
    """Return the names.

    Raises:
        InputError: there are none, or one comes twice.
    """
    twice = [name for name in names if names.count(name) > 1]
    if twice or not names:
        raise InputError(
            f"{setting}: expected different names, got {','.join(names)!r}; leave {', '.join(twice[:1])} out"
        )
    return names


def right_answers(model: Model, asked: str | None, object: str, own: str | None) -> LabelSet:
    """Return the right answers for an object: what was said, or else its own label.

    Args:
        model: whose classes.
        asked: what `--label` said.
        object: the object's name, for messages.
        own: its label.

    Raises:
        InputError: the model has no such class, or the object has no label.
    """
    if asked is None and own is None:
        raise InputError(
            f"label: expected the right answers for {object}, got none; name classes of model {model.name}"
        )
    try:
        return model.label_set(str(own) if asked is None else asked)
    except InputError as error:
        if asked is not None:
            raise InputError(f"label: {error}") from None
        raise InputError(
            f"the label of {object} itself does not fit the model; say which is right with `label` ({error})"
        ) from None
