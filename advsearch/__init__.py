"""advsearch: find the worst-case scene for a vision model.

    scene = advsearch.load_scene("mug", environment="studio")
    model = advsearch.load_model("reference")
    result = advsearch.attack(scene, model, controls=["texture"])

Large packages are only imported when one of these names is used. Editors and type
checkers read the block of imports below. The keywords of `attack`, `sweep` and `render`
are declared in their signatures; those of other experiments are documented by the
classes of their settings.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from advsearch.catalog import is_module_installed, list_built_ins
from advsearch.registry import EXPERIMENTS, get_experiment
from advsearch.version import __version__ as __version__

if TYPE_CHECKING:
    from advsearch import controls as controls
    from advsearch import losses as losses
    from advsearch import maite as maite
    from advsearch import testing as testing
    from advsearch.api.chart import measured_palette as measured_palette
    from advsearch.api.render import load_model as load_model
    from advsearch.api.render import load_run as load_run
    from advsearch.attacks import Policy as Policy
    from advsearch.controls.base import Control as Control
    from advsearch.engine.loading import Scene as Scene
    from advsearch.engine.loading import load_scene as load_scene
    from advsearch.engine.rendering import Rendering as Rendering
    from advsearch.engine.rendering import render as render
    from advsearch.models import Model as Model
    from advsearch.questions.attack.python import attack as attack
    from advsearch.questions.attack.result import AttackResult as AttackResult
    from advsearch.questions.check import check as check
    from advsearch.questions.compare import compare as compare
    from advsearch.questions.explain import explain as explain
    from advsearch.questions.harden import harden as harden
    from advsearch.questions.photographs.carry_out import (
        photo_agreement as photo_agreement,
    )
    from advsearch.questions.precision import precision as precision
    from advsearch.questions.recipe import recipe as recipe
    from advsearch.questions.region import region as region
    from advsearch.questions.replay import replay as replay
    from advsearch.questions.stability import stability as stability
    from advsearch.questions.sweep.carry_out import sweep as sweep
    from advsearch.questions.sweep.result import SweepResult as SweepResult
    from advsearch.questions.test import test as test
    from advsearch.questions.twins import twins as twins
    from advsearch.tasks import Task as Task
    from advsearch.trust.code import allow_code as allow_code


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
}
"""The module of each public name. Every experiment is public, too."""
_MODULES = ["controls", "losses", "maite"]  # public modules

# These belong to islands, and are left out if their files are missing.
if is_module_installed("advsearch.questions.photographs"):
    _HOMES["photo_agreement"] = "advsearch.questions.photographs.carry_out"
if is_module_installed("advsearch.testing"):
    _MODULES.append("testing")

__all__ = sorted({*_HOMES, *_MODULES, *list_built_ins("experiment")})


if not TYPE_CHECKING:  # otherwise a type checker would accept any name

    def __getattr__(name: str) -> Any:
        """Import a name of the public interface on first use (PEP 562).

        So `import advsearch` takes no time for torch and Mitsuba. The name may be a
        module, a function or a class, or an experiment such as "attack".
        """
        if name in _MODULES or name in _HOMES:
            return _import_public_name(name)
        if name.isidentifier() and not name.startswith("_") and name in EXPERIMENTS:
            import_module("advsearch.api")
            return get_experiment(name).python
        if name == "plan":
            raise AttributeError(
                "`plan` is a part of `check` now: use advsearch.check(..., "
                "loss='model')"
            )
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def _import_public_name(name: str) -> Any:
    """Import a public module, or a name in `_HOMES`."""
    import_module("advsearch.api")  # sets the threads before torch is imported
    if name in _MODULES:
        return import_module(f"advsearch.{name}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    """The public names, also those that are imported on first use."""
    return sorted([*__all__, "__version__"])
