"""advsearch: find the scene that a vision model gets wrong most badly.

    scene = advsearch.load_scene("mug", environment="studio")
    model = advsearch.load_model("reference")
    result = advsearch.attack(scene, model, controls=["texture"])

Nothing heavy is imported until one of these is used. Editors and type checkers read `__init__.pyi`, which
`tools/stubs.py` makes.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

from advsearch.catalog import list_built_ins
from advsearch.registry import EXPERIMENTS, get_experiment

__version__ = "0.1.0"

_HOMES = {
    "AttackResult": "advsearch.questions.attack.result",
    "Control": "advsearch.controls.base",
    "Model": "advsearch.models",
    "Policy": "advsearch.attacks",
    "Rendering": "advsearch.api.render",
    "Scene": "advsearch.engine.loading",
    "SweepResult": "advsearch.questions.sweep.result",
    "Task": "advsearch.tasks",
    "allow_code": "advsearch.trust.code",
    "load_model": "advsearch.api.render",
    "load_run": "advsearch.api.render",
    "load_scene": "advsearch.engine.loading",
    "measured_palette": "advsearch.api.chart",
    "photo_agreement": "advsearch.questions.photographs.carry_out",
}
"""The public names, and the module of each. Every experiment is public too."""
_MODULES = ("controls", "losses", "maite", "testing")  # public modules
__all__ = sorted({*_HOMES, *_MODULES, *list_built_ins("experiment")})


def __getattr__(name: str) -> Any:
    """Import the interface on first use (PEP 562)."""
    if name in _MODULES or name in _HOMES:
        import_module("advsearch.api")  # sets the threads before torch is imported
        return import_module(f"advsearch.{name}") if name in _MODULES else getattr(import_module(_HOMES[name]), name)
    if name.isidentifier() and not name.startswith("_") and name in EXPERIMENTS:
        import_module("advsearch.api")
        return get_experiment(name).python
    if name == "plan":
        raise AttributeError("`plan` is a part of `check` now: use advsearch.check(..., loss='model')")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """The public names, also those that are imported on first use."""
    return sorted([*__all__, "__version__"])
