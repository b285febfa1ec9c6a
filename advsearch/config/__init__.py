"""The typed description of a run: what YAML files, flags and Python calls all become. One file a command.

Each setting states its flag, unit, range and default once, here; the command line's help and the docs are made from
that (`settings`). Names of objects, controls, policies and the rest are checked by whoever looks them up, not here, so
that this package stays light.
"""

from __future__ import annotations

from advsearch.config.attack import FEWEST_TRIALS, TRIALS, TRIALS_OVER, AttackConfig
from advsearch.config.checking import CheckConfig, PlanConfig, StabilityConfig
from advsearch.config.derivative import DerivativeConfig
from advsearch.config.explain import ExplainConfig
from advsearch.config.hardening import HardenConfig
from advsearch.config.precision import QUANTITIES, SAMPLERS, PrecisionConfig
from advsearch.config.questions import FEWEST_SAMPLES, GapConfig, RegionConfig
from advsearch.config.recipe import RecipeConfig
from advsearch.config.rendering import RenderConfig
from advsearch.config.replaying import WAYS, ReplayConfig
from advsearch.config.scene import AUTO_SHARE, CLOSE_LOOKS, SEARCH_SPP, SceneConfig
from advsearch.config.sweep import SweepConfig
from advsearch.questions.test.settings import SuiteConfig
from advsearch.settings import Config

CONFIGS: dict[str, type[Config]] = {
    one.command: one
    for one in (
        AttackConfig,
        RenderConfig,
        SweepConfig,
        GapConfig,
        RegionConfig,
        ReplayConfig,
        PlanConfig,
        CheckConfig,
        StabilityConfig,
        PrecisionConfig,
        RecipeConfig,
        ExplainConfig,
        HardenConfig,
        SuiteConfig,
    )
}
"""What the settings of each command are, in the order in which the docs show them."""

__all__ = [
    "AUTO_SHARE",
    "CLOSE_LOOKS",
    "CONFIGS",
    "FEWEST_SAMPLES",
    "FEWEST_TRIALS",
    "QUANTITIES",
    "SAMPLERS",
    "SEARCH_SPP",
    "TRIALS",
    "TRIALS_OVER",
    "WAYS",
    "AttackConfig",
    "CheckConfig",
    "DerivativeConfig",
    "ExplainConfig",
    "GapConfig",
    "HardenConfig",
    "PlanConfig",
    "PrecisionConfig",
    "RecipeConfig",
    "RegionConfig",
    "RenderConfig",
    "ReplayConfig",
    "SceneConfig",
    "StabilityConfig",
    "SuiteConfig",
    "SweepConfig",
]
