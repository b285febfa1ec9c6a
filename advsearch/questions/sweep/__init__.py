"""Measure how often a model is right over a grid or a sample of configurations."""

from __future__ import annotations

from advsearch.experiment import RunContext, experiment
from advsearch.questions.sweep.display import make_sweep_claims, make_sweep_view
from advsearch.questions.sweep.page import make_page
from advsearch.questions.sweep.settings import SweepConfig
from advsearch.questions.sweep.summary import SweepSummary


@experiment(
    "sweep --object mug --grid pose.yaw=0:360:24 --grid camera.elevation=5:60:8",
    "sweep --object mug,bowl --environment studio,noon --grid "
    "camera.azimuth=0,90,180,270",
    "sweep --object mug --control pose,camera --samples 1000",
    "sweep --object mug --control pose --samples 200 --surface",
    "sweep --adversarial-of mug-texture-001 --control camera,environment --samples 200",
    about="adversarial_of",
    defaults_from_run=SweepConfig.load_attack_defaults,
    python_function="advsearch.questions.sweep.carry_out:sweep",
    view=make_sweep_view,
    claims=make_sweep_claims,
    page=make_page,
)
def sweep(context: RunContext[SweepConfig]) -> SweepSummary:
    """Measure how often the model is right."""
    from advsearch.questions.sweep.carry_out import sweep_from_config  # imports torch

    return sweep_from_config(
        context.config, progress=context.progress, resumed=context.resumed_directory
    ).summary
