"""Find whether trials of a seed may share light paths that meet no searched surface."""

from __future__ import annotations

from advsearch.engine.problem import Problem
from advsearch.engine.windows import find_searched_inputs, find_searched_refusal
from advsearch.scene.mitsuba_backend.shared_paths import (
    SharedPaths,
    can_share_paths,
)

# ending of an input that makes a surface transparent, such as "mug.bsdf.opacity"
OPACITY_SUFFIX = ".opacity"


def find_shared_paths(problem: Problem) -> SharedPaths | None:
    """Return what lets trials share light paths; None if each is traced in full.

    If the search changes only the look of surfaces, such as a texture, trials of one
    seed have those paths in common that meet no searched surface. The surfaces must
    stay where they are, emit no light, and be opaque. Paths that meet one of them are
    traced again in each trial.
    """
    renderer = problem.renderer
    has_conditions = problem.conditions is not None
    # an image that is composed of several, e.g. of a photograph and a render
    is_composed = bool(renderer.composition_reason)
    if has_conditions or is_composed or not can_share_paths(renderer.scene):
        return None
    # not if lights or moving things are searched, which change paths everywhere
    if find_searched_refusal(problem) is not None:
        return None
    input_names = find_searched_inputs(problem)
    is_opacity_searched = any(name.endswith(OPACITY_SUFFIX) for name in input_names)
    if is_opacity_searched:
        return None
    return SharedPaths(renderer.scene, input_names)
