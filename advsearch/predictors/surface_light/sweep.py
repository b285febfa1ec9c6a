"""Sweeps whose images differ in the camera, predicted by stored light on surfaces."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from advsearch.extend import prediction, seeds, stored_files
from advsearch.predictors.surface_light.arrangement import (
    CAMERA_INPUTS,
    COLOR_INPUT,
    ENVIRONMENT_INPUT,
    FREE_INPUTS,
)
from advsearch.predictors.surface_light.renderer import (
    SurfaceRenderer,
    find_scene_refusal,
)
from advsearch.predictors.surface_light.view_rays import RAYS_PER_PIXEL

ARRANGEMENT_SAMPLES = 2_200_000
LIGHT_SAMPLES = 80_000
"""Costs, as the number of rendered samples that take as long: of an arrangement (what
texels of the surfaces see of each other), and of an environment's light on them.

They take 0.8 s and 0.03 s; an image of 128 x 128 pixels with 8 samples per pixel takes
46 ms.
"""
PREDICTION_SPP = 0.8  # samples per pixel that take as long as a predicted image
ARRANGEMENT_BYTES = 50_000_000  # approximate memory of an arrangement
LIGHT_BYTES = 4_000_000  # approximate memory of an environment's light, without its map


def find_break_even(
    renderer: prediction.Renderer, spp: int, arrangements: float = 1.0
) -> int:
    """Return the number of images under one light for which light on surfaces pays.

    Preparing the light and comparing it with traced images has a fixed cost; each image
    that is predicted saves `spp - PREDICTION_SPP`. The light is used if the images save
    `MIN_SAVING_FACTOR` times the fixed cost. All costs are in samples per pixel.

    Args:
        renderer: renderer of the images.
        spp: samples per pixel of the images, at least 1.
        arrangements: number of arrangements that are found for each light; below 1 if
            several lights share one. An arrangement is what surfaces see of each other.
    """
    height, width = renderer.formation.resolution
    preparation_samples = ARRANGEMENT_SAMPLES * arrangements + LIGHT_SAMPLES
    check_spp = prediction.count_check_samples(spp)
    fixed_spp = preparation_samples / (height * width) + check_spp
    return math.ceil(prediction.MIN_SAVING_FACTOR * fixed_spp / (spp - PREDICTION_SPP))


class LightOnSurfaces(prediction.SweepMethod):
    """Predicts images at one size of a scene by light that is stored on surfaces.

    Images of a group differ only in the camera. Groups in which object and surroundings
    do not move share an *arrangement*: what their surfaces see of each other. Its rays
    are the same for every group, so that it does not matter which group is first.
    """

    name = "surface light"
    samples = RAYS_PER_PIXEL

    def __init__(self, renderer: prediction.Renderer, seed: int) -> None:
        """Find the parameters that move nothing but the camera.

        Args:
            renderer: renderer of the images.
            seed: seed from which the rays of all arrangements follow.
        """
        self._renderer = renderer
        self._seed = seeds.derive_seed(seed, "surface light")
        # An arrangement is where object and surroundings are.
        self._arrangements: list[SurfaceRenderer] = []
        self._max_arrangements = 0  # `find_refusal` sets it
        # which inputs of the scene change with each parameter
        self._changed_inputs = {
            group.name: prediction.find_changed_inputs(renderer, [group.name])
            for group in renderer.space.groups
        }
        self.parameters = self._find_parameters_changing_only(CAMERA_INPUTS)
        # `parameters` includes those that change only the finished image.
        self.changes_scene = any(
            self._changed_inputs[name] & CAMERA_INPUTS for name in self.parameters
        )

    def _find_parameters_changing_only(self, inputs: frozenset[str]) -> frozenset[str]:
        """Return the names of the parameters that change nothing but these inputs.

        A change of the finished image, such as exposure, is allowed, too: it is applied
        to predicted images as to rendered ones.
        """
        allowed = inputs | prediction.IMAGE_INPUTS
        return frozenset(
            name for name, changed in self._changed_inputs.items() if changed <= allowed
        )

    def find_refusal(
        self, make_groups: prediction.MakeGroups, spp: int
    ) -> prediction.Refusal | None:
        """Return why images are rendered; None if they are predicted.

        They are predicted if enough images share their light, the scene has nothing
        that light on surfaces cannot do, and arrangements and light fit into memory. As
        a side effect this sets how many arrangements are cached.

        Args:
            make_groups: returns the groups whose images differ in some parameters.
            spp: samples per pixel of the images.
        """
        # The images of one of these groups have the same light.
        light_groups = make_groups(self.parameters)
        # The images of one of these groups have the same arrangement: neither object
        # nor surroundings move, and the object has one color.
        parameters = self._find_parameters_changing_only(FREE_INPUTS - {COLOR_INPUT})
        arrangement_groups = make_groups(parameters)
        self._max_arrangements = arrangement_groups.n_groups_to_cache
        # below 1 if several lights share an arrangement
        arrangements_per_light = arrangement_groups.n_groups / light_groups.n_groups
        min_images = find_break_even(self._renderer, spp, arrangements_per_light)
        if light_groups.group_size < min_images:
            return prediction.Refusal(
                f"light on surfaces pays where {min_images} pictures differ in the "
                f"camera alone; here {light_groups.group_size} do"
            )
        refusal = find_scene_refusal(self._renderer)
        if refusal is not None:
            return refusal
        return self._find_light_memory_refusal(arrangement_groups, light_groups)

    def _find_light_memory_refusal(
        self, arrangement_groups: prediction.Groups, light_groups: prediction.Groups
    ) -> prediction.Refusal | None:
        """Return a refusal if arrangements and light take too much memory; else None.

        Args:
            arrangement_groups: groups whose images have the same arrangement.
            light_groups: groups whose images have the same light.
        """
        environment = self._renderer.scene.get_base_value(ENVIRONMENT_INPUT)
        light_bytes = LIGHT_BYTES + 4 * environment.numel()  # 4 bytes for a float32
        n_bytes = (
            arrangement_groups.n_groups_to_cache * ARRANGEMENT_BYTES
            + light_groups.n_groups_to_cache * light_bytes
        )
        if n_bytes > stored_files.scale_limit(prediction.MAX_BYTES):
            return prediction.Refusal(
                f"light of {light_groups.n_groups} groups takes too much memory; make the "
                "camera the last axes of the grid"
            )
        return None

    def make_predictor(self, u: Tensor, seed: int) -> prediction.Predictor:
        """Return the predictor of the images of a group.

        The arrangement of another group is reused if object and surroundings have not
        moved. Else a new one is made and cached; if too many are cached, the one that
        was made first is released.

        Args:
            u: (d,) configuration of any image of the group: they differ only in the
                camera, which the predictor takes from the image to predict.
            seed: not used; all arrangements have the same rays.
        """
        with torch.no_grad():
            space_inputs = self._renderer.space.inputs(u)
            inputs = self._renderer.scene.input_assembler(space_inputs)
            for arrangement in self._arrangements:
                if arrangement.is_applicable(inputs):
                    return arrangement.with_fixed_light(inputs)
            if len(self._arrangements) >= self._max_arrangements:
                self._arrangements.pop(0)
            arrangement = SurfaceRenderer(self._renderer, u, self._seed)
            self._arrangements.append(arrangement)
            return arrangement.with_fixed_light(inputs)

    @property
    def bytes(self) -> int:
        """Memory of the arrangements."""
        return sum(arrangement.n_bytes for arrangement in self._arrangements)
