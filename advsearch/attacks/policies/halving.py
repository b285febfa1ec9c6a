"""Successive halving: many starts looked at briefly, the better ones longer and with less noise."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch

from advsearch.attacks.domain import Domain
from advsearch.attacks.policies import racing
from advsearch.attacks.policies.base import Policy, draw_seed, seeded
from advsearch.attacks.policies.choices import with_choices
from advsearch.attacks.policies.racing import MOST_SAMPLES, Race, Raced
from advsearch.attacks.policies.stay import Stay
from advsearch.errors import InputError

MOST_STARTS = 1024
"""No more starts than these, however many renders there are."""

MOST_NUMBERS = 2**23
"""And no more, but two, than have so many numbers together: they are all kept."""

WORTH = 8
"""Evaluations that a search from each start should have in every round."""


@dataclass(frozen=True)
class Halving(Raced):
    """Successive halving over starts and sample counts (Karnin, Koren and Somekh 2013; Jamieson and Talwalkar 2016).

    Starts are the clean configuration and samples of the domain (by turns at the extremes of the norm balls and inside,
    as `random` draws them). They race in rounds of equally many renders, see `racing`: after a round the best of every
    `eta` go on, so each of them has `eta` times the renders of the round before. These pay

    - by default for one render of the configuration itself with as many times the samples per pixel: the noise falls as
      the field gets closer. Only the objectives of a round count in it;
    - with a `policy`, for a search from each start that goes on from round to round, its samples growing by `eta` too.
      That keeps the number of evaluations of a round the same for all that are in it.

    No evaluation has more than 64 times the search's samples.

    Attributes:
        policy: what searches from each start; None renders the starts alone.
        eta: one of so many goes on, from 2 to 16.
        starts: how many, at least 1; 0 for as many as fit, up to 1024 (of a texture fewer, for
            memory's sake).

    Raises:
        InputError: a value is outside what is said here.
    """

    policy: Policy[Any] | None = None
    eta: int = 3
    starts: int = 0

    name: ClassVar[str] = "halving"
    handles_choices: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if not 2 <= self.eta <= 16:
            raise InputError(f"eta: expected a whole number from 2 to 16, got {self.eta}; try 3")
        if not 0 <= self.starts <= MOST_STARTS:
            raise InputError(f"starts: expected 1 to {MOST_STARTS}, or 0 for as many as fit, got {self.starts}")

    @property
    def uses_gradient(self) -> bool:
        return self.policy is not None and self.policy.uses_gradient

    def start(self, domain: Domain, generator: torch.Generator, steps: int) -> Race:
        seed = draw_seed(generator)
        policy: Policy[Any] = Stay(MOST_SAMPLES) if self.policy is None else with_choices(self.policy, domain)
        each = 1 if self.policy is None else WORTH * (1 + (domain.gradient_cost if policy.uses_gradient else 0))
        limit = self.starts or min(MOST_STARTS, max(2, MOST_NUMBERS // domain.dim))
        count = racing.most_runners(steps, self.eta, each, limit)
        others = (domain.sample(seeded(seed, number), extreme=bool(number % 2))[0] for number in range(1, count))
        searches = [(policy, replace(domain, first=begin)) for begin in (domain.begin, *others)]
        growth = 1 if self.policy is None else self.eta
        return racing.line_up(searches, steps, seed, eta=self.eta, fresh=True, growth=growth)
