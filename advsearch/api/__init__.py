"""The Python interface: what `import advsearch` offers, and what the command line calls."""

from __future__ import annotations

from advsearch import threads as threads  # before torch: it sets how OpenMP waits
from advsearch.api.attacking import attack, attack_from_config, resume_attack
from advsearch.api.mapping import region_from_config
from advsearch.api.outcome import AttackResult
from advsearch.api.questions import gap, region
from advsearch.api.rendering import Rendering, render, render_from_config
from advsearch.api.scene import Scene, load_scene
from advsearch.api.studies import curve_from_config, gap_from_config
from advsearch.api.sweeping import sweep, sweep_from_config
from advsearch.api.sweeps.loop import SweepResult
from advsearch.models import Model, load_model

__all__ = [
    "AttackResult",
    "Model",
    "Rendering",
    "Scene",
    "SweepResult",
    "attack",
    "attack_from_config",
    "curve_from_config",
    "gap",
    "gap_from_config",
    "load_model",
    "load_scene",
    "region",
    "region_from_config",
    "render",
    "render_from_config",
    "resume_attack",
    "sweep",
    "sweep_from_config",
]
