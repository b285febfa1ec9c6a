"""Predict images by light that is stored on surfaces, where only cameras move.

See docs/surface-light.md.
"""

from __future__ import annotations

from typing import Any

from torch import Tensor

from advsearch.extend import Policy, Problem, prediction
from advsearch.predictors.surface_light.arrangement import CAMERA_INPUTS, FREE_INPUTS
from advsearch.predictors.surface_light.renderer import find_scene_refusal
from advsearch.predictors.surface_light.search import (
    SurfaceLight,
    find_surface_light_refusal,
)
from advsearch.predictors.surface_light.sweep import LightOnSurfaces, find_break_even


class SurfaceLightMethod(prediction.PredictionMethod):
    """Predicts images from many cameras by light that is stored on surfaces."""

    name = "surface_light"
    pictures_are = "predicted by light on surfaces"
    follows_bounces = False

    def find_search_refusal(
        self, problem: Problem, steps: int, policy: Policy[Any]
    ) -> prediction.Refusal | None:
        return find_surface_light_refusal(problem, steps, policy)

    def make_search(
        self,
        problem: Problem,
        steps: int,
        *,
        collect_light: prediction.Evaluate,
        clean_matrix: prediction.CleanMatrix,
    ) -> prediction.PredictedSearch:
        return SurfaceLight(problem, steps)

    def find_trials_refusal(
        self, problem: Problem, coordinates: Tensor, spp: int, n_images: int
    ) -> prediction.Refusal | None:
        if not _can_light_follow(problem, coordinates):
            return prediction.NOTHING_MOVES
        return _find_light_refusal(problem.renderer, spp, n_images)

    def make_trials(
        self, problem: Problem, u: Tensor, coordinates: Tensor
    ) -> prediction.PredictedSearch:
        return SurfaceLight(problem, 0, light_u=u, moving_coordinates=coordinates)

    def make_sweep_method(
        self, renderer: prediction.Renderer, seed: int
    ) -> prediction.SweepMethod:
        return LightOnSurfaces(renderer, seed)


def _can_light_follow(problem: Problem, coordinates: Tensor) -> bool:
    """Return whether the camera moves, and light on surfaces can follow what varies.

    Args:
        problem: problem of the trials.
        coordinates: (k,) indices of the coordinates that vary.
    """
    varying = set(coordinates.tolist())
    # the parameters that have any of these coordinates
    parameter_names = [
        group.name
        for group in problem.space.groups
        if not varying.isdisjoint(range(group.begin, group.begin + group.size))
    ]
    changed_inputs = prediction.find_changed_inputs(problem.renderer, parameter_names)
    moves_camera = bool(changed_inputs & CAMERA_INPUTS)
    # light on surfaces cannot follow a change of any other input
    can_follow = changed_inputs <= FREE_INPUTS
    return moves_camera and can_follow


def _find_light_refusal(
    renderer: prediction.Renderer, spp: int, n_images: int
) -> prediction.Refusal | None:
    """Return why light on surfaces is not tried; None if it is.

    Args:
        renderer: renderer of the images.
        spp: samples per pixel of the images.
        n_images: number of images under one light.
    """
    refusal = find_scene_refusal(renderer)
    if refusal is not None:
        return refusal
    min_images = find_break_even(renderer, spp)
    if n_images >= min_images:
        return None
    reason = f"light on surfaces pays from {min_images} pictures on"
    # The cause is named after an attack, in which each image is a step.
    return prediction.Refusal(reason, prediction.RefusalCause.TOO_FEW_STEPS)
