"""The typed description of a run: what YAML files, flags and Python calls all become. One file a command.

Each setting states its flag, unit, range and default once, here; the command line's help and the docs are made from
that (`settings`). Names of objects, controls, policies and the rest are checked by whoever looks them up, not here, so
that this package stays light.
"""

from __future__ import annotations

from advsearch import rooms
from advsearch.config.attack import FEWEST_TRIALS, TRIALS, TRIALS_OVER, AttackConfig
from advsearch.config.scene import CLOSE_LOOKS, RenderConfig, SceneConfig
from advsearch.config.sweep import SweepConfig
from advsearch.settings import Config

CONFIGS: dict[str, type[Config]]
"""What the settings of each command are, in the order in which the docs show them; those of questions that are rooms
are read when somebody first asks, since they are made of the kinds here."""

_OWN: tuple[type[Config], ...] = (AttackConfig, RenderConfig, SweepConfig)


def __getattr__(name: str) -> object:
    """`CONFIGS`, when it is first asked for (PEP 562)."""
    if name != "CONFIGS":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = {one.command: one for one in (*_OWN, *rooms.in_rooms("settings", "CONFIG"))}
    globals()[name] = found
    return found


__all__ = [
    "CLOSE_LOOKS", "CONFIGS", "FEWEST_TRIALS", "TRIALS", "TRIALS_OVER", "AttackConfig", "RenderConfig",
    "SceneConfig", "SweepConfig",
]  # fmt: skip
