"""Predict images from many cameras and under many environments by light on surfaces.

`find_refusal` returns why the images of a scene or a space cannot be predicted.
"""

from __future__ import annotations

import copy
from collections.abc import (
    Callable,
    Collection,
    Iterable,
    Iterator,
    Mapping,
    Sequence,
)
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from advsearch.extend import prediction, stored_files
from advsearch.predictors.surface_light.arrangement import (
    CAMERA_INPUTS,
    COLOR_INPUT,
    ENVIRONMENT_INPUT,
    FREE_INPUTS,
    Arrangement,
    ArrangementLight,
    SurfaceView,
)
from advsearch.predictors.surface_light.view_rays import RAYS_PER_PIXEL, ViewSamples

MAX_RAYS = 1 << 21  # rays of cameras of one launch
N_COMPARED_TEXELS = 333  # texels of a map that are compared with those of other maps


class LitCameraView(NamedTuple):
    """View of one camera, and the light that it is seen under."""

    camera_index: int  # index of the camera
    view: SurfaceView
    light: ArrangementLight  # light of a stored environment
    # (3,) factor on that light, by channel, for the environment of this view
    light_factor: Tensor | float


@dataclass(frozen=True, eq=False)
class MapFingerprint:
    """Fingerprint of an environment's map, for comparison with other maps."""

    mean: Tensor  # (3,) mean of the map
    # (n, 3) some of its texels divided by the mean: equal for all multiples of the map
    relative_texels: Tensor

    @classmethod
    def compute(cls, padded: Tensor) -> MapFingerprint:
        """Return the fingerprint of a map (H, W + 2, 3)."""
        texels = padded.reshape(-1, 3)
        mean = texels.mean(dim=0)
        stride = max(1, len(texels) // N_COMPARED_TEXELS)
        return cls(mean, texels[::stride] / mean.clamp_min(1e-12))

    def compute_map_ratio(self, other: MapFingerprint) -> Tensor | None:
        """Return the factor (3,), by channel, with which this map becomes another one.

        None if the other map is not a multiple of this one.
        """
        if self.relative_texels.shape != other.relative_texels.shape:
            return None
        if not torch.allclose(
            self.relative_texels, other.relative_texels, rtol=1e-5, atol=1e-6
        ):
            return None
        return torch.where(self.mean > 0.0, other.mean / self.mean, 1.0)


class SurfaceRenderer(prediction.Predictor):
    """Predict images by light on surfaces, in spaces that `find_refusal` accepts.

    An image is linear in the base color of the object. Light between the object and
    itself, or from the object to the ground and back, is computed for the base color
    `base_color`; see `update_base_color`.

    Args:
        traced: renderer of the scene.
        u: (d,) configuration; everything but cameras, environment and base color keeps
            its value there.
        seed: seed of the rays from texels.

    Attributes:
        base_color: (h, w, 3) base color for which light between surfaces is computed.
        stored_lights: lights by the fingerprints of their maps, oldest first.
        n_dropped: number of lights that were removed to store others.
        fixed_light: light of all images, see `with_fixed_light`. None if every image
            has the light of its own environment.
    """

    fixed_light: ArrangementLight | None = None
    n_traced_images = 0

    def __init__(self, traced: prediction.Renderer, u: Tensor, seed: int) -> None:
        """Lay texels over the scene as it is at one configuration.

        Predictions hold as long as only cameras, environment and base color change.

        Args:
            traced: renderer of the scene.
            u: (d,) configuration.
            seed: seed of the rays by which texels see each other and the sky.
        """
        super().__init__(traced)
        self.n_dropped = 0  # lights
        self.stored_lights: dict[MapFingerprint, ArrangementLight] = {}
        # values for inputs that a configuration leaves at those of the scene
        self._scene_values = {
            name: traced.scene.get_base_value(name)
            for name in (*CAMERA_INPUTS, ENVIRONMENT_INPUT, COLOR_INPUT)
            if name in traced.scene.input_names
        }
        inputs = self.compute_inputs(u)
        self.base_color = self.get_color(inputs)
        fixed_inputs = _drop_free_inputs(inputs)
        texture_shape = (self.base_color.shape[0], self.base_color.shape[1])
        with torch.no_grad():
            self.arrangement = Arrangement(traced, fixed_inputs, texture_shape, seed)

    def compute_inputs(self, u: Tensor) -> dict[str, Tensor]:
        """Return the scene inputs of a configuration (d,), without a graph."""
        with torch.no_grad():
            return self.path_renderer.scene.input_assembler(
                self.path_renderer.space.inputs(u)
            )

    def get_color(self, inputs: Mapping[str, Tensor]) -> Tensor:
        """Return the base color (h, w, 3) of scene inputs."""
        return inputs.get(COLOR_INPUT, self._scene_values[COLOR_INPUT])

    def is_applicable(self, inputs: Mapping[str, Tensor]) -> bool:
        """Return whether `predict_images` holds for some scene inputs.

        They may differ from those of this arrangement in cameras and environment
        (`FREE_INPUTS`). The base color is one of these, too, but `predict_images` does
        not change it: so it is compared here.
        """
        expected = {**self.arrangement.inputs, COLOR_INPUT: self.base_color}
        fixed_inputs = _drop_free_inputs(inputs)
        fixed_inputs[COLOR_INPUT] = self.get_color(inputs)
        return expected.keys() == fixed_inputs.keys() and not any(
            prediction.inputs_differ(expected[name], fixed_inputs[name])
            for name in expected
        )

    def update_base_color(self, u: Tensor) -> None:
        """Take the light between surfaces from the base color at u from now on."""
        self.base_color = self.get_color(self.compute_inputs(u))
        self.stored_lights.clear()

    def with_fixed_light(self, inputs: Mapping[str, Tensor]) -> SurfaceRenderer:
        """Return a predictor of images that are all under the environment of inputs."""
        other = copy.copy(self)
        other.fixed_light = self.compute_light(inputs)
        other.stored_lights = {}
        return other

    @property
    def batch_size(self) -> int:
        """Number of images in one launch."""
        height, width = self.path_renderer.formation.resolution
        return max(1, MAX_RAYS // (height * width * RAYS_PER_PIXEL))

    @property
    def n_entries(self) -> int:
        """Number of entries of the arrangement's matrices."""
        return self.arrangement.n_entries

    @property
    def n_bytes(self) -> int:
        """Memory of the arrangement and the stored lights.

        A renderer with a fixed light was made by `with_fixed_light`. It shares the
        arrangement with the original, so that only its light counts.
        """
        if self.fixed_light is not None:
            return self.fixed_light.n_bytes
        lights = sum(light.n_bytes for light in self.stored_lights.values())
        return self.arrangement.n_bytes + lights

    def compute_light(self, inputs: Mapping[str, Tensor]) -> ArrangementLight:
        """Compute the light under the environment of scene inputs."""
        padded = self._get_environment(inputs)
        return self.arrangement.compute_light(padded, self.base_color)

    def _get_environment(self, inputs: Mapping[str, Tensor]) -> Tensor:
        """Return the padded map (H, W + 2, 3) of scene inputs, without a graph."""
        stated_map = self._scene_values[ENVIRONMENT_INPUT]
        return inputs.get(ENVIRONMENT_INPUT, stated_map).detach()

    def get_light_and_factor(
        self, inputs: Mapping[str, Tensor]
    ) -> tuple[ArrangementLight, Tensor]:
        """Return the light under the environment of scene inputs, and a factor (3,).

        Light is linear in the environment. So maps that differ only by exposure or tint
        share one stored light. Times the factor of each color channel, the light that
        is returned is that of `inputs`. A light is computed on first use. Up to
        `MAX_BYTES` of lights are stored; the oldest are dropped first.
        """
        fingerprint = MapFingerprint.compute(self._get_environment(inputs))
        for stored_fingerprint, light in self.stored_lights.items():
            factor = stored_fingerprint.compute_map_ratio(fingerprint)
            if factor is not None:
                return light, factor
        light = self.compute_light(inputs)
        self.stored_lights[fingerprint] = light
        self._drop_old_lights()
        return light, torch.ones(3)

    def _drop_old_lights(self) -> None:
        """Drop the oldest lights over the limit of memory; the newest stays in any case."""
        # `self.n_bytes` includes the stored lights.
        while len(self.stored_lights) > 1 and self.n_bytes > stored_files.scale_limit(
            prediction.MAX_BYTES
        ):
            oldest = next(iter(self.stored_lights))
            self.stored_lights.pop(oldest)
            self.n_dropped += 1

    def _choose_light(
        self, inputs: Mapping[str, Tensor]
    ) -> tuple[ArrangementLight, Tensor | float]:
        """Return the light of scene inputs and its factor, or the fixed light."""
        if self.fixed_light is None:
            return self.get_light_and_factor(inputs)
        return self.fixed_light, 1.0

    def _select_camera_inputs(self, inputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the inputs that are the camera's, completed by those of the scene."""
        names = CAMERA_INPUTS & self._scene_values.keys()
        return {name: inputs.get(name, self._scene_values[name]) for name in names}

    def trace_views(
        self, inputs: Sequence[Mapping[str, Tensor]]
    ) -> Iterator[LitCameraView]:
        """Yield the view of each camera, in groups of cameras under the same light.

        A group is traced in one launch. The next launch is started before the results
        of this one are used, so that the rays are traced while the caller works.

        Args:
            inputs: scene inputs of each camera. Views come in the order of groups;
                `LitCameraView.camera_index` is the index in `inputs`.
        """
        cameras_of_light, light_factors = self._group_by_light(inputs)
        launches = self._iterate_launches(inputs, cameras_of_light)
        finish_launch = next(launches)
        for light, camera_indices in cameras_of_light.items():
            samples = finish_launch()
            # Start the next launch, which runs while these samples are used. After the
            # last one nothing is left, and `finish_launch` stays, but is not called.
            finish_launch = next(launches, finish_launch)
            for index_in_launch, camera_index in enumerate(camera_indices):
                view = self.arrangement.make_view(samples, index_in_launch)
                yield LitCameraView(
                    camera_index, view, light, light_factors[camera_index]
                )

    def _group_by_light(
        self, inputs: Sequence[Mapping[str, Tensor]]
    ) -> tuple[dict[ArrangementLight, list[int]], list[Tensor | float]]:
        """Return the cameras under each light, and for each camera the light's factor.

        Args:
            inputs: scene inputs of each camera.
        """
        cameras_of_light: dict[ArrangementLight, list[int]] = {}
        light_factors = []
        for camera_index, camera_inputs in enumerate(inputs):
            light, light_factor = self._choose_light(camera_inputs)
            cameras_of_light.setdefault(light, []).append(camera_index)
            light_factors.append(light_factor)
        return cameras_of_light, light_factors

    def _iterate_launches(
        self,
        inputs: Sequence[Mapping[str, Tensor]],
        cameras_of_light: Mapping[ArrangementLight, Sequence[int]],
    ) -> Iterator[Callable[[], ViewSamples]]:
        """Start the launch of each light; yield a function that waits for its samples.

        Args:
            inputs: scene inputs of each camera.
            cameras_of_light: indices of the cameras under each light.
        """
        cameras = [
            self._select_camera_inputs(camera_inputs) for camera_inputs in inputs
        ]
        for light, camera_indices in cameras_of_light.items():
            lit_cameras = [cameras[camera_index] for camera_index in camera_indices]
            yield self.arrangement.start_tracing(lit_cameras, light)

    def compose_images(
        self,
        views: Iterable[LitCameraView],
        inputs: Sequence[Mapping[str, Tensor]],
        color: Tensor,
        full_configurations: Sequence[Tensor],
    ) -> Tensor:
        """Return the images (n, H, W, 3), sRGB, of an object with a base color.

        Args:
            views: views of the n cameras, in any order.
            inputs: scene inputs of each camera, such as its exposure; their base color
                is ignored.
            color: (h, w, 3) base color; the images are differentiable in it.
            full_configurations: for each camera the values (d,) of all coordinates.
                Controls that change the finished image, such as blur, read them.
        """
        fine_color = self.arrangement.upsample(color)
        # What the surface reflects is the same for all cameras under one light, and is
        # computed once.
        reflected_by_light = dict[ArrangementLight, Tensor]()
        images = dict[int, Tensor]()
        for lit_view in views:
            light = lit_view.light
            camera_index = lit_view.camera_index
            if light not in reflected_by_light:
                reflected_by_light[light] = light.compute_reflected(fine_color)
            radiance = lit_view.view.compute_radiance(reflected_by_light[light])
            # from the stored light to that of the camera's environment
            radiance = radiance * lit_view.light_factor
            images[camera_index] = self.path_renderer.finish_image(
                radiance,
                inputs[camera_index],
                full_configurations[camera_index],
            )
        return torch.stack([images[index] for index in range(len(inputs))])

    def predict_images(self, us: Sequence[Tensor]) -> list[Tensor]:
        """Return images of configurations that differ in camera and environment only.

        Args:
            us: configurations (d,). `batch_size` of them are traced in one launch.
        """
        images = list[Tensor]()
        with torch.no_grad():
            for start in range(0, len(us), self.batch_size):
                batch = us[start : start + self.batch_size]
                inputs = [self.compute_inputs(u) for u in batch]
                images += self.compose_images(
                    self.trace_views(inputs),
                    inputs,
                    color=self.base_color,
                    full_configurations=batch,
                )
        return images

    def predict_radiance(self, inputs: Mapping[str, Tensor]) -> Tensor:
        """Return the radiance (H, W, 3) of scene inputs, with their own base color."""
        (lit_view,) = self.trace_views([inputs])
        fine_color = self.arrangement.upsample(self.get_color(inputs))
        reflected = lit_view.light.compute_reflected(fine_color)
        return lit_view.view.compute_radiance(reflected) * lit_view.light_factor


def _drop_free_inputs(inputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return scene inputs without those that may change."""
    return {name: inputs[name] for name in inputs if name not in FREE_INPUTS}


def find_refusal(
    renderer: prediction.Renderer, varying: Collection[str]
) -> prediction.Refusal | None:
    """Return why light on surfaces cannot predict a space's images; None if it can.

    How good a prediction is does not count here: that is measured afterwards.

    Args:
        renderer: renderer of the space.
        varying: names of the controls that vary, which may change `FREE_INPUTS`, such
            as cameras and the environment. The others are searched, and may change
            only the base color.
    """
    refusal = find_scene_refusal(renderer)
    if refusal is not None:
        return refusal
    refusal = _find_searched_group_refusal(renderer, varying)
    if refusal is not None:
        return refusal
    changed = prediction.find_changed_inputs(renderer, varying)
    # A change of anything else moves or repaints surfaces, so that the stored light
    # would no longer hold.
    if not changed <= FREE_INPUTS:
        return prediction.Refusal(
            f"{', '.join(sorted(changed - FREE_INPUTS))} varies, and light on "
            "surfaces is stored for one arrangement"
        )
    if not changed & CAMERA_INPUTS:
        return prediction.Refusal("no camera varies", prediction.RefusalCause.NO_CAMERA)
    return None


def _find_searched_group_refusal(
    renderer: prediction.Renderer, varying: Collection[str]
) -> prediction.Refusal | None:
    """Return why a searched group, which does not vary, is refused; None if none is."""
    for group in renderer.plan.groups:
        # A group with the estimator "image" changes only the finished image.
        if group.control in varying or group.estimator == "image":
            continue
        if renderer.inputs_by_group.get(group.name, frozenset()) != {COLOR_INPUT}:
            return prediction.Refusal(
                f"{group.name} changes more than the object's base color"
            )
    return None


def find_scene_refusal(renderer: prediction.Renderer) -> prediction.Refusal | None:
    """Return why light cannot be stored on a scene's surfaces; None if it may be.

    It can be if the scene is an object with one texture on a ground, under an
    environment, and if images are denoised: predictions have no noise.
    """
    description = renderer.scene.description_and_filter[0]
    mesh_part = description.meshes[prediction.OBJECT]
    has_mitsuba_surface = mesh_part.surface is not None
    if mesh_part.mesh.repeats or has_mitsuba_surface:
        return prediction.Refusal(
            "the object's surface repeats its texture, or is one of Mitsuba's own"
        )
    has_more_light_or_parts = len(description.parts) > 0 or description.has_emission
    if description.environment is None or has_more_light_or_parts:
        return prediction.Refusal(
            "there is more in the scene than the object, its ground and an environment"
        )
    if renderer.scene.is_volumetric or description.thin_lens or description.backdrop:
        return prediction.Refusal(
            "there is haze, a lens with an aperture, or a plain background"
        )
    if description.get_number("camera.drops") > 0.0:
        return prediction.Refusal("there are raindrops before the camera")
    if renderer.formation.denoiser != "oidn":
        return prediction.NOISE
    return None
