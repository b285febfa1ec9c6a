"""An extension of mkdocstrings' reader: functions that take settings are shown with
every keyword, as `help` does.
"""

from __future__ import annotations

import inspect
from typing import Any

import griffe

import advsearch
from advsearch.catalog import list_built_ins


class KeywordsOfSettings(griffe.Extension):  # type: ignore[misc]
    """Takes signature and docstring of the experiments' functions from these
    themselves.
    """

    def on_function(self, *, func: griffe.Function, **rest: Any) -> None:
        """Replace both, where a function is that of an experiment."""
        home = "" if func.parent is None else func.parent.path
        if func.name not in list_built_ins("experiment") or not home.startswith(
            "advsearch.questions."
        ):
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
