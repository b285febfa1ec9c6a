"""Measure gradients of a scene, and plan how a search gets them (docs/gradients.md).

    bench = gradients.Bench(renderer, loss, gradients.find_interior_point(renderer),
    seed=0, spp=16) rows = list(gradients.measure_derivatives(bench, reference_spp=64,
    seeds_of_reference=(6, 16)))

A `Bench` takes gradients of a loss, by any plan. `derivatives` compares estimators with
differences of many samples, which experiments about gradients do and a search does not;
`planning` chooses what a search takes, by measurement.
"""

from __future__ import annotations

from advsearch.engine.gradients import planning
from advsearch.engine.gradients.bench import (
    Bench,
    Loss,
    find_interior_point,
    restrict_plan,
)
from advsearch.engine.gradients.derivatives import (
    FACTORS,
    GradientEstimate,
    Probe,
    Reference,
    compare_with_reference,
    find_probes,
    list_attempts,
    make_smooth_loss,
    measure_derivatives,
    measure_reference,
)
from advsearch.scene.formation import OMISSIONS
from advsearch.scene.gradients import (
    ADJOINT_ESTIMATORS,
    DIFFERENCE_ESTIMATORS,
    GradientPlan,
    Group,
)
from advsearch.scene.renderer import Renderer

__all__ = [
    "ADJOINT_ESTIMATORS",
    "DIFFERENCE_ESTIMATORS",
    "FACTORS",
    "OMISSIONS",
    "Bench",
    "GradientEstimate",
    "GradientPlan",
    "Group",
    "Loss",
    "Probe",
    "Reference",
    "Renderer",
    "compare_with_reference",
    "find_interior_point",
    "find_probes",
    "list_attempts",
    "make_smooth_loss",
    "measure_derivatives",
    "measure_reference",
    "planning",
    "restrict_plan",
]
