"""Policies: the rules that propose configurations, over the contract of `base`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import is_dataclass
from typing import Any

from advsearch.attacks.candidates import (
    Failures,
    FoundFailure,
    estimate_failure_rate,
    select_diverse,
)
from advsearch.attacks.domain import (
    Domain,
    compute_half_widths,
    find_periodic,
    option_center,
)
from advsearch.attacks.evaluation import (
    Evaluated,
    Evaluation,
    Policy,
    Proposal,
    draw_seed,
    limit_to_single_thread,
    seeded,
)
from advsearch.attacks.policies.auto import Auto, WithoutAscent
from advsearch.attacks.policies.choices import (
    Choices,
    Race,
    RacingPolicy,
    start_race,
    wrap_choices,
)
from advsearch.attacks.policies.evolution import CMAES, NES
from advsearch.attacks.policies.pgd import NO_SQUARES, PGD, Ascent, AscentPolicy
from advsearch.attacks.policies.sampling import (
    Grid,
    NonAdaptivePolicy,
    PointsState,
    Random,
    to_domain,
)
from advsearch.attacks.policies.surrogate import (
    MAX_SCALED_DIM,
    Observations,
    Surrogate,
    find_box_coordinates,
)
from advsearch.catalog import list_built_ins
from advsearch.errors import InputError, UnknownNameError
from advsearch.options import check_options
from advsearch.registry import Registry, get_class

POLICIES: Registry[type[Policy[Any]]] = Registry(
    "advsearch.policies",
    list_built_ins("policy"),
    "a dataclass over Policy whose name is that of the entry point",
    lambda name, entry: (
        isinstance(entry, type)
        and is_dataclass(entry)
        and issubclass(entry, Policy)
        and entry.name == name
    ),
)
"""Every policy by its word on the command line."""

Spec = str | Mapping[str, object] | Policy[Any]
"""A policy inside another one: its name, a mapping with its `name` and options, or the
policy itself.
"""


def make_policy(name: str, **options: Any) -> Policy[Any]:
    """Return a policy by its name, with options, the fields of its dataclass.

    A policy that wraps others takes `policy`, or a list `policies`, by name or as a
    mapping with a name and options:

        make_policy("restarts", policy="pgd", times=4)
        make_policy("portfolio", policies=["cmaes", {"name": "pgd", "momentum": 0.9}])

    Raises:
        UnknownNameError: no such policy, or it has no such option.
        InputError: an option's value is outside its range.
    """
    if name not in POLICIES:
        raise UnknownNameError("policy", name, POLICIES)
    policy = POLICIES[name]
    check_options("policy", name, policy, options)
    if "policy" in options:
        options["policy"] = _make_nested_policy(options["policy"], f"policy of {name}")
    if "policies" in options:
        specs = options["policies"]
        if not isinstance(specs, (list, tuple)):  # a single policy
            specs = [specs]
        where = f"policies of {name}"
        options["policies"] = tuple(_make_nested_policy(spec, where) for spec in specs)
    return policy(**options)


def _make_nested_policy(spec: Spec, where: str) -> Policy[Any]:
    """Return the policy inside another one.

    Args:
        spec: a policy, a name, or a mapping with a `name` and options.
        where: where the policy was stated, for messages, e.g. "policy of restarts".

    Raises:
        InputError: it is something else.
    """
    if isinstance(spec, Policy):
        return spec
    if isinstance(spec, str):
        return make_policy(spec)
    if not isinstance(spec, Mapping) or not isinstance(spec.get("name"), str):
        raise InputError(
            f"{where}: expected a name or a mapping with a name and "
            f"options, got {spec!r}"
        )
    options = {option: spec[option] for option in spec if option != "name"}
    return make_policy(str(spec["name"]), **options)


def __getattr__(name: str) -> Any:
    """Import the class of a policy that is an island on first use."""
    return get_class("policy", name)


__all__ = [
    "CMAES",
    "MAX_SCALED_DIM",
    "NES",
    "NO_SQUARES",
    "PGD",
    "POLICIES",
    "Ascent",
    "AscentPolicy",
    "Auto",
    "Choices",
    "Domain",
    "Evaluated",
    "Evaluation",
    "Failures",
    "FoundFailure",
    "Grid",
    "NonAdaptivePolicy",
    "Observations",
    "PointsState",
    "Policy",
    "Proposal",
    "Race",
    "RacingPolicy",
    "Random",
    "Spec",
    "Surrogate",
    "WithoutAscent",
    "compute_half_widths",
    "draw_seed",
    "estimate_failure_rate",
    "find_box_coordinates",
    "find_periodic",
    "limit_to_single_thread",
    "make_policy",
    "option_center",
    "seeded",
    "select_diverse",
    "start_race",
    "to_domain",
    "wrap_choices",
]
