"""The samples a pixel that the stages of a run take, in counts that its sampler has."""

from __future__ import annotations

from collections.abc import Sequence

from advsearch.attacks.sample_count import LADDER
from advsearch.config import AttackConfig, SweepConfig
from advsearch.scene.mitsuba_backend.samplers import next_count


def search_samples(config: AttackConfig | SweepConfig) -> int:
    """Samples a pixel of a picture of the search or the sweep."""
    return next_count(config.pixel_sampler, config.search_spp)


def verification_ladder(config: AttackConfig | SweepConfig) -> Sequence[int]:
    """Sample counts that the verification climbs; one alone if it was asked for."""
    asked = config.verify_spp
    return LADDER if asked is None else (next_count(config.pixel_sampler, asked),)
