"""Find whether trials of one seed may share the light paths that meet nothing new."""

from __future__ import annotations

from advsearch.engine.problem import Problem
from advsearch.engine.windows import find_searched_inputs, find_searched_refusal
from advsearch.scene.mitsuba_backend.shared_paths import (
    SharedPaths,
    find_shared_paths_refusal,
)

OPACITY_SUFFIX = ".opacity"


def find_shared_paths(problem: Problem) -> SharedPaths | None:
    """Return what traces the common paths of trials once; None if each is traced in
    full.

    They may share paths where the search changes nothing but surfaces, which stay where
    they are, and emit and pass no light.
    """
    renderer = problem.renderer
    is_excluded = problem.conditions is not None or renderer.composition_reason
    if is_excluded or find_shared_paths_refusal(renderer.scene):
        return None
    if find_searched_refusal(problem) is not None:
        return None
    names = find_searched_inputs(problem)
    if any(name.endswith(OPACITY_SUFFIX) for name in names):
        return None
    return SharedPaths(renderer.scene, names)
