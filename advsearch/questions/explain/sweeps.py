"""Derive the settings of sweeps inside a rule, or along one factor from a failure.

A factor is a parameter of a control, named "control.parameter", or one of the settings
"object", "environment" and "model".
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from advsearch.extend import Parameter, SweepConfig, rules, settings, wording
from advsearch.questions.explain.rows import SCENE_SETTINGS

# Workers and machines of a cluster take longer to start than ten images to render.
SETTINGS_ALONG: dict[str, Any] = {
    "samples": None,
    "keep_pictures": "all",
    "workers": None,
    "cluster": None,
}
"""Settings of a sweep along one factor."""
N_VALUES_ALONG = 9
"""Number of values of a factor that are tried to find the nearest right prediction."""


def make_sweep_inside(
    config: SweepConfig,
    table: pd.DataFrame,
    conditions: rules.RuleConditions,
    samples: int,
    seed: int,
    arc: int = 0,
) -> SweepConfig:
    """Return the settings of a sweep whose configurations mostly lie under conditions.

    Sampled ranges are cut to the conditions. Axes of the grid, and the lists of
    objects, environments and models, are reduced to the values of those rows for which
    the conditions hold. If this makes more than twice as many configurations as
    requested, every second value of the longest axis is left out, repeatedly.

    Settings cannot express every condition, such as one on an arc that passes 360
    degrees. So the caller has to leave out configurations outside of the conditions.

    Args:
        config: settings of the original sweep.
        table: rows of the original sweep.
        conditions: conditions on the factors, all of which have to hold.
        samples: approximate number of configurations.
        seed: seed of the draws.
        arc: index of the arc to render, if a condition on an angle has two arcs.
    """
    inside = table[rules.find_covered(conditions, table)]
    # the different values of each parameter in these rows
    values_inside = {
        name: sorted(inside[name].unique().tolist()) for name in table.attrs["units"]
    }
    scene_settings = cut_scene_settings(config, values_inside)
    n_scenes = _count_scenes_of_settings(scene_settings)
    # twice the number of samples, for all scenes together
    grid = cut_grid(config, values_inside, max_points=2 * samples / n_scenes)
    n_configurations = count_grid_points(grid) * n_scenes
    controls = cut_controls(config, table, conditions, arc)
    # number of draws at each point of the grid in each scene; None if nothing is
    # sampled
    draws = math.ceil(samples / n_configurations) if controls else None
    return make_minimal_config(
        config, grid=grid, controls=controls, samples=draws, seed=seed, **scene_settings
    )


def _count_scenes_of_settings(scene_settings: Mapping[str, str | None]) -> int:
    """Return the number of combinations of objects, environments and models."""
    return math.prod(
        len(settings.split_names(names)) if names else 1
        for names in scene_settings.values()
    )


def cut_grid(
    config: SweepConfig, values_inside: Mapping[str, Sequence[Any]], max_points: float
) -> dict[str, Any]:
    """Return the grid of a sweep, reduced to values under conditions and thinned.

    An axis that does not vary in the rows keeps its values.

    Args:
        config: settings of the sweep.
        values_inside: values that each factor has under the conditions.
        max_points: largest number of points of the grid.
    """
    full_grid = {
        name: values_inside.get(name, values) for name, values in config.grid.items()
    }
    return thin_grid(full_grid, max_points)


def thin_grid(grid: Mapping[str, Any], max_points: float) -> dict[str, Any]:
    """Return a grid with at most `max_points` points, or a single one.

    Every second value of the longest axis is left out until the grid is small enough.
    """
    thinned = dict(grid)
    while count_grid_points(thinned) > max(max_points, 1):
        longest = max(thinned, key=lambda name: count_axis_values(thinned[name]))
        thinned[longest] = thinned[longest][::2]
    return thinned


def count_grid_points(grid: Mapping[str, Any]) -> int:
    """Return the number of points of a grid, whose axes have values by name."""
    return math.prod(map(count_axis_values, grid.values()))


def count_axis_values(values: Any) -> int:
    """Return the number of values of an axis: 1 for anything that is no list."""
    return len(values) if isinstance(values, list) else 1


def cut_scene_settings(
    config: SweepConfig, values_inside: Mapping[str, Sequence[Any]]
) -> dict[str, str | None]:
    """Return object, environment and model of a sweep that renders under conditions.

    Each setting lists only names with rows under the conditions. If there are no such
    rows, it lists all names.

    Args:
        config: settings of the sweep.
        values_inside: values that each factor has under the conditions.
    """
    scene_settings = {name: getattr(config, name) for name in SCENE_SETTINGS}
    for name, setting in scene_settings.items():
        if name not in values_inside or setting is None:
            continue
        names: list[str] = []
        for value in values_inside[name]:
            names += find_names(config, name, value)
        scene_settings[name] = ",".join(names) or setting
    return scene_settings


def cut_controls(
    config: SweepConfig, table: pd.DataFrame, conditions: rules.RuleConditions, arc: int
) -> dict[str, dict[str, Any]]:
    """Return the controls of a sweep with their sampled ranges cut to conditions.

    A range is cut to the bounds of its condition, and to the values that rows have. A
    condition on an angle may have two opposite arcs of the circle: the range becomes
    one of them. It is not cut to an arc that passes 360 degrees, which settings cannot
    express.

    A control without any range in the settings samples all of its parameters from their
    full ranges; otherwise it samples only those that have a range. So a control that
    gets its first range here gets ranges for its other parameters, too: those of the
    values in the rows.

    Args:
        config: settings of the sweep.
        table: its rows.
        conditions: conditions on the factors. Those on names, and on factors that were
            not sampled, are skipped.
        arc: index of the arc, for conditions on angles.
    """
    controls = {name: dict(options) for name, options in config.controls.items()}
    for condition in conditions:
        # `condition.options` is not None for a condition on names.
        if condition.options is not None or not is_sampled(config, condition.factor):
            continue
        # the name of the control in the settings, and its parameter: "pose.yaw"
        instance, _, parameter = condition.factor.partition(".")
        declared = config.declared_parameters(instance) or {}
        low, high = _find_range(condition, table, arc)
        if high > declared[parameter].high:  # an arc that passes 360 degrees
            continue
        # `config` has no ranges that were added here for other conditions.
        had_ranges = bool(declared.keys() & config.controls[instance].keys())
        if not had_ranges:
            ranges = observed_ranges(config, table, instance, declared)
            for name, values in ranges.items():
                controls[instance].setdefault(name, values)
        controls[instance][parameter] = [low, high]
    return controls


def _find_range(
    condition: rules.RuleCondition, table: pd.DataFrame, arc: int
) -> tuple[float, float]:
    """Return the range of values in which a condition on numbers holds.

    Args:
        condition: the condition.
        table: rows of the sweep, whose values limit the range of a factor that is no
            angle.
        arc: index of the arc, for an angle. A condition with a single arc has the same
            range for every index.
    """
    # `turn` is the period of the factor: 0 for a factor that is no angle.
    is_of_angle = condition.turn > 0.0
    if is_of_angle:
        return condition.arcs[arc % len(condition.arcs)]
    values = table[condition.factor]
    low = max(condition.low, float(values.min()))
    high = min(condition.high, float(values.max()))
    return low, high


def observed_ranges(
    config: SweepConfig,
    table: pd.DataFrame,
    instance: str,
    declared: Mapping[str, Parameter],
) -> dict[str, Any]:
    """Return the range of the values of each sampled parameter of a control.

    Args:
        config: settings of the sweep.
        table: its rows.
        instance: name of the control.
        declared: parameters of the control by name.

    Returns:
        By the name of the parameter: [minimum, maximum] for numbers, or the names as
        {"choices": [...]}.
    """
    ranges: dict[str, Any] = {}
    for name, parameter in declared.items():
        column = table.get(f"{instance}.{name}")
        if column is None or not is_sampled(config, f"{instance}.{name}"):
            continue
        if parameter.options:
            ranges[name] = {"choices": column.cat.categories.tolist()}
        else:
            ranges[name] = [float(column.min()), float(column.max())]
    return ranges


def make_sweep_along(
    config: SweepConfig,
    row: Mapping[str, float | str],
    factor: str,
    table: pd.DataFrame,
    seed: int,
) -> SweepConfig:
    """Return the settings of a sweep along one factor, with all else as in a row.

    The first value of the factor is that of the row. It is followed by all names, or by
    `N_VALUES_ALONG` evenly spaced numbers. Every other parameter is an axis of the grid
    with one value, that of the row. Nothing is sampled.

    Args:
        config: settings of the original sweep.
        row: the values of the row, by parameter.
        factor: the parameter that varies.
        table: rows of the original sweep, which decide the range of the factor.
        seed: seed of the noise.
    """
    values = list_values_along(table[factor], row[factor])
    # Object, environment and model are settings; other parameters are axes of the grid.
    scene_settings = _find_scene_settings(config, row)
    grid = _make_point_grid(config, row)
    if factor in SCENE_SETTINGS:
        scene_settings[factor] = _join_matching_names(config, factor, values)
    else:
        grid[factor] = values
    return make_minimal_config(
        config,
        grid=grid,
        controls=select_choices(config, grid),
        seed=seed,
        set=_leave_out_axes(config, grid),
        **SETTINGS_ALONG,
        **scene_settings,
    )


def _leave_out_axes(config: SweepConfig, grid: Mapping[str, object]) -> dict[str, Any]:
    """Return the parameters that a sweep sets, without the axes of a grid.

    A parameter must not be set and be an axis at the same time.
    """
    return {name: value for name, value in config.set_.items() if name not in grid}


def _make_point_grid(
    config: SweepConfig, row: Mapping[str, float | str]
) -> dict[str, object]:
    """Return a grid of a single point: the parameters of a row, which have a dot."""
    return {
        name: [row[name]] for name in row if "." in name and is_settable(config, name)
    }


def _join_matching_names(
    config: SweepConfig, setting: str, values: Sequence[float | str]
) -> str:
    """Return the names in a setting that rows write as values, separated by commas."""
    names: list[str] = []
    for value in values:
        names += find_names(config, setting, str(value))
    return ",".join(names)


def _find_scene_settings(
    config: SweepConfig, row: Mapping[str, float | str]
) -> dict[str, str | None]:
    """Return object, environment and model of a row, as settings of a sweep.

    Rows have short names of them, so that several names in the settings may match: the
    first one is used. None for a setting that the sweep does not have.
    """
    scene_settings: dict[str, str | None] = {}
    for name in SCENE_SETTINGS:
        matching_names = find_names(config, name, str(row[name]))
        scene_settings[name] = matching_names[0] if matching_names else None
    return scene_settings


def list_values_along(column: pd.Series, first: float | str) -> list[float | str]:
    """Return the values of a factor that are tried.

    They are `first`, then all names of the column, or `N_VALUES_ALONG` evenly spaced
    numbers in its range.
    """
    if column.dtype == "category":
        candidates: Sequence[float | str] = column.cat.categories.tolist()
    else:
        candidates = [
            float(f"{value:.4g}")
            for value in np.linspace(column.min(), column.max(), N_VALUES_ALONG)
        ]
    return list(dict.fromkeys([first, *candidates]))  # each once


def select_choices(
    config: SweepConfig, grid: Mapping[str, object]
) -> dict[str, dict[str, Any]]:
    """Return the controls whose parameters are all in a grid, with only their choices.

    A choice is a setting of a control that is no parameter, such as the type of a light
    ("area" or "point"). A control whose parameters are all in the grid samples nothing,
    but its choices still decide the images.

    Args:
        config: settings of the original sweep.
        grid: axes of the new sweep, by parameter.
    """
    controls = {}
    for instance, options in config.controls.items():
        control_type = config.find_control_type(instance)
        if control_type is None:
            continue
        choices = {choice.name for choice in control_type.choices} & options.keys()
        parameters = [
            f"{instance}.{parameter.name}"
            for parameter in control_type.declare_parameters(options)
        ]
        if choices and all(name in grid for name in parameters):
            controls[instance] = _extract_choices(options, choices)
    return controls


def _extract_choices(options: Mapping[str, Any], choices: set[str]) -> dict[str, Any]:
    """Return the options of a control that are choices, and its "kind".

    "kind" states the type of the control, if that is not its name.
    """
    used_names = {*choices, "kind"}
    return {name: value for name, value in options.items() if name in used_names}


def is_sampled(config: SweepConfig, factor: str) -> bool:
    """Return whether a sweep samples a factor from a range of its control.

    It does not if the factor is a setting ("object"), an axis of the grid, or the time
    of a frame on a path.
    """
    instance, dot, parameter = factor.partition(".")
    is_parameter = bool(dot) and instance in config.controls
    # With a `path`, a sweep renders drives: the frames follow each other in time.
    is_frame_time = bool(config.path) and parameter == "time"
    if not is_parameter or is_frame_time or factor in config.grid:
        return False
    # None for a control whose parameters are not known without the scene
    declared = config.declared_parameters(instance) or {}
    return parameter in declared


def is_settable(config: SweepConfig, name: str) -> bool:
    """Return whether a value of a row, by its name, can be set.

    Settings ("object") can be set, and parameters that their control declares. Other
    values are computed from these, such as "path.distance".
    """
    instance, dot, parameter = name.partition(".")
    is_setting = not dot
    declared = config.declared_parameters(instance)
    # None: the parameters are those of the scene, and any of them can be set.
    return is_setting or declared is None or parameter in declared


def find_names(config: SweepConfig, setting: str, value: str) -> list[str]:
    """Return the names in a setting that rows write as `value`.

    Rows may have a shorter form of a name. If no name matches, the first name in the
    setting is returned; the result is empty if the setting is empty.
    """
    setting_value = getattr(config, setting)
    names = settings.split_names(setting_value) if setting_value else ()
    matching = [
        name for name in names if value in (name, wording.format_figure_value(name))
    ]
    return matching or list(names[:1])


def make_minimal_config(config: SweepConfig, **changes: object) -> SweepConfig:
    """Return changed settings of a sweep that only renders and predicts."""
    quiet = {
        "trials": 0,
        "verify_spp": None,
        "keep_pictures": "none",
        "aov": None,
        "surface": False,
    }
    # Without controls nothing is sampled. Then `SweepConfig` rejects any sampler but
    # the default one.
    sampler = {} if changes.get("controls") else {"sampler": "sobol"}
    return SweepConfig(**{**config.to_json(), **quiet, **changes, **sampler})
