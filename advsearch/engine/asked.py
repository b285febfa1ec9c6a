"""What an objective may ask for beside a model's output, the pictures and the truth, with a graph; docs/objectives.md.

As the terms of `printable` it depends on u alone, so that it is the same for rendered and for predicted pictures.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from advsearch.controls import Space
from advsearch.errors import InputError, UnknownNameError


class Named(Mapping[str, Tensor]):
    """Tensors by name, of N configurations: each (N, ...).

    Args:
        what: a name stands for, for messages.
        each: of each configuration.
    """

    def __init__(self, what: str, each: Sequence[Mapping[str, Tensor]]) -> None:
        self._what, self._each = what, each

    def __getitem__(self, name: str) -> Tensor:
        if name not in self:
            raise UnknownNameError(self._what, name, self._each[0])
        return torch.stack([one[name] for one in self._each])

    def __contains__(self, name: object) -> bool:
        return name in self._each[0]

    def __iter__(self) -> Iterator[str]:
        return iter(self._each[0])

    def __len__(self) -> int:
        return len(self._each[0])


class Asked:
    """Gives what is asked for at N configurations, which differ in nothing that is searched.

    Args:
        space: the controls behind the whole of u.
        searched: the controls that are searched, which come first there.
        wholes: the configurations, (d,) each, of the whole space.

    Attributes:
        used: whether anything was asked for.
    """

    def __init__(self, space: Space, searched: Space, wholes: Sequence[Tensor]) -> None:
        self._space, self._searched, self._wholes = space, searched, wholes
        self.used = False

    def __call__(self, name: str) -> Any:
        """Return what an objective asks for.

        Args:
            name: "u", (N, d) of the searched controls; "texture", (N, h, w, 3) display-referred sRGB in [0, 1], the
                searched colours of the control that has some, or (N, h, w, 4) with 1 where they are searched and 0
                elsewhere; "textures", the same by control, where several have some; "inputs", the scene inputs by
                name; "configuration", the numbers by parameter.

        Raises:
            InputError: there is not exactly one texture.
        """
        self.used = True
        if name == "inputs":
            return Named("input of the scene", [self._space.inputs(whole) for whole in self._wholes])
        if name == "configuration":
            return Named("number of the configuration", [self._space.numbers(whole) for whole in self._wholes])
        u = self._wholes[0][: len(self._searched.start)]
        if name == "u":
            return u.expand(len(self._wholes), *u.shape)
        printed = self._searched.printed(u)
        if name == "textures":
            return Named("control whose colours are searched:", [printed] * len(self._wholes))
        if len(printed) != 1:
            got = ", ".join(printed or (control.name for control in self._searched.controls)) or "nothing"
            instead = "ask for `textures`, which has them by name" if printed else "add `texture` or `patch`"
            raise InputError(
                f"objective: it asks for `texture`, the colours of one control that are searched, got {got}; {instead}"
            )
        (colors,) = printed.values()
        return colors.expand(len(self._wholes), *colors.shape)
