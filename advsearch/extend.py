"""The interface for extensions of advsearch: experiments, controls, tasks, policies,
model sources, readers, exporters, predictors and clusters.

    from advsearch.extend import Control, Parameter, Values

Everything else in the package may change without notice. The optional built-in parts
import nothing else either. A name is imported on first use, so that a control does not
import the modules of an experiment. docs/extending.md has an example of each name.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from advsearch.version import __version__ as __version__

if TYPE_CHECKING:
    from advsearch import errors as errors
    from advsearch import models as models
    from advsearch import rules as rules
    from advsearch import seeds as seeds
    from advsearch import settings as settings
    from advsearch import statistics as statistics
    from advsearch import tasks as tasks
    from advsearch.api import exports as exports
    from advsearch.api import prediction as prediction
    from advsearch.api import workbench as workbench
    from advsearch.attacks import Policy as Policy
    from advsearch.attacks import policies as policies
    from advsearch.cluster import workers as workers
    from advsearch.config import DerivativeConfig as DerivativeConfig
    from advsearch.config import SceneConfig as SceneConfig
    from advsearch.controls.base import Choice as Choice
    from advsearch.controls.base import Control as Control
    from advsearch.controls.base import Parameter as Parameter
    from advsearch.controls.base import Values as Values
    from advsearch.controls.ranges import Fixed as Fixed
    from advsearch.controls.ranges import OneOf as OneOf
    from advsearch.controls.ranges import Range as Range
    from advsearch.controls.support import images as images
    from advsearch.controls.support.picture_control import (
        PictureControl as PictureControl,
    )
    from advsearch.engine import gradients as gradients
    from advsearch.engine.problem import Problem as Problem
    from advsearch.errors import InputError as InputError
    from advsearch.experiment import PositionalArgument as PositionalArgument
    from advsearch.experiment import RunContext as RunContext
    from advsearch.experiment import experiment as experiment
    from advsearch.models import Model as Model
    from advsearch.options import Value as Value
    from advsearch.progress import Progress as Progress
    from advsearch.questions.attack.settings import AttackConfig as AttackConfig
    from advsearch.questions.sweep.settings import SweepConfig as SweepConfig
    from advsearch.report import figures as figures
    from advsearch.report import views as views
    from advsearch.report import wording as wording
    from advsearch.runs import directory as directory
    from advsearch.runs import results as results
    from advsearch.runs.directory import RunDirectory as RunDirectory
    from advsearch.runs.exporters import Exported as Exported
    from advsearch.runs.exporters import Exporter as Exporter
    from advsearch.runs.results import RunResult as RunResult
    from advsearch.runs.store import Store as Store
    from advsearch.runs.summary import read_result as read_result
    from advsearch.scene import assets as assets
    from advsearch.scene import color as color
    from advsearch.scene import geometry as geometry
    from advsearch.scene import parts as parts
    from advsearch.scene.description import SceneDescription as SceneDescription
    from advsearch.scene.importing import reading as reading
    from advsearch.scene.mitsuba_backend import mitsuba_data as mitsuba_data
    from advsearch.settings import Config as Config
    from advsearch.settings import setting as setting
    from advsearch.settings import setting_as_in as setting_as_in
    from advsearch.tasks import Task as Task
    from advsearch.trust import stored_files as stored_files
    from advsearch.trust import writing as writing
    from advsearch.viewer import markup as markup

_NAMES = {
    "advsearch.attacks": ("Policy",),
    "advsearch.config": ("DerivativeConfig", "SceneConfig"),
    "advsearch.controls.base": ("Choice", "Control", "Parameter", "Values"),
    "advsearch.controls.ranges": ("Fixed", "OneOf", "Range"),
    "advsearch.controls.support.picture_control": ("PictureControl",),
    "advsearch.engine.problem": ("Problem",),
    "advsearch.errors": ("InputError",),
    "advsearch.experiment": ("PositionalArgument", "RunContext", "experiment"),
    "advsearch.models": ("Model",),
    "advsearch.options": ("Value",),
    "advsearch.progress": ("Progress",),
    "advsearch.questions.attack.settings": ("AttackConfig",),
    "advsearch.questions.sweep.settings": ("SweepConfig",),
    "advsearch.runs.directory": ("RunDirectory",),
    "advsearch.runs.exporters": ("Exported", "Exporter"),
    "advsearch.runs.results": ("RunResult",),
    "advsearch.runs.store": ("Store",),
    "advsearch.runs.summary": ("read_result",),
    "advsearch.scene.description": ("SceneDescription",),
    "advsearch.settings": ("Config", "setting", "setting_as_in"),
    "advsearch.tasks": ("Task",),
}
"""The names of the interface, by the module from which they are imported."""

_MODULES = {
    "assets": "advsearch.scene.assets",
    "color": "advsearch.scene.color",
    "directory": "advsearch.runs.directory",
    "errors": "advsearch.errors",
    "exports": "advsearch.api.exports",
    "figures": "advsearch.report.figures",
    "geometry": "advsearch.scene.geometry",
    "gradients": "advsearch.engine.gradients",
    "images": "advsearch.controls.support.images",
    "markup": "advsearch.viewer.markup",
    "mitsuba_data": "advsearch.scene.mitsuba_backend.mitsuba_data",
    "models": "advsearch.models",
    "parts": "advsearch.scene.parts",
    "policies": "advsearch.attacks.policies",
    "prediction": "advsearch.api.prediction",
    "reading": "advsearch.scene.importing.reading",
    "results": "advsearch.runs.results",
    "rules": "advsearch.rules",
    "seeds": "advsearch.seeds",
    "settings": "advsearch.settings",
    "statistics": "advsearch.statistics",
    "stored_files": "advsearch.trust.stored_files",
    "tasks": "advsearch.tasks",
    "views": "advsearch.report.views",
    "wording": "advsearch.report.wording",
    "workbench": "advsearch.api.workbench",
    "workers": "advsearch.cluster.workers",
    "writing": "advsearch.trust.writing",
}
"""Modules that belong to the interface with all their public names."""

_MODULE_OF_NAME = {name: module for module, names in _NAMES.items() for name in names}

__all__ = sorted({*_MODULE_OF_NAME, *_MODULES})


def __getattr__(name: str) -> Any:
    """Import a name of the interface on first use (PEP 562)."""
    if name in _MODULES:
        return import_module(_MODULES[name])
    if name in _MODULE_OF_NAME:
        return getattr(import_module(_MODULE_OF_NAME[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return list(__all__)
