"""Controls: the families of scene parameters that can be searched.

`CONTROLS` is the registry of all controls. Other packages can add theirs
(docs/controls/writing.md).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from advsearch.catalog import list_built_ins
from advsearch.controls.base import (
    AdjustedDefault,
    Budget,
    Choice,
    Control,
    Group,
    NumberControl,
    Parameter,
    find_replaced_defaults,
)
from advsearch.controls.space import Space
from advsearch.errors import InputError, UnknownNameError
from advsearch.options import group_mitsuba_keys
from advsearch.registry import Registry, get_class
from advsearch.scene.description import ENVIRONMENT, OBJECT, SceneDescription

CONTROLS: Registry[type[Control]] = Registry(
    "advsearch.controls",
    list_built_ins("control"),
    "a subclass of Control whose kind is the name of the entry point",
    lambda name, entry: (
        isinstance(entry, type)
        and issubclass(entry, Control)
        and entry.kind == name != ""
    ),
    imports_user_classes=True,
)
"""Classes of controls by their name on the command line, such as "pose".

"package.module:Class" is looked up too. A class is imported when it is looked up.
"""
BACKDROP = "backdrop"  # the control that chooses among the photographs of a folder


def make_control(
    control_name: str, settings: Mapping[str, object] | None = None
) -> Control:
    """Return a control from its name and settings.

    Args:
        control_name: one of these forms:

            - "pose", a kind of control;
            - "pose:chair", the kind and the mesh that it acts on, if not the object;
            - "light:key", the kind and a name for this instance, for kinds that do not
              act on a mesh;
            - "pose.yaw", the kind and the only parameter to search, over its default
              range.

            A kind may also be a class, "package.module:Class". If the settings have a
            "kind", that is the kind, and `control_name` only names the instance.
        settings: values of its parameters and choices. A missing value, or None, means
            the default.

    Raises:
        UnknownNameError: no such control, or no such setting.
        InputError: a setting is out of range.
    """
    options: dict[str, Any] = {
        name: value for name, value in (settings or {}).items() if value is not None
    }
    kind, name, parameter = _parse_name(control_name, options)
    # A class "package.module:Class" counts as in `CONTROLS`.
    if kind not in CONTROLS:
        raise make_unknown_control_error(kind)
    control = CONTROLS[kind]
    if parameter is not None:
        options.setdefault(parameter, _get_default_range(control, parameter))
    _check_known_settings(kind, control, options)
    # "name" is added after the check, because users can't set that
    if name != kind:
        options["name"] = name
    return control(**options)


def _check_known_settings(
    kind: str, control: type[Control], options: Mapping[str, object]
) -> None:
    """Raise UnknownNameError for a setting that is no choice and no parameter."""
    known = [choice.name for choice in control.choices]
    known += [
        known_parameter.name for known_parameter in control.declare_parameters(options)
    ]
    for setting in options:
        if setting not in known:
            raise UnknownNameError(f"setting of control {kind}", setting, known)


def make_unknown_control_error(
    kind: str, hint: str = "", instances: Iterable[str] = ()
) -> UnknownNameError:
    """Return the error for a control that does not exist.

    Args:
        kind: the unknown name. If it is a parameter of controls, e.g. "yaw", the
            message says so: "write pose.yaw".
        hint: otherwise the end of the message.
        instances: further names that may be suggested, besides those of controls.
    """
    owners = [
        name
        for name, control in CONTROLS.list_usable().items()
        if any(parameter.name == kind for parameter in control.parameters)
    ]
    if owners:
        parameters = " or ".join(f"{name}.{kind}" for name in owners)
        hint = f"It is a parameter: write {parameters}."
    return UnknownNameError("control", kind, {*CONTROLS, *instances}, hint)


def parse_control_name(
    control_name: str, settings: Mapping[str, object]
) -> tuple[str, str]:
    """Return the kind and the instance name that `make_control` would use."""
    return _parse_name(control_name, dict(settings))[:2]


def _parse_name(
    control_name: str, settings: dict[str, object]
) -> tuple[str, str, str | None]:
    """Split the full name of a control into kind, instance name and parameter.

    The kind is not checked: it may be unknown.

    Args:
        control_name: "pose", "pose:chair", "pose.yaw", or "pose.yaw:chair", where the
            parameter stands before the colon ("pose:chair.yaw" is rejected); or a class
            of controls, "package.module:Class". If the settings have a "kind",
            `control_name` is only the name of the instance.
        settings: settings of the control; a "kind" is removed from them.

    Returns:
        Kind, instance name, and parameter. The parameter is None if the full name has
        none.
    """
    kind_setting = settings.pop("kind", None)
    if kind_setting is not None:
        return str(kind_setting), control_name, None
    if CONTROLS.is_class_path(control_name):
        # A control of a class is named after the kind that the class declares.
        return control_name, CONTROLS[control_name].kind, None
    head, colon, name = control_name.partition(":")
    kind, dot, parameter = head.partition(".")
    if colon:
        check_instance_name(f"`controls` {control_name}", name)
    has_parameter = dot != ""
    instance_name = make_instance_name(kind, name)
    return kind, instance_name, parameter if has_parameter else None


def make_instance_name(kind: str, name: str) -> str:
    """Return the name of a control for `KIND:NAME`, by which results refer to it.

    It is "key" for ``light:key``. For kinds that act on a mesh, `NAME` is the mesh, and
    the result is "pose:chair" for ``pose:chair`` and "pose" for ``pose:object``.

    Args:
        kind: kind of the control.
        name: text after the colon; empty if there is no colon, which makes the result
            the kind.
    """
    acts_on_mesh = kind in CONTROLS and CONTROLS[kind].targets_mesh
    if not name or (acts_on_mesh and name == OBJECT):
        return kind
    return f"{kind}:{name}" if acts_on_mesh else name


def check_instance_name(label: str, name: str) -> None:
    """Check the name after the colon of `KIND:NAME`.

    Args:
        label: beginning of the message.
        name: the name to check.

    Raises:
        InputError: the name is empty, or has other characters than letters and digits
            (of any alphabet), dashes and underscores.
    """
    if not re.fullmatch(r"[\w-]+", name):
        raise InputError(
            f"{label}: expected a name of letters, digits, - and _ after "
            f"the colon, got {name!r}"
        )


def _get_default_range(control: type[Control], parameter: str) -> object:
    """Return the range, or the choices, of a parameter that was named without values.

    Args:
        control: class of the control.
        parameter: name of the parameter, e.g. "yaw" of "pose.yaw".

    Returns:
        A setting as a user would write it: [low, high] or {"choices": [...]}.

    Raises:
        UnknownNameError: the control has no such parameter.
        InputError: the control declares no parameters, so it has no default ranges.
    """
    # Only the control `mitsuba` declares no parameters: users name those of Mitsuba.
    if not control.parameters:
        raise InputError(
            f"`controls` {control.kind}.{parameter}: expected a range, as in "
            f"{control.kind}:{parameter}=[0.2, 0.8]"
        )
    declared = _find_declared_parameter(control, parameter)
    if declared.options:
        return {"choices": list(declared.options)}
    # without a default search range, all allowed values
    return list(declared.search or (declared.low, declared.high))


def _find_declared_parameter(control: type[Control], name: str) -> Parameter:
    """Return a parameter of a class of controls; raise UnknownNameError without it."""
    # Besides the parameters of the class, a control may have one by the name that a
    # user states, such as a joint of a mesh.
    stated_names = (name,)
    parameter_by_name = {
        parameter.name: parameter
        for parameter in control.declare_parameters(stated_names)
    }
    if name not in parameter_by_name:
        raise UnknownNameError(
            f"parameter of control {control.kind}", name, parameter_by_name
        )
    return parameter_by_name[name]


def check_control_settings(
    settings: Mapping[str, object],
) -> dict[str, Mapping[str, object]]:
    """Check that the settings of each control are a mapping, and return them.

    Names such as "mitsuba:mug.bsdf.reflectance" are grouped into one control first. A
    control without settings (None) gets empty ones.

    Raises:
        InputError: the settings of a control are something else than a mapping.
    """
    by_name: dict[str, Mapping[str, object]] = {}
    for name, control_settings in group_mitsuba_keys(settings).items():
        if control_settings is not None and not isinstance(control_settings, Mapping):
            raise InputError(
                f"`controls` {name}: expected {{PARAMETER: VALUE}}, got "
                f"{control_settings!r}"
            )
        by_name[name] = control_settings or {}
    return by_name


def merge_control_settings(
    settings: Mapping[str, object],
) -> dict[str, dict[str, object]]:
    """Merge settings of single parameters into the settings of each control.

    `camera.azimuth` and `camera.elevation` become one control that searches both. A
    parameter in a name is searched over its default range, unless its settings state
    another one.

    Args:
        settings: settings by name. A name is "pose", "pose:chair", "pose.yaw",
            "pose:chair.yaw" or "pose.yaw:chair".

    Returns:
        Settings by the name of each control, as `make_control` takes them.
    """
    by_control: dict[str, dict[str, object]] = {}
    for name, control_settings in check_control_settings(settings).items():
        control_name, new_settings = _move_parameter(name, control_settings)
        by_control.setdefault(control_name, {}).update(new_settings)
    return by_control


def _move_parameter(
    name: str, settings: Mapping[str, object]
) -> tuple[str, Mapping[str, object]]:
    """Move the parameter in the name of a control, if it has one, to its settings.

    Args:
        name: name such as "pose:chair.yaw", "pose.yaw:chair" or "pose:chair".
        settings: settings of the control, which may state a range of that parameter.

    Returns:
        The name without the parameter, e.g. "pose:chair". And the settings, with the
        default range of the parameter if they had no other.
    """
    before_dot, dot, after_dot = name.partition(".")
    kind = before_dot.partition(":")[0]
    # In "package.module:Class" the dot is that of a module, whose package is no
    # kind of control.
    has_parameter = dot != "" and kind in CONTROLS
    if not has_parameter:
        return name, settings
    # Both "pose.yaw:chair" and "pose:chair.yaw" become "pose:chair" and "yaw".
    parameter, colon, instance = after_dot.partition(":")
    default_range = _get_default_range(CONTROLS[kind], parameter)
    # A range in the settings replaces the default range.
    return before_dot + colon + instance, {parameter: default_range, **settings}


def make_space(controls: Sequence[Control], scene: SceneDescription) -> Space:
    """Compose controls and a scene into a space that can be searched.

    Raises:
        InputError: there is no control, two have the same name, one does not fit the
            scene, or every parameter is fixed.
    """
    if not controls:
        raise InputError(f"controls: expected at least one of {', '.join(CONTROLS)}")
    space = compose_space(controls, scene)
    if not len(space.start):
        names = ", ".join(control.name for control in controls)
        raise InputError(
            f"`controls` {names}: every parameter is fixed, so there is nothing to "
            "search; give one a range, "
            f"such as {_make_example_range(space.controls[0])}"
        )
    return space


def _make_example_range(control: Control) -> str:
    """Return an example of a range for a control, such as "pose={yaw: [0, 360]}".

    The parameter is one with a default range, if there is one.
    """
    # Only the control `mitsuba` declares no parameters; KEY is a name of Mitsuba's.
    if not control.parameters:
        return f"{control.name}:KEY=[0.2, 0.8]"
    parameters = control.instance_parameters
    searchable = [parameter for parameter in parameters if parameter.search is not None]
    parameter = searchable[0] if searchable else parameters[0]
    low, high = parameter.search or (parameter.low, parameter.high)
    return f"{control.name}={{{parameter.name}: [{low:g}, {high:g}]}}"


def _check_names_no_mesh(controls: Sequence[Control], scene: SceneDescription) -> None:
    """Check that no control is named after a mesh that it does not act on.

    In "pose:chair" the chair is the mesh that is moved. "light:chair" would only be a
    light named "chair", but it looks as if it acted on the chair.

    Args:
        controls: controls to check.
        scene: scene with the meshes around the object.

    Raises:
        InputError: a control has such a name.
    """
    for control in controls:
        if control.name != control.kind and control.name in scene.surrounding_meshes:
            kinds_for_meshes = ", ".join(
                kind
                for kind, usable in CONTROLS.list_usable().items()
                if usable.targets_mesh
            )
            raise InputError(
                f"`controls` {control.kind}:{control.name}: {control.kind} can't act "
                "on another mesh than the "
                f"object; {kinds_for_meshes} can, as in pose:{control.name}"
            )


def compose_space(controls: Sequence[Control], scene: SceneDescription) -> Space:
    """Let controls prepare a scene, bind them to it and compose them into a space.

    There may be no controls, or only fixed ones. All prepare the scene, e.g. add a
    mesh, before any is bound to it, so that each is bound to the final scene. If
    controls replace default values of the clean scene, the space lists these as
    adjusted defaults, in the order of the controls. If a control replaces the
    environment, the space has the name of the new environment.

    Raises:
        InputError: two controls have the same name, one does not fit the scene, or one
            replaces a value that the user set.
    """
    _check_controls(controls, scene)
    prepared, adjusted = _prepare_scene(controls, scene)
    _check_meshes_exist(controls, prepared)
    bound = tuple(control.bind(prepared) for control in controls)
    for control in bound:
        adjusted += control.adjusted_defaults
    # The adjustments by `prepare` come first, then those by `bind`: sort them by control.
    names = [control.name for control in controls]
    adjusted.sort(key=lambda default: names.index(default.control_name))
    environment_name = _find_new_environment(scene, prepared, adjusted)
    return Space(bound, prepared, tuple(adjusted), environment_name)


def _prepare_scene(
    controls: Sequence[Control], scene: SceneDescription
) -> tuple[SceneDescription, list[AdjustedDefault]]:
    """Let controls prepare a scene, one after the other.

    Returns:
        The prepared scene, and the default values of the scene that controls replace.
    """
    adjusted = list[AdjustedDefault]()
    for control in controls:
        prepared = control.prepare(scene)
        adjusted += find_replaced_defaults(control.name, scene, prepared)
        scene = prepared
    return scene, adjusted


def _check_meshes_exist(controls: Sequence[Control], scene: SceneDescription) -> None:
    """Check that a prepared scene has the meshes that controls act on."""
    for control in controls:
        if control.mesh_name != OBJECT:
            control.get_mesh(scene)  # raises if the scene has no such mesh


def _find_new_environment(
    before: SceneDescription,
    after: SceneDescription,
    adjusted: Sequence[AdjustedDefault],
) -> str | None:
    """Return the name of the environment that a control has put in; None without one.

    The control has either recorded its name in the scene, or listed it as an adjusted
    default. If several have listed one, the first counts.

    Args:
        before: scene before controls have prepared it.
        after: the prepared scene.
        adjusted: default values that controls have adjusted.
    """
    for default in adjusted:
        if default.parameter_name == ENVIRONMENT:
            return str(default.used_value)
    if after.environment_spec != before.environment_spec:
        return after.environment_spec
    return None


def _check_controls(controls: Sequence[Control], scene: SceneDescription) -> None:
    """Check that controls fit each other, and a scene that none has prepared yet.

    Raises:
        InputError: two controls have the same name, one is named after a mesh that it
            does not act on, or one does not fit the scene's photographs.
    """
    names = [control.name for control in controls]
    if len(set(names)) != len(names):
        raise InputError(
            "controls: every control needs a different name, got "
            f"{', '.join(names)}; write KIND:NAME, such as "
            f"light:key,light:fill"
        )
    _check_names_no_mesh(controls, scene)
    if scene.backdrop_photograph is not None:
        _check_controls_in_photograph(controls, scene.backdrop_photograph.spec)
    _check_photograph_is_chosen(controls, scene)


def _check_photograph_is_chosen(
    controls: Sequence[Control], scene: SceneDescription
) -> None:
    """Raise InputError if no control chooses among the photographs of a folder."""
    folder = scene.photographs
    if folder is None or BACKDROP in {control.kind for control in controls}:
        return
    advice = "name one of them"
    if BACKDROP in CONTROLS:
        advice += f", or let the control {BACKDROP} choose, as in `over={BACKDROP}`"
    raise InputError(f"backdrop: {folder.path} is a folder of photographs; {advice}")


def _check_controls_in_photograph(controls: Sequence[Control], spec: str) -> None:
    """Raise InputError if a control would contradict what a photograph shows.

    `spec` is how the user stated the photograph.
    """
    for control in controls:
        if control.photograph_refusal:
            raise InputError(
                f"`controls` {control.name} and `backdrop={spec}` contradict each "
                f"other: {control.photograph_refusal}; leave one of the two out"
            )


def __getattr__(name: str) -> Any:
    """Import the class of a control by name: TextureControl, or Texture for short."""
    return get_class("control", name if name.endswith("Control") else f"{name}Control")


__all__ = [
    "CONTROLS",
    "Budget",
    "Choice",
    "Control",
    "Group",
    "NumberControl",
    "Parameter",
    "Space",
    "check_control_settings",
    "compose_space",
    "make_control",
    "make_space",
    "merge_control_settings",
    "parse_control_name",
]
