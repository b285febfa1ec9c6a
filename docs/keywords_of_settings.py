"""An extension of mkdocstrings' reader: functions that take settings are shown with every keyword, as `help` does."""

from __future__ import annotations

import importlib
import inspect
from typing import Any

import griffe


class KeywordsOfSettings(griffe.Extension):  # type: ignore[misc]
    """Takes signature and docstring of what `advsearch.api.keywords.asks` decorates from the function itself."""

    def on_function(self, *, func: griffe.Function, **rest: Any) -> None:
        """Replace both, where a function is decorated so."""
        decorated = any(str(one.value).startswith("asks(") for one in func.decorators)
        if not decorated or func.parent is None or func.docstring is None:
            return
        function = getattr(importlib.import_module(func.parent.path), func.name)
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
        func.docstring.value = inspect.getdoc(function) or ""
