"""advsearch: find the scene that a vision model gets wrong most badly.

    scene = advsearch.load_scene("mug", environment="studio")
    model = advsearch.load_model("reference")
    result = advsearch.attack(scene, model, controls=["texture"])

Nothing heavy is imported until one of these is used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from advsearch.rooms import made_question, made_questions

if TYPE_CHECKING:
    from advsearch import losses as losses
    from advsearch import testing as testing
    from advsearch.api.render import Rendering as Rendering
    from advsearch.api.render import load_model as load_model
    from advsearch.api.render import load_run as load_run
    from advsearch.api.render import render as render
    from advsearch.attacks import Policy as Policy
    from advsearch.controls.base import Control as Control
    from advsearch.engine.attack_result import AttackResult as AttackResult
    from advsearch.engine.loading import Scene as Scene
    from advsearch.engine.loading import load_scene as load_scene
    from advsearch.engine.sweeps.summary import SweepResult as SweepResult
    from advsearch.models import Model as Model
    from advsearch.questions.attack.carry_out import attack as attack
    from advsearch.questions.check.carry_out import check as check
    from advsearch.questions.compare.carry_out import compare as compare
    from advsearch.questions.explain.carry_out import explain as explain
    from advsearch.questions.gap import gap as gap
    from advsearch.questions.harden.carry_out import harden as harden
    from advsearch.questions.photographs.carry_out import photo_agreement as photo_agreement
    from advsearch.questions.plan.carry_out import plan as plan
    from advsearch.questions.precision.carry_out import precision as precision
    from advsearch.questions.recipe.carry_out import recipe as recipe
    from advsearch.questions.region.carry_out import region as region
    from advsearch.questions.replay.carry_out import replay as replay
    from advsearch.questions.stability.carry_out import stability as stability
    from advsearch.questions.sweep.carry_out import sweep as sweep
    from advsearch.registry import allow_code as allow_code
    from advsearch.tasks import Task as Task

__version__ = "0.1.0"

_HOMES = {
    "AttackResult": "advsearch.engine.attack_result",
    "Control": "advsearch.controls.base",
    "Model": "advsearch.models",
    "Policy": "advsearch.attacks",
    "Rendering": "advsearch.api.render",
    "Scene": "advsearch.engine.loading",
    "SweepResult": "advsearch.engine.sweeps.summary",
    "Task": "advsearch.tasks",
    "allow_code": "advsearch.registry",
    "attack": "advsearch.questions.attack.carry_out",
    "check": "advsearch.questions.check.carry_out",
    "compare": "advsearch.questions.compare.carry_out",
    "explain": "advsearch.questions.explain.carry_out",
    "harden": "advsearch.questions.harden.carry_out",
    "load_model": "advsearch.api.render",
    "load_run": "advsearch.api.render",
    "load_scene": "advsearch.engine.loading",
    "photo_agreement": "advsearch.questions.photographs.carry_out",
    "plan": "advsearch.questions.plan.carry_out",
    "precision": "advsearch.questions.precision.carry_out",
    "recipe": "advsearch.questions.recipe.carry_out",
    "region": "advsearch.questions.region.carry_out",
    "render": "advsearch.api.render",
    "replay": "advsearch.questions.replay.carry_out",
    "stability": "advsearch.questions.stability.carry_out",
    "sweep": "advsearch.questions.sweep.carry_out",
}
"""The public names, and the module of each; besides, every question that
`advsearch.question` makes."""

_MODULES = ("losses", "testing")
"""Public modules."""

__all__ = [*_HOMES, *_MODULES, *made_questions()]


def __getattr__(name: str) -> Any:
    """Import the interface on first use (PEP 562)."""
    if name in __all__:
        import_module("advsearch.api")  # sets the threads before torch is imported
        if name in made_questions():
            return made_question(name).python
        return import_module(f"advsearch.{name}") if name in _MODULES else getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """The public names, also those that are imported on first use."""
    return sorted([*__all__, "__version__"])
