"""advsearch: find the scene that a vision model gets wrong most badly.

    scene = advsearch.load_scene("mug", environment="studio")
    model = advsearch.load_model("reference")
    result = advsearch.attack(scene, model, controls=["texture"])

Nothing heavy is imported until one of these is used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from advsearch.api import (
        AttackResult,
        Model,
        Rendering,
        Scene,
        SweepResult,
        attack,
        gap,
        load_model,
        load_scene,
        region,
        render,
        sweep,
    )

__version__ = "0.1.0"

__all__ = [
    "AttackResult",
    "Model",
    "Rendering",
    "Scene",
    "SweepResult",
    "attack",
    "gap",
    "load_model",
    "load_scene",
    "region",
    "render",
    "sweep",
]


def __getattr__(name: str) -> Any:
    """Import the interface on first use (PEP 562)."""
    if name in __all__:
        from advsearch import api

        return getattr(api, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """The public names, also those that are imported on first use."""
    return sorted([*__all__, "__version__"])
