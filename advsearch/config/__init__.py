"""The typed description of a run: what YAML files, flags and Python calls all become. One file a command.

Each setting states its flag, unit, range and default once, here; the command line's help and the docs are made from
that (`settings`). Names of objects, controls, policies and the rest are checked by whoever looks them up, not here, so
that this package stays light.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from advsearch import rooms
from advsearch.config.attack import FEWEST_TRIALS, TRIALS, TRIALS_OVER, AttackConfig
from advsearch.config.scene import CLOSE_LOOKS, RenderConfig, SceneConfig
from advsearch.config.sweep import SweepConfig
from advsearch.settings import Config


class _Configs(Mapping[str, type[Config]]):
    def __init__(self) -> None:
        self._own = {one.command: one for one in (AttackConfig, RenderConfig, SweepConfig)}

    def __iter__(self) -> Iterator[str]:
        asked = (name for name in rooms.rooms() if name not in self._own and rooms.Room(name).config is not None)
        return iter((*self._own, *asked))

    def __len__(self) -> int:
        return len(list(iter(self)))

    def __getitem__(self, name: str) -> type[Config]:
        found = self._own.get(name) or getattr(rooms.room(name), "config", None)
        if found is None:
            raise KeyError(name)
        return found


CONFIGS: Mapping[str, type[Config]] = _Configs()
"""What the settings of each command are, in the order in which the docs show them; those of a question are read when
somebody first asks for them, since they are made of the kinds here."""

__all__ = [
    "CLOSE_LOOKS", "CONFIGS", "FEWEST_TRIALS", "TRIALS", "TRIALS_OVER", "AttackConfig", "RenderConfig",
    "SceneConfig", "SweepConfig",
]  # fmt: skip
