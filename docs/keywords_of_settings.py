"""An extension of mkdocstrings' reader: functions that take settings are shown with every keyword, as `help` does."""

from __future__ import annotations

import inspect
from typing import Any

import griffe

import advsearch


class KeywordsOfSettings(griffe.Extension):  # type: ignore[misc]
    """Takes signature and docstring of the functions that `advsearch/__init__.pyi` declares from these themselves."""

    def on_function(self, *, func: griffe.Function, **rest: Any) -> None:
        """Replace both, where a function is declared there."""
        if func.parent is None or func.parent.path != "advsearch" or func.name.startswith("_"):
            return
        function = getattr(advsearch, func.name)
        parameters = inspect.signature(function).parameters.values()
        func.parameters = griffe.Parameters(
            *(
                griffe.Parameter(
                    one.name,
                    kind=getattr(griffe.ParameterKind, one.kind.name.lower()),
                    annotation=str(one.annotation),
                    default=None if one.default is one.empty else repr(one.default),
                )
                for one in parameters
            )
        )
        func.docstring = griffe.Docstring(inspect.getdoc(function) or "", parent=func)
