"""From what a configuration names to things, as every command that loads a scene and a model does it."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Any

from advsearch import threads
from advsearch.config import SceneConfig
from advsearch.errors import InputError
from advsearch.models import Model, ModelWarning, load_model


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
