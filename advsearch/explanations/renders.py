"""Sweeps that render anew what rows said: inside a rule, and along one factor from a failure."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from advsearch.config import SweepConfig
from advsearch.explanations.observations import Factor, Mask, Observations
from advsearch.explanations.rules import RuleCondition, RuleConditions, covered
from advsearch.recipes.table import figure_value
from advsearch.settings import split_names

ALONG = 9
"""Values of a factor that are tried on the way to a right answer."""
OUTER = ("object", "environment", "model")


def sweep_inside(
    config: SweepConfig, found: Observations, conditions: RuleConditions, samples: int, seed: int
) -> SweepConfig:
    """Return a sweep like another, of about so many configurations, most of which lie under the conditions.

    Ranges of what is drawn are cut to the conditions, as far as the rows went; axes of a grid to the values that the
    rows have there; names to those that are left. What cannot be cut has to be left out by whoever counts.
    """
    mask = covered(conditions, found)
    grid = {name: _values(found, mask, name, given) for name, given in config.grid.items()}
    outer = {name: _names(config, found, mask, name) for name in OUTER}
    others = math.prod(len(split_names(names)) if names else 1 for names in outer.values())
    while grid and math.prod(map(_size, grid.values())) * others > 2 * samples:
        longest = max(grid, key=lambda name: _size(grid[name]))
        if _size(grid[longest]) < 2:
            break
        values = grid[longest]
        assert isinstance(values, list)
        grid[longest] = values[::2]
    points = math.prod(map(_size, grid.values())) * others
    cut = {one.place: one for one in conditions}
    controls = {name: {**settings, **_ranges(name, found, mask, cut)} for name, settings in config.controls.items()}
    draws = math.ceil(samples / points) if controls else None
    return _quiet(config, grid=grid, controls=controls, samples=draws, seed=seed, **outer)


def along(
    config: SweepConfig, row: Mapping[str, float | str], factor: Factor, found: Observations, seed: int
) -> SweepConfig:
    """Return a sweep along one factor with everything else as a row has it; the row's own value comes first."""
    place = found.factors.index(factor)
    own = row[factor.name]
    if factor.options:
        values: list[float | str] = [own, *(name for name in factor.options if name != own)]
    else:
        column = found.values[:, place]
        spread = [float(f"{one:.4g}") for one in np.linspace(column.min(), column.max(), ALONG)]
        values = [own, *(one for one in dict.fromkeys(spread) if one != own)]
    grid: dict[str, object] = {name: [value] for name, value in row.items() if "." in name}
    outer = {name: next(iter(_like(config, name, str(row[name]))), None) for name in OUTER}
    if factor.name in OUTER:
        several = [one for value in values for one in _like(config, factor.name, str(value))]
        outer[factor.name] = ",".join(several)
    else:
        grid[factor.name] = values
    fixed = {name: value for name, value in config.set_.items() if name not in grid}
    kept: dict[str, object] = {"keep_pictures": "all", "set": fixed}
    return _quiet(config, grid=grid, controls={}, samples=None, seed=seed, **kept, **outer)


def lies_inside(conditions: RuleConditions, factors: tuple[Factor, ...], row: Mapping[str, float | str]) -> bool:
    """Whether a row lies under all conditions."""
    return all(_holds(one, factors[one.place], row[factors[one.place].name]) for one in conditions)


def _holds(condition: RuleCondition, factor: Factor, value: float | str) -> bool:
    if condition.options is not None:
        return str(value) in {factor.options[one] for one in condition.options}
    return condition.low < float(value) <= condition.high


def _quiet(config: SweepConfig, **changes: object) -> SweepConfig:
    """A sweep with nothing beside its rows."""
    more: dict[str, object] = {"trials": 0, "verify_spp": None, "keep_pictures": "none", "aov": None, "surface": False}
    known = {*SweepConfig.model_fields, "set"}
    given = {name: value for name, value in {**more, **changes}.items() if name in known}
    if not given.get("controls"):
        given["sampler"] = "sobol"
    return SweepConfig(**{**config.plain(), **given})


def _values(found: Observations, mask: Mask, name: str, given: object) -> object:
    """The values of an axis that the rows under the mask have; what was given where it does not vary."""
    place = next((k for k, one in enumerate(found.factors) if one.name == name), None)
    if place is None:
        return given
    options, values = found.factors[place].options, np.unique(found.values[mask, place])
    return [options[int(one)] for one in values] if options else [float(one) for one in values]


def _size(values: object) -> int:
    return len(values) if isinstance(values, list) else 1


def _names(config: SweepConfig, found: Observations, mask: Mask, name: str) -> str | None:
    """The objects, environments or models that the rows under the mask have."""
    left = _values(found, mask, name, None)
    given = getattr(config, name)
    if not isinstance(left, list) or given is None:
        return given if given is None else str(given)
    return ",".join(one for value in left for one in _like(config, name, str(value))) or str(given)


def _like(config: SweepConfig, name: str, value: str) -> list[str]:
    """Of the names that a sweep was given, those that its rows write so."""
    given = split_names(getattr(config, name)) if getattr(config, name) else ()
    return [one for one in given if value in (one, figure_value(one))] or list(given[:1])


def _ranges(control: str, found: Observations, mask: Mask, cut: Mapping[int, RuleCondition]) -> dict[str, object]:
    """The ranges of what a control draws, where a condition cuts them."""
    ranges: dict[str, object] = {}
    for place, condition in cut.items():
        instance, dot, parameter = found.factors[place].name.partition(".")
        if instance == control and dot and condition.options is None:
            column = found.values[:, place]
            low, high = max(condition.low, float(column.min())), min(condition.high, float(column.max()))
            ranges[parameter] = [low, high]
    return ranges
