"""Controls: the families of scene parameters that may vary. `CONTROLS` is the registry."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from advsearch.controls.base import BoundControl, Budget, Choice, Control, Parameter
from advsearch.controls.space import Space
from advsearch.controls.texture import TextureControl
from advsearch.errors import InputError, UnknownNameError
from advsearch.scene.description import SceneDescription

CONTROLS: Mapping[str, type[Control]] = {TextureControl.kind: TextureControl}
"""Every control by its word on the command line."""


def make_control(kind: str, settings: Mapping[str, object] | None = None) -> Control:
    """Return a control from its name and settings.

    Args:
        kind: a key of `CONTROLS`.
        settings: values for the names in its `choices`; None or missing keeps the default.

    Raises:
        UnknownNameError: no such control, or no such setting.
        InputError: a setting is out of range.
    """
    if kind not in CONTROLS:
        raise UnknownNameError("control", kind, CONTROLS)
    control = CONTROLS[kind]
    given = {name: value for name, value in (settings or {}).items() if value is not None}
    known = [choice.name for choice in control.choices]
    for name in given:
        if name not in known:
            raise UnknownNameError(f"setting of control {kind}", name, known)
    return control(**given)


def make_space(controls: Sequence[Control], scene: SceneDescription) -> Space:
    """Bind controls to a scene and compose them.

    Raises:
        InputError: no control, two of one name, or one that the scene cannot take.
    """
    if not controls:
        raise InputError(f"--control: expected at least one of {', '.join(CONTROLS)}")
    return Space(tuple(control.bind(scene) for control in controls))


__all__ = [
    "CONTROLS",
    "BoundControl",
    "Budget",
    "Choice",
    "Control",
    "Parameter",
    "Space",
    "TextureControl",
    "make_control",
    "make_space",
]
