"""Derive settings of sweeps inside a rule, or along one factor from a failure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from advsearch.extend import Parameter, SweepConfig, rules, settings, wording
from advsearch.questions.explain.rows import SCENE_SETTINGS

N_VALUES_ALONG = 9
"""Values of a factor that are tried to find the nearest right prediction."""


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
    objects, environments and models, are reduced to the values that rows under the
    conditions have. If this makes more than twice as many configurations as requested,
    every second value of the longest axis is left out, repeatedly. Not every condition
    can be expressed in this way: so some configurations may lie outside, and the caller
    has to leave these out.

    Args:
        config: settings of the original sweep.
        table: rows of the original sweep.
        conditions: conditions on the factors, all of which have to hold.
        samples: number of configurations, about.
        seed: seed of the draws.
        arc: index of the arc to render, if a condition on an angle has several.
    """
    inside = table[rules.find_covered(conditions, table)]
    values_inside = {
        name: sorted(inside[name].unique().tolist()) for name in table.attrs["units"]
    }
    scene_settings = cut_scene_settings(config, values_inside)
    n_scenes = math.prod(
        len(settings.split_names(names)) if names else 1
        for names in scene_settings.values()
    )
    full_grid = {
        name: values_inside.get(name, values) for name, values in config.grid.items()
    }
    grid = thin_grid(full_grid, max_points=2 * samples / n_scenes)
    n_configurations = count_grid_points(grid) * n_scenes
    controls = cut_controls(config, table, conditions, arc)
    # draws at each point of the grid in each scene, if anything is sampled
    draws = math.ceil(samples / n_configurations) if controls else None
    return make_minimal_config(
        config, grid=grid, controls=controls, samples=draws, seed=seed, **scene_settings
    )


def thin_grid(grid: Mapping[str, Any], max_points: float) -> dict[str, Any]:
    """Return a grid from whose longest axis every second value is left out, until it
    has at most `max_points` points, or a single one.
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
    """Return the number of values of an axis; something else than a list is one."""
    return len(values) if isinstance(values, list) else 1


def cut_scene_settings(
    config: SweepConfig, values_inside: Mapping[str, Sequence[Any]]
) -> dict[str, str | None]:
    """Return object, environment and model of a sweep that renders under conditions.

    Each has only those names that have rows under the conditions; all names if there
    are no such rows.

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
    condition on an angle may be two arcs of the circle; the range becomes one of them.
    An arc that passes 360 degrees cannot be set, so that the range stays as it was.

    A control without any range samples all of its parameters; as soon as one has a
    range, only parameters with a range are sampled. So if a control without ranges gets
    its first one here, its other parameters get the ranges that rows have.

    Args:
        config: settings of the sweep.
        table: its rows.
        conditions: conditions on the factors; those on names, and on factors that were
            not sampled, are skipped.
        arc: index of the arc, for conditions on angles.
    """
    controls = {name: dict(options) for name, options in config.controls.items()}
    for condition in conditions:
        is_of_names = condition.options is not None
        if is_of_names or not is_sampled(config, condition.factor):
            continue
        instance, _, parameter = condition.factor.partition(".")
        declared = config.declared_parameters(instance) or {}
        if condition.turn:  # of an angle, a full turn
            low, high = condition.arcs[arc % len(condition.arcs)]
        else:
            low = max(condition.low, float(table[condition.factor].min()))
            high = min(condition.high, float(table[condition.factor].max()))
        if high > declared[parameter].high:  # an angle that passes 360 degrees
            continue
        has_ranges = bool(declared.keys() & config.controls[instance].keys())
        if not has_ranges:
            ranges = observed_ranges(config, table, instance, declared)
            for name, values in ranges.items():
                controls[instance].setdefault(name, values)
        controls[instance][parameter] = [low, high]
    return controls


def observed_ranges(
    config: SweepConfig,
    table: pd.DataFrame,
    instance: str,
    declared: Mapping[str, Parameter],
) -> dict[str, Any]:
    """Return the range that rows have of each sampled parameter of a control.

    Args:
        config: settings of the sweep.
        table: its rows.
        instance: name of the control.
        declared: parameters of the control by name.

    Returns:
        [lowest, highest] of numbers, or the choices, by the name of the parameter.
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
    """Return the settings of a sweep along one factor, everything else as in a row.

    The factor has the row's own value first, then all names, or `N_VALUES_ALONG` evenly
    spaced numbers. Every other parameter is an axis of one value, that of the row.

    Args:
        config: settings of the original sweep.
        row: the values of the row, by parameter.
        factor: the parameter that varies.
        table: rows of the original sweep, which decide the range of the factor.
        seed: seed of the noise.
    """
    values = list_values_along(table[factor], row[factor])
    # a parameter is named "control.parameter"; object, environment and model are not
    grid: dict[str, object] = {
        name: [row[name]] for name in row if "." in name and is_settable(config, name)
    }
    # settings that are no axes: object, environment and model
    scene_settings = {
        name: next(iter(find_names(config, name, str(row[name]))), None)
        for name in SCENE_SETTINGS
    }
    if factor in SCENE_SETTINGS:
        scene_settings[factor] = ",".join(
            name for value in values for name in find_names(config, factor, str(value))
        )
    else:
        grid[factor] = values

    # a parameter must not be set and be an axis at the same time
    set_values = {
        name: value for name, value in config.set_.items() if name not in grid
    }
    changes: dict[str, object] = {"keep_pictures": "all", "set": set_values}
    # ten images take less than a worker takes to load
    changes |= {"workers": None, "cluster": None}
    controls = select_choices(config, grid)
    return make_minimal_config(
        config,
        grid=grid,
        controls=controls,
        samples=None,
        seed=seed,
        **changes,
        **scene_settings,
    )


def list_values_along(column: pd.Series, first: float | str) -> list[float | str]:
    """Return the values of a factor that are tried: `first`, then all names of the
    column, or `N_VALUES_ALONG` evenly spaced numbers of its range.
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
    """Return the controls whose parameters are all in a grid, with their choices alone.

    A choice is a setting of a control that is no parameter, such as the kind of a
    light. Such a control samples nothing, but its choices still decide the images.

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
            controls[instance] = {
                name: value
                for name, value in options.items()
                if name in {*choices, "kind"}
            }
    return controls


def is_sampled(config: SweepConfig, factor: str) -> bool:
    """Return whether a sweep samples a parameter from a range that can be set."""
    # a parameter is called "control.parameter"; others are settings
    instance, dot, parameter = factor.partition(".")
    is_parameter = bool(dot) and instance in config.controls
    is_frame = bool(config.path) and parameter == "time"  # of a drive
    if not is_parameter or is_frame or factor in config.grid:
        return False
    return parameter in (config.declared_parameters(instance) or ())


def is_settable(config: SweepConfig, name: str) -> bool:
    """Return whether a value of a row, by its name, can be set.

    Settings can ("object"), and parameters that their control declares. Others follow
    from what is set, as "path.distance" does.
    """
    instance, dot, parameter = name.partition(".")
    is_setting = not dot
    declared = config.declared_parameters(instance)  # None: any, in the scene
    return is_setting or declared is None or parameter in declared


def find_names(config: SweepConfig, setting: str, value: str) -> list[str]:
    """Return the names in a setting that rows write as `value`; else the first name."""
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
    # Without controls nothing is sampled, and a sampler other than the default is
    # refused.
    sampler = {} if changes.get("controls") else {"sampler": "sobol"}
    return SweepConfig(**{**config.to_json(), **quiet, **changes, **sampler})
