"""The typed description of a run: what YAML files, flags and Python calls all become.

Each setting states its flag, unit, range and default once; the command line's help and the docs are made from that
(`settings`). What many commands need is in `config.scene`, the rest is with each question. Names of objects, controls,
policies and the rest are checked by whoever looks them up, so that settings stay light.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from advsearch import rooms
from advsearch.config.scene import CLOSE_LOOKS, RenderConfig, SceneConfig
from advsearch.settings import Config

FIRST = ("attack", "render", "sweep")
"""The commands that the docs show first."""


class _Configs(Mapping[str, type[Config]]):
    def __iter__(self) -> Iterator[str]:
        there = [name for name in FIRST if name in ("render", *rooms.rooms())]
        return iter(
            (*there, *(one for one in rooms.rooms() if one not in FIRST and rooms.Room(one).config is not None))
        )

    def __len__(self) -> int:
        return len(list(iter(self)))

    def __getitem__(self, name: str) -> type[Config]:
        config: type[Config] | None = RenderConfig if name == "render" else getattr(rooms.room(name), "config", None)
        if config is None:
            raise KeyError(name)
        return config


CONFIGS: Mapping[str, type[Config]] = _Configs()
"""What the settings of each command are, in the order in which the docs show them; those of a question are read when
somebody first asks for them."""

__all__ = ["CLOSE_LOOKS", "CONFIGS", "RenderConfig", "SceneConfig"]
