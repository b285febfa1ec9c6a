"""Policies: the rules that propose configurations. One file each, over the contract of `base`."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from advsearch.attacks.policies.auto import Auto
from advsearch.attacks.policies.base import Policy, Proposal, draw_seed, seeded
from advsearch.attacks.policies.pgd import PGD
from advsearch.attacks.policies.random import Random
from advsearch.errors import UnknownNameError

POLICIES: dict[str, type[Policy[Any]]] = {"auto": Auto, "pgd": PGD, "random": Random}


def make_policy(name: str, **options: Any) -> Policy[Any]:
    """Return the policy of that name with the given options, which are its dataclass's fields.

    Raises:
        UnknownNameError: no such policy, or it has no such option.
        InputError: an option's value is outside its range.
    """
    if name not in POLICIES:
        raise UnknownNameError("policy", name, POLICIES)
    policy = POLICIES[name]
    known = [field.name for field in fields(policy)]  # type: ignore[arg-type]
    for option in options:
        if option not in known:
            raise UnknownNameError(f"option of policy {name!r}:", option, known)
    return policy(**options)


__all__ = [
    "PGD",
    "POLICIES",
    "Auto",
    "Policy",
    "Proposal",
    "Random",
    "draw_seed",
    "make_policy",
    "seeded",
]
