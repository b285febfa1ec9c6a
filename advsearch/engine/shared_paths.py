"""Find whether trials of one seed may share the light paths that meet nothing new."""

from __future__ import annotations

from advsearch.engine.problem import Problem
from advsearch.engine.windows import find_searched_inputs, find_searched_refusal
from advsearch.scene.mitsuba_backend.shared_paths import (
    SharedPaths,
    can_share_paths,
)

OPACITY_SUFFIX = ".opacity"


def find_shared_paths(problem: Problem) -> SharedPaths | None:
    """Return what lets trials share light paths; None if each is traced in full.

    Trials of one seed have those paths in common that meet no searched surface, if the
    search changes only the look of surfaces, such as a texture. The surfaces must stay
    where they are, emit no light, and let none through. Paths that meet one are traced
    again in each trial.
    """
    renderer = problem.renderer
    is_excluded = problem.conditions is not None or renderer.composition_reason
    if is_excluded or not can_share_paths(renderer.scene):
        return None
    if find_searched_refusal(problem) is not None:
        return None
    names = find_searched_inputs(problem)
    if any(name.endswith(OPACITY_SUFFIX) for name in names):
        return None
    return SharedPaths(renderer.scene, names)
