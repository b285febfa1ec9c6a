"""Render configurations: `render(u, seed, spp)`, differentiable in torch autograd.

See docs/design.md, "One function in the middle".

    u in [0, 1]^d --space--> scene inputs --assembly, Mitsuba--> radiance --image
    formation--> (H, W, 3) sRGB in [0, 1]

Autograd differentiates the arrows outside Mitsuba, which are torch operations.
Mitsuba's arrow is a custom autograd function, whose backward pass renders the adjoint
with a seed of its own. Coordinates that the gradient plan assigns to differences get
their derivative from a second custom function, which is the identity in the forward
pass.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from advsearch import seeds
from advsearch.errors import InputError
from advsearch.pictures import encode_levels
from advsearch.scene.assembly import IMAGE_INPUTS, Motion, write_central_differences
from advsearch.scene.backdrop import compose_over_photograph, compute_front
from advsearch.scene.color import to_uint8
from advsearch.scene.description import OBJECT, SceneDescription
from advsearch.scene.formation import ImageFormation, InputMapping, Moment, Surfaces
from advsearch.scene.geometry import camera_to_world, compute_center
from advsearch.scene.gradients import (
    ADJOINT_ESTIMATORS,
    DIFFERENCE_ESTIMATORS,
    TURN_STEP,
    Group,
    compute_steps,
    forbid_second_derivatives,
    make_first_plan,
)
from advsearch.scene.image_quality import blur_image
from advsearch.scene.mitsuba_backend.denoise import denoise_image
from advsearch.scene.mitsuba_backend.scene import MitsubaScene
from advsearch.scene.mitsuba_backend.shared_paths import SharedPaths
from advsearch.scene.rig import RigCamera
from advsearch.scene.scene_data import cache_per_scene
from advsearch.scene.window import Window

MAX_SPP = 65536
# a point of the unit box
Configuration = Tensor | npt.NDArray[np.floating[Any]] | Sequence[float]
# from inputs, seed and spp to radiance (H, W, 3)
Source = Callable[[Mapping[str, Tensor], int, int], Tensor]
Predict = Callable[[Mapping[str, Tensor]], Tensor]
"""From scene inputs to linear radiance (H, W, 3); differentiable.

With a backdrop it is (H, W, 4), with coverage. With a plane that receives the shadow in
a photograph it is (H, W, 7 or 13), with the changes of that plane.
"""


class InputSpace(InputMapping, Protocol):
    """Interface of a space for the renderer and for a user's own loop.

    It has the start, the groups of coordinates, and the effects of a configuration.
    """

    @property
    def start(self) -> Tensor:
        """(d,) float32 in [0, 1]: the unchanged scene."""

    @property
    def groups(self) -> tuple[Group, ...]:
        """Every group of coordinates with its valid estimators."""

    def advance_time(self, seconds: float) -> InputMapping:
        """Return what maps u to scene inputs some seconds later."""

    def apply_to_image(self, u: Tensor, image: Tensor) -> Tensor:
        """Change the finished image; differentiable."""

    def get_printable_colors(self, u: Tensor) -> dict[str, Tensor]:
        """Return the colors that are searched, (h, w, 3) or (h, w, 4), by control.

        They are differentiable.
        """

    def get_numeric_values(self, u: Tensor) -> dict[str, Tensor]:
        """Return the numbers of the configuration, in their units, by name.

        They are differentiable.
        """


class Crop(NamedTuple):
    """A part of the image that is rendered, and a fixed image of the rest."""

    window: Window  # window of the pixels that are rendered
    # radiance (H, W, 3) of the full image; with a backdrop (H, W, 4), with coverage
    surrounding_image: Tensor


class _MomentRender(NamedTuple):
    """What is rendered of one moment of an exposure."""

    inputs: dict[str, Tensor]  # inputs of Mitsuba's scene
    seed: int  # of the noise
    spp: int  # samples per pixel
    # (H, 1, 1) the moment's fraction of the exposure of each row. Rows of a sensor may
    # be read one after the other: then each is exposed during some moments only. Over
    # all moments the fractions of a row add up to 1.
    row_weights: Tensor


# Largest size of a group whose motion of outlines is measured.
MAX_MEASURED_SIZE = 64
# fraction of the noise over which the tone curve is nearly straight; see
# `Renderer.render_independent_images`
STRAIGHT_FRACTION = 0.0625


class Renderer:
    """Render the configurations of one space in one scene.

    Attributes:
        start: (d,) float32 in [0, 1], the configuration that leaves the scene as it is.
        plan: how each coordinate is differentiated; may be replaced.
        inputs_by_group: which scene inputs each group of coordinates reaches, by
            `control.parameter`.
        crop: part of each image that is rendered; None for all of it.
        shared_paths: object that renders full images in place of the scene; None if the
            scene renders them.
        n_renders: number of primal renders so far, those of differences included.
        n_gradients: number of adjoint renders so far.
        n_non_finite: number of pixels and gradient entries that were NaN or infinite
            and were set to zero.

    Args:
        scene: the scene inside Mitsuba, at the formation's resolution.
        space: space of configurations, which maps u to scene inputs.
        formation: how radiance becomes the image.
        root_seed: seed from which all others are derived. Renderers with different root
            seeds have independent noise, even at the same `seed` of a call.
        moments: moments of an exposure during which something moves; an image is their
            mean. Empty if nothing moves.
        motion: object that measures how fast coordinates move points. None uses the
            default step for all.
        estimators: estimators that the user forces, by "control.parameter", "control"
            or "*".
    """

    def __init__(
        self,
        scene: MitsubaScene,
        space: InputSpace,
        formation: ImageFormation,
        root_seed: int = 0,
        *,
        motion: Motion | None = None,
        estimators: Mapping[str, str] | None = None,
        moments: Sequence[Moment] = (),
    ) -> None:
        """Plan how each coordinate is differentiated.

        Args:
            scene: the scene that is traced.
            space: the space, which maps a configuration u to scene inputs.
            formation: how radiance becomes an image: resolution, denoiser, tone curve.
            root_seed: seed from which all seeds of renders are derived.
            motion: measures how fast outlines move; None: they count as not moving.
            estimators: estimators of the derivative that the user forces, by the name
                of a group or control.
            moments: moments of an exposure of some time; empty for a single one.
        """
        self.scene = scene
        self.space = space
        self.formation = formation
        self.moments = tuple(moments)
        self.root_seed = root_seed
        self._shape = space.start.shape
        # functions that replace the scene's tracing, see `copy_with`
        self._external_render: Source | None = None
        self._predict: Predict | None = None
        self.crop: Crop | None = None
        self.shared_paths: SharedPaths | None = None
        self.n_renders = 0
        self.n_gradients = 0
        self.n_non_finite = 0
        # estimators that the backward pass skips, set by `gradient` for its call
        self._skipped_estimators: frozenset[str] = frozenset()
        groups = space.groups
        self.plan = make_first_plan(
            groups,
            self._compute_steps(groups, motion),
            estimators,
            image_size=max(formation.resolution),
        )
        self.inputs_by_group = self._find_reached_inputs(groups)

    @property
    def start(self) -> Tensor:
        return self.space.start

    def __repr__(self) -> str:
        height, width = self.formation.resolution
        groups = [f"{group.name} ({group.size})" for group in self.space.groups]
        return (
            f"Renderer({len(self.start)} numbers: {', '.join(groups)}; "
            f"{height} x {width} pixels)"
        )

    def _repr_png_(self) -> bytes:
        """Return the image of the start for a notebook; it is not counted."""
        with torch.no_grad():
            return encode_levels(to_uint8(self.copy_with()(self.start)).numpy())

    @property
    def composition_reason(self) -> str:
        """Why an image is composed of several renders; empty if it is one render.

        Only an image of one scene through one camera can be predicted from light that
        was collected once.
        """
        has_several_cameras = bool(self.scene.description_and_filter[0].rig)
        if has_several_cameras:
            return "a picture is made of those of several cameras"
        has_several_moments = bool(self.moments)
        if has_several_moments:
            return "a picture is made of several moments"
        return ""

    def copy_with(
        self,
        scene: MitsubaScene | None = None,
        *,
        external_render: Source | None = None,
        predict: Predict | None = None,
        crop: Crop | None = None,
        **formation: Any,
    ) -> Renderer:
        """Return a renderer of the same space with some changes.

        Its counters of renders start from those of this one, and count independently.
        An argument that is None leaves the value of this renderer.

        Args:
            scene: another scene.
            external_render: function of another program, which renders and denoises.
            predict: function that predicts radiance (`scene.predictor`). Then the seed
                and the samples of a call have no effect, and autograd differentiates
                all coordinates through the scene inputs, for any plan.
            crop: part of each image that is rendered.
            formation: other fields of the image formation.
        """
        other = copy.copy(self)
        other.formation = replace(self.formation, **formation)
        other.scene = scene or self.scene
        other._external_render = external_render or self._external_render
        other._predict = predict or self._predict
        other.crop = crop or self.crop
        return other

    @contextmanager
    def share_paths(self, paths: SharedPaths | None) -> Iterator[None]:
        """Let renders inside the `with` block share paths.

        Images with one seed have a part of their paths in common. Inside the block that
        part is traced once for all of them.

        Args:
            paths: stores the shared paths. With None, or with those of another scene,
                each image is traced in full.
        """
        paths_before = self.shared_paths
        is_of_scene = paths is not None and paths.scene is self.scene
        self.shared_paths = paths if is_of_scene else None
        try:
            yield
        finally:
            self.shared_paths = paths_before

    @property
    def window(self) -> Window | None:
        """Window of the image that is rendered; None for all of it."""
        return self.crop.window if self.crop else None

    def crop_to(self, window: Window, u: Tensor, seed: int, spp: int) -> Renderer:
        """Return a renderer that renders only a window of each image.

        Around the window, all images show the same: the image of u, which is rendered
        now, and does not count as a render.

        Args:
            window: rows and columns that are rendered.
            u: (d,) configuration of the surroundings.
            seed: seed of their noise.
            spp: their samples per pixel.
        """
        with torch.no_grad():
            inputs = self.scene.input_assembler(self.space.inputs(u))
            # A copy counts its renders itself, so that this one is not counted here.
            surroundings = self.copy_with().render_radiance(
                _select_scene_inputs(inputs),
                seed,
                spp,
                hide_environment="backdrop.color" in inputs,
            )
        return self.copy_with(crop=Crop(window, surroundings))

    def __call__(self, u: Configuration, seed: int = 0, spp: int = 16) -> Tensor:
        """Render one or several configurations as finished images.

        Args:
            u: (d,) in [0, 1], a tensor or an array; or (N, d), rendered one after the
                other with the same seed. It is rendered in float32, whatever its dtype.
            seed: seed of the noise; the same seed gives the same bytes.
            spp: independent samples per pixel, 1 to 65,536.

        Returns:
            (H, W, 3) float32, display-referred sRGB in [0, 1], or (N, H, W, 3);
            differentiable with respect to u, in `torch.inference_mode` too (not in
            `torch.no_grad`), and once: a second derivative is an error. The derivative
            has noise of its own and float32 steps, so that `torch.autograd.gradcheck`
            can't pass; `check` compares it with differences that are wide enough.

        Raises:
            InputError: u has another shape, or values outside [0, 1], or spp is out of
                range; or u requires a gradient and was made in `torch.inference_mode`.
        """
        u = _to_tensor(u)
        is_batch = u.ndim == 2 and len(u) > 0
        if is_batch:
            return torch.stack([self(row, seed, spp) for row in u])
        # An empty batch goes on, and is rejected for its shape.
        u, autograd_u = self._check_arguments(u, spp)
        with _leave_inference_mode():
            image = self._render_image(autograd_u, seed, spp)
            # Autograd does not differentiate all coordinates through `autograd_u` if
            # that is another tensor than u. The others are differentiated by
            # differences.
            if autograd_u is not u and self._needs_differences():
                image = _Differences.apply(self, seed, spp, u, image)  # type: ignore[no-untyped-call]
            return image

    def _needs_differences(self) -> bool:
        """Return whether a derivative is wanted that takes differences."""
        return torch.is_grad_enabled() and len(self._select_difference_groups()) > 0

    def radiance(self, u: Configuration, seed: int = 0, spp: int = 16) -> Tensor:
        """Render linear radiance (H, W, 3) float32; arguments as for a call.

        It is denoised if the formation requires it. It is multiplied by the exposure of
        the configuration, and laid over a backdrop. Controls that change the finished
        image are not applied.
        """
        _, autograd_u = self._check_arguments(u, spp)
        with _leave_inference_mode():
            return self._render_image(autograd_u, seed, spp, display=False)

    def render_independent_images(
        self, u: Tensor, seed: int, spp: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Trace two images of a configuration with independent noise.

        The tone curve is concave, so that it makes noisy images darker on average. So
        the two images are not mapped by the curve, but by a straight line: its tangent
        at the third, denoised image. They may leave [0, 1]. There is no graph, and the
        renders are not counted.

        Args:
            u: (d,) configuration in [0, 1].
            seed: seed of the noise.
            spp: samples per pixel of each image.

        Returns:
            Three images (H, W, 3): two that are not denoised, and the denoised mean of
            both.
        """
        with torch.no_grad():
            inputs = self.scene.input_assembler(self.space.inputs(u))
            halves, mean = self.trace_independent_radiances(inputs, seed, spp)
            # with exposure and backdrop, before the curve
            finish = partial(self.finish_image, inputs=inputs, u=u, display=False)
            clean = finish(mean)
            clean_image = self.formation.map_to_display(clean)
            first, second = (
                self._display_on_tangent(finish(half), clean, clean_image, u)
                for half in halves
            )
            return first, second, self.space.apply_to_image(u, clean_image)

    def _display_on_tangent(
        self, radiance: Tensor, clean: Tensor, clean_image: Tensor, u: Tensor
    ) -> Tensor:
        """Return the image of radiance on the tone curve's tangent at `clean`.

        The change along the tangent is extrapolated from a small fraction of the change of
        radiance, within which the curve is nearly straight.

        Args:
            radiance: (H, W, 3) radiance before the curve.
            clean: (H, W, 3) the same without noise.
            clean_image: (H, W, 3) sRGB, the image of `clean`.
            u: configuration, for the controls that change the finished image.
        """
        nearby = torch.lerp(clean, radiance, STRAIGHT_FRACTION)
        small_change = self.formation.map_to_display(nearby) - clean_image
        change = small_change / STRAIGHT_FRACTION
        return self.space.apply_to_image(u, clean_image + change)

    def trace_independent_radiances(
        self, inputs: Mapping[str, Tensor], seed: int, spp: int
    ) -> tuple[list[Tensor], Tensor]:
        """Trace the radiance of scene inputs twice, with independent noise.

        The renders are not counted.

        Args:
            inputs: assembled inputs of the scene.
            seed: seed of the noise.
            spp: samples per pixel of each image.

        Returns:
            The two images, which are not denoised, and their mean, which is. Each is
            (H, W, 3), or with a backdrop (H, W, 4), with coverage. With a crop they are
            full images, too.
        """
        hides_environment = "backdrop.color" in inputs
        scene_inputs = _select_scene_inputs(inputs)
        # a copy, whose renders are not counted here
        undenoised = self.copy_with(denoiser="none")
        noise_seeds = [seeds.derive_seed(seed, "traced", half) for half in range(2)]
        halves = [
            undenoised.render_radiance(scene_inputs, noise_seed, spp, hides_environment)
            for noise_seed in noise_seeds
        ]
        mean = (halves[0] + halves[1]) / 2.0
        # One render of the guides serves both halves; its seed follows from the first.
        denoise = self._make_denoiser(
            scene_inputs, noise_seeds[0], spp, hides_environment
        )
        return halves, self._denoise_in_window(mean, denoise)

    def _make_denoiser(
        self,
        scene_inputs: Mapping[str, Tensor],
        noise_seed: int,
        spp: int,
        hides_environment: bool,
    ) -> Callable[[Tensor], Tensor]:
        """Render a denoiser's guides, and return the function that denoises with them.

        Args:
            scene_inputs: inputs of Mitsuba's scene.
            noise_seed: seed of the images to be denoised, from which that of the guides
                is derived.
            spp: samples per pixel of the guides.
            hides_environment: whether the environment is hidden behind a backdrop.
        """
        guide_seed = seeds.derive_seed(self.root_seed, "guides", noise_seed)
        with self.scene.limit_window(self.window):
            albedo, normal = self.scene.render_guides(scene_inputs, guide_seed, spp)
        plane_radiance = self.scene.plane_radiance if hides_environment else None
        return partial(
            denoise_image, albedo=albedo, normal=normal, plane_radiance=plane_radiance
        )

    def _denoise_in_window(
        self, image: Tensor, denoise: Callable[[Tensor], Tensor]
    ) -> Tensor:
        """Denoise an image (H, W, C); with a crop only its window, which alone is noisy.

        The surroundings of the window were denoised when they were rendered.
        """
        if self.crop is None:
            return denoise(image)
        clean = denoise(self.crop.window.crop_image(image))
        return self.crop.window.paste(clean, self.crop.surrounding_image)

    def compute_scene_inputs(self, u: Tensor) -> dict[str, Tensor]:
        """Return the inputs of Mitsuba's scene at a configuration, without a graph."""
        inputs = self.scene.input_assembler(self.space.inputs(u))
        return {
            name: value.detach() for name, value in _select_scene_inputs(inputs).items()
        }

    def compute_object_mask(self, u: Configuration) -> Tensor:
        """Return the pixels in which the camera sees the object first, (H, W) bool.

        The ray through the center of each pixel counts. What controls do to the
        finished image moves nothing in it.
        """
        return self.find_surfaces(u).visible_mask(OBJECT)

    def find_surfaces(
        self, u: Configuration, subdivision: int = 1, camera: int = 0
    ) -> Surfaces:
        """Find what the camera sees first through the center of each pixel.

        Args:
            u: (d,) configuration.
            subdivision: divide each pixel into that many rows and columns.
            camera: index of the camera of a rig; 0 for a single camera.

        Returns:
            Ids and depths at (subdivision H, subdivision W) points; depths in metres.
        """
        u, _ = self._check_arguments(u, spp=1)
        with torch.no_grad():
            rig = self.scene.description_and_filter[0].rig
            mount = rig[camera] if rig else None
            inputs = self.replace_photograph_depth(self._make_camera_inputs(mount, u))
            surfaces = self.scene.find_surfaces(
                _select_scene_inputs(inputs), subdivision
            )
            if "backdrop.front" in inputs:
                _remove_hidden_surfaces(surfaces, inputs["backdrop.front"], subdivision)
        return self._convert_depths_to_metres(surfaces)

    def _convert_depths_to_metres(self, surfaces: Surfaces) -> Surfaces:
        """Return surfaces with depths in metres; those of the scene are in object sizes."""
        object_size = self.scene.description_and_filter[0].size_in_metres
        return replace(
            surfaces,
            depth=surfaces.depth * object_size,
            z_depth=surfaces.z_depth * object_size,
        )

    def gradient(
        self,
        loss: Callable[[Tensor], Tensor],
        u: Tensor,
        seed: int,
        spp: int,
        *,
        free: bool = False,
    ) -> tuple[Tensor, Tensor]:
        """Return a loss of the image of u, and its derivative by the plan.

        Coordinates with the estimator "secant" get differences of the loss. (With
        autograd through a call, they get differences of the image times the loss's
        derivative.)

        Args:
            loss: function from an image (H, W, 3) sRGB to a scalar.
            u: (d,) configuration in [0, 1].
            seed: seed of the noise.
            spp: samples per pixel.
            free: leave out all differences, since each costs renders: their coordinates
                then have a derivative of zero.

        Returns:
            The loss without graph, and (d,) float32.
        """
        # During the call below, `_select_difference_groups` leaves these out: "secant"
        # in any case, since its differences are written at the end.
        skipped = DIFFERENCE_ESTIMATORS if free else frozenset({"secant"})
        self._skipped_estimators = skipped
        try:
            value, derivative = self._differentiate_loss(loss, u, seed, spp)
        finally:
            self._skipped_estimators = frozenset()
        if not free:
            self._write_secant_differences(loss, u.detach(), seed, spp, derivative)
        return value, derivative

    def _differentiate_loss(
        self, loss: Callable[[Tensor], Tensor], u: Tensor, seed: int, spp: int
    ) -> tuple[Tensor, Tensor]:
        """Return a loss of the image of u without graph, and its derivative by autograd.

        Args:
            loss: function from an image (H, W, 3) sRGB to a scalar.
            u: (d,) configuration.
            seed: seed of the noise.
            spp: samples per pixel.
        """
        with torch.inference_mode(False), torch.enable_grad():
            leaf = u.detach().clone().requires_grad_()
            value = loss(self(leaf, seed, spp))
        gradient = None
        if value.requires_grad:
            (gradient,) = torch.autograd.grad(value, leaf, allow_unused=True)
        # A loss that does not depend on u has no graph, and no gradient.
        derivative = torch.zeros_like(leaf) if gradient is None else gradient
        return value.detach(), derivative

    @torch.no_grad()
    def _write_secant_differences(
        self,
        loss: Callable[[Tensor], Tensor],
        u: Tensor,
        seed: int,
        spp: int,
        derivative: Tensor,
    ) -> None:
        """Write differences of a loss into a derivative (d,), in place.

        Only the coordinates with the estimator "secant" are written.

        Args:
            loss: function from an image (H, W, 3) sRGB to a scalar.
            u: (d,) configuration.
            seed: seed of the noise.
            spp: samples per pixel, unless the plan has its own number.
            derivative: (d,) tensor that is changed.
        """
        noise_seed = seeds.derive_seed(self.root_seed, "differences", seed)
        difference_spp = self.plan.spp or spp

        def compute_loss(configuration: Tensor) -> Tensor:
            image = self._render_image(configuration, noise_seed, difference_spp)
            return loss(image)

        for group in self.plan.select_groups("secant"):
            write_central_differences(compute_loss, group, u, derivative)

    # ---- from u to the image

    def _check_arguments(self, u: Configuration, spp: int) -> tuple[Tensor, Tensor]:
        """Check a call's arguments.

        Raises InputError: u has another shape or values outside [0, 1], spp is out of
        range, or u was made in inference mode and requires a gradient.

        Returns:
            The configuration as float32, and a tensor with the same numbers that is
            rendered. Through it, autograd differentiates only the coordinates that the
            plan does not assign to differences. If it does so for all coordinates, or
            needs no derivatives, both are the same object.
        """
        u = _to_tensor(u)
        self._check_shape(u)
        if not 1 <= spp <= MAX_SPP:
            raise InputError(f"spp: expected 1 to {MAX_SPP} samples a pixel, got {spp}")
        _check_in_unit_box(u)
        _check_can_have_gradient(u)
        with _leave_inference_mode():
            u = u.clone() if u.is_inference() else u
            return u, self._limit_autograd(u)

    def _check_shape(self, u: Tensor) -> None:
        """Check that a configuration has the shape (d,) of the start.

        Raises:
            InputError: it has another one.
        """
        if u.shape != self._shape:
            raise InputError(
                f"render: expected u of shape {tuple(self._shape)}, got "
                f"{tuple(u.shape)}"
            )

    def _limit_autograd(self, u: Tensor) -> Tensor:
        """Return a configuration that autograd differentiates only as the plan states.

        It is u itself if autograd differentiates all coordinates, or none is needed.
        """
        # A prediction is differentiated by autograd for all coordinates.
        if self._predict is not None or not u.requires_grad:
            return u
        is_by_autograd = self.plan.autograd_mask
        if bool(is_by_autograd.all()):
            return u
        # The difference is 0, so that the value is u; the derivative is the mask.
        return u.detach() + is_by_autograd * (u - u.detach())

    def _render_image(
        self, u: Tensor, seed: int, spp: int, *, display: bool = True
    ) -> Tensor:
        """Render the image of a configuration, or its radiance before display.

        Args:
            u: (d,) configuration.
            seed: seed of the noise.
            spp: samples per pixel.
            display: if False, return the radiance that is to be displayed.

        Returns:
            (H, W, 3); for a rig of K cameras their images side by side, (H, K W, 3).
        """
        renders_before = self.n_renders
        # without a rig there is one camera, with no mount
        rig = self.scene.description_and_filter[0].rig
        mounts: Sequence[RigCamera | None] = rig or (None,)
        images = list[Tensor]()
        for index, mount in enumerate(mounts):
            camera_seed = _derive_camera_seed(seed, index)
            images.append(self._render_camera(mount, u, camera_seed, spp, display))
        if len(images) == 1:
            return images[0]
        # Budgets count configurations: all cameras of a rig are one render.
        self.n_renders = renders_before + 1
        return torch.cat(images, dim=1)

    def _render_camera(
        self, mount: RigCamera | None, u: Tensor, seed: int, spp: int, display: bool
    ) -> Tensor:
        """Render the image (H, W, 3) of one camera, or its radiance before display.

        Args:
            mount: a camera of a rig; None if the scene has one camera.
            u: (d,) configuration.
            seed: seed of the noise.
            spp: samples per pixel.
            display: if False, return the radiance that is to be displayed.
        """
        inputs = self._make_camera_inputs(mount, u)
        hides_environment = "backdrop.color" in inputs
        if self.moments:  # an exposure of some time
            rendered = self._render_exposure(mount, u, seed, spp, hides_environment)
        else:
            rendered = self.render_radiance(
                _select_scene_inputs(inputs), seed, spp, hides_environment
            )
        return self.finish_image(rendered, inputs, u, display=display)

    def _make_camera_inputs(
        self, mount: RigCamera | None, u: Tensor, space: InputMapping | None = None
    ) -> dict[str, Tensor]:
        """Return the scene inputs of a configuration for one camera.

        Args:
            mount: a camera of a rig; None if the scene has one camera.
            u: (d,) configuration.
            space: mapping of u to scene inputs at the time of the image. None is the
                renderer's space, with the delay of this camera.
        """
        if space is None:
            space = self.space
            if mount is not None and mount.delay:
                # The camera takes its image later than the first one: until then, what
                # moves has moved on.
                space = self.space.advance_time(mount.delay)
        inputs = self.scene.input_assembler(space.inputs(u))
        if mount is None:
            return inputs
        description = self.scene.description_and_filter[0]
        # The rig is mounted where the camera of the description stands.
        pose, center = _get_camera_pose_and_center(description)
        return mount.make_inputs(inputs, pose, center, description.size_in_metres)

    def _render_exposure(
        self,
        mount: RigCamera | None,
        u: Tensor,
        seed: int,
        spp: int,
        hide_environment: bool,
    ) -> Tensor:
        """Render the mean radiance of the moments of u, denoised once.

        All moments together count as one render.

        Args:
            mount: the camera of a rig; None if the scene has one camera.
            u: (d,) configuration.
            seed: seed of the noise; each moment gets its own.
            spp: samples per pixel of all moments together.
            hide_environment: hide the environment behind a backdrop.
        """
        renders_before = self.n_renders
        renders = self._make_moment_renders(mount, u, seed, spp)
        exposed, guides = self._sum_moments(renders, hide_environment)
        # `render_radiance` has counted each moment.
        self.n_renders = renders_before + 1
        if self.formation.denoiser != "oidn":
            return exposed
        # Denoising is added as a change without a graph: so the derivative is that of
        # the image before denoising.
        return exposed + self._compute_denoising_change(exposed, guides)

    def _make_moment_renders(
        self, mount: RigCamera | None, u: Tensor, seed: int, spp: int
    ) -> Iterator[_MomentRender]:
        """Yield what is to be rendered of each moment of an exposure.

        The arguments are those of `_render_exposure`.
        """
        for index, moment in enumerate(self.moments):
            inputs = self._make_camera_inputs(mount, u, moment.input_mapping)
            yield _MomentRender(
                inputs=_select_scene_inputs(inputs),
                seed=seeds.derive_seed(seed, "moment", index),
                spp=max(1, math.ceil(spp * moment.sample_fraction)),
                row_weights=moment.row_fractions[:, None, None],
            )

    def _sum_moments(
        self, renders: Iterable[_MomentRender], hide_environment: bool
    ) -> tuple[Tensor, Tensor]:
        """Render the moments of an exposure, and sum their images by the rows' weights.

        Args:
            renders: what is rendered of each moment.
            hide_environment: hide the environment behind a backdrop.

        Returns:
            Radiance (H, W, C), which is not denoised, and the denoiser's guides (H, W,
            6); the guides are 0 without a denoiser.
        """
        # sums over moments, which the first addition makes images
        exposed = torch.zeros(())
        guides = torch.zeros(())
        for render in renders:
            radiance = self.render_radiance(
                render.inputs, render.seed, render.spp, hide_environment, denoised=False
            )
            exposed = exposed + render.row_weights * radiance
            if self.formation.denoiser == "oidn":
                with torch.no_grad():
                    guides = guides + render.row_weights * self._render_guides(render)
        return exposed, guides

    def _render_guides(self, render: _MomentRender) -> Tensor:
        """Render the guides of the denoiser (H, W, 6), albedo and normals, of a moment."""
        guide_seed = seeds.derive_seed(self.root_seed, "guides", render.seed)
        albedo, normal = self.scene.render_guides(render.inputs, guide_seed, render.spp)
        return torch.cat([albedo, normal], dim=-1)

    @torch.no_grad()
    def _compute_denoising_change(self, exposed: Tensor, guides: Tensor) -> Tensor:
        """Return the denoised image minus the image, (H, W, C).

        Args:
            exposed: (H, W, C), with the channels of `render_radiance`.
            guides: (H, W, 6) albedo and normals.
        """
        has_plane = exposed.shape[-1] > 4
        clean = denoise_image(
            exposed,
            guides[..., :3].contiguous(),
            guides[..., 3:].contiguous(),
            self.scene.plane_radiance if has_plane else None,
            quick=self.formation.quick,
        )
        return clean - exposed

    def finish_image(
        self,
        rendered: Tensor,
        inputs: Mapping[str, Tensor],
        u: Tensor,
        *,
        display: bool = True,
    ) -> Tensor:
        """Return the image of rendered radiance.

        Args:
            rendered: radiance (H, W, 3), or (H, W, 4) with coverage, or (H, W, 7 or 13)
                with the changes of the plane that receives the shadow.
            inputs: scene inputs, of which exposure and backdrop are applied.
            u: configuration, for the controls that change the finished image.
            display: if False, return the radiance before the tone curve.
        """
        inputs = self.replace_photograph_depth(inputs)
        if "backdrop.blur" in inputs:
            rendered = blur_image(rendered, float(inputs["backdrop.blur"]))
        radiance = self._compose_radiance(rendered, inputs)
        if not display:
            return radiance
        image = self.formation.map_to_display(radiance)
        if "backdrop.noise" in inputs:
            coverage = rendered[..., 3:4].detach()
            image = _add_photograph_noise(image, coverage, inputs)
        return self.space.apply_to_image(u, image)

    def _compose_radiance(
        self, rendered: Tensor, inputs: Mapping[str, Tensor]
    ) -> Tensor:
        """Return rendered radiance (H, W, 3) with exposure, laid over a backdrop.

        Args:
            rendered: radiance with further channels, as for `finish_image`.
            inputs: scene inputs, of which exposure and backdrop are applied.
        """
        exposure = inputs.get("camera.exposure")
        radiance = rendered[..., :3]
        coat = rendered[..., 7:]  # without channels if the plane is matt
        if exposure is not None:
            radiance = radiance * torch.exp2(exposure)
            coat = coat * torch.exp2(exposure)
        if "backdrop.color" not in inputs:
            return radiance
        # The photograph is display-linear, which is radiance times the gain, and
        # has no exposure of ours. Nor has the change of the plane (channels 4 to
        # 6), which is used relative to the plane's radiance.
        behind = inputs["backdrop.color"] / self.formation.gain
        coverage_and_plane = rendered[..., 3:7]
        layers = torch.cat([radiance, coverage_and_plane, coat], dim=-1)
        return compose_over_photograph(layers, behind, inputs)

    @torch.no_grad()
    def replace_photograph_depth(
        self, inputs: Mapping[str, Tensor]
    ) -> Mapping[str, Tensor]:
        """Return inputs in which a photograph's depth is replaced by what it hides.

        ``backdrop.front`` (H, W, 2), the hidden fractions of object and ground, takes
        the place of ``backdrop.depth``. Inputs without depth are returned as they are.
        Like coverage, the fractions have no derivative.
        """
        if "backdrop.depth" not in inputs:
            return inputs
        front_inputs = dict(inputs)
        depth = front_inputs.pop("backdrop.depth")
        front_inputs["backdrop.front"] = self._find_hidden_fractions(inputs, depth)
        return front_inputs

    def _find_hidden_fractions(
        self, inputs: Mapping[str, Tensor], depth: Tensor
    ) -> Tensor:
        """Return the fractions (H, W, 2) of object and ground that a photograph hides.

        Args:
            inputs: inputs of the scene, and the blur of the backdrop if it has one.
            depth: (n H, n W) depth of the photograph, at n x n points in each pixel.
        """
        image_height, _image_width = self.formation.resolution
        n_points = depth.shape[0] // image_height
        surfaces = self.scene.find_surfaces(_select_scene_inputs(inputs), n_points)
        blur = float(inputs["backdrop.blur"]) if "backdrop.blur" in inputs else 0.0
        # A blur reaches about three standard deviations; 1 is for the pixel itself.
        radius = 1 + math.ceil(3.0 * blur)
        return compute_front(surfaces, depth, n_points, radius)

    def render_radiance(
        self,
        inputs: Mapping[str, Tensor],
        seed: int,
        spp: int,
        hide_environment: bool,
        *,
        denoised: bool = True,
    ) -> Tensor:
        """Return the linear radiance of scene inputs, differentiable in them.

        If paths are traced, `n_renders` goes up by 1; a prediction is not counted.

        Args:
            inputs: inputs of the scene.
            seed: seed of the noise.
            spp: samples per pixel.
            hide_environment: hide the environment behind a backdrop.
            denoised: denoise it if the formation requires it.

        Returns:
            (H, W, C). C is 3, or 4 with coverage if the environment is hidden. It is 7
            with the change of the radiance of a plane that receives the shadow in a
            photograph. It is 13 if that plane has a coat, with the change of what the
            coat reflects, and the environment in it.
        """
        if self._predict is not None:
            return self._predict(inputs)
        radiance: Tensor = _Radiance.apply(  # type: ignore[no-untyped-call]
            self, tuple(inputs), seed, spp, hide_environment, denoised, *inputs.values()
        )
        if self.crop is not None:
            return self.crop.window.paste(radiance, self.crop.surrounding_image)
        return radiance

    def replace_non_finite(self, values: Tensor) -> Tensor:
        """Replace NaN and infinite entries by zero and count them."""
        if bool(torch.isfinite(values.sum())):
            return values
        finite = torch.isfinite(values)
        self.n_non_finite += int((~finite).sum())
        return torch.where(finite, values, torch.zeros_like(values))

    # ---- differences

    def _select_difference_groups(self) -> tuple[Group, ...]:
        """Return the groups that are differentiated by differences."""
        estimators = DIFFERENCE_ESTIMATORS - self._skipped_estimators
        return self.plan.select_groups(*estimators)

    def compute_differences(
        self, u: Tensor, cotangent: Tensor, seed: int, spp: int
    ) -> Tensor:
        """Return the gradient of `sum(cotangent * image)` by differences.

        It is zero for coordinates with another estimator. All renders share one seed,
        so that their noise cancels in the differences (common random numbers). The
        image is the finished one, after the tone curve and the controls that change it.

        Args:
            u: (d,) configuration.
            cotangent: (H, W, 3) derivative of a loss by the image.
            seed: seed of the noise.
            spp: samples per pixel, unless the plan has its own number.
        """
        noise_seed = seeds.derive_seed(self.root_seed, "differences", seed)
        spp = self.plan.spp or spp
        derivative = torch.zeros_like(u)

        def compute_product(configuration: Tensor) -> Tensor:
            return (
                cotangent * self._render_image(configuration, noise_seed, spp)
            ).sum()

        for group in self._select_difference_groups():
            # writes the entries of the group into `derivative`
            write_central_differences(compute_product, group, u, derivative)
        return self.replace_non_finite(derivative)

    # ---- set-up

    def _compute_steps(
        self, groups: tuple[Group, ...], motion: Motion | None
    ) -> Tensor:
        """Return half-widths (d,) of differences over which outlines move by a pixel.

        A group counts as not moving if it moves no outline, if it has more than
        `MAX_MEASURED_SIZE` coordinates, or if there is no `motion` to measure it. Then
        it has a default step: `TURN_STEP` if it is periodic, as an angle over a full
        turn, and else `DEFAULT_STEP`, which `compute_steps` uses for a speed of 0.
        """
        speeds = self._measure_outline_speeds(groups, motion)
        steps = compute_steps(speeds)
        for group in groups:
            if group.periodic and not bool(speeds[group.coordinates].any()):
                steps[group.coordinates] = TURN_STEP
        return steps

    def _measure_outline_speeds(
        self, groups: tuple[Group, ...], motion: Motion | None
    ) -> Tensor:
        """Return the speeds (d,) of outlines in pixels per unit of each coordinate.

        They are 0 where they are not measured, see `_list_measured_coordinates`.
        """
        coordinates = _list_measured_coordinates(groups)
        if motion is None or not coordinates:
            return torch.zeros(len(self.start))
        return motion.measure_speeds(
            lambda u: self.scene.input_assembler(self.space.inputs(u)),
            self.start,
            coordinates,
        )

    def _find_reached_inputs(
        self, groups: tuple[Group, ...]
    ) -> dict[str, frozenset[str]]:
        """Find the scene inputs that each group of coordinates reaches.

        A group reaches an input if the input's derivative by one of the group's
        coordinates is not zero, by autograd at one point. The result is needed only for
        adjoints; it is empty if they are valid for no group.

        Returns:
            Names of scene inputs, by the group's name.
        """
        if not any(set(group.valid) & ADJOINT_ESTIMATORS for group in groups):
            return {}
        generator = torch.Generator().manual_seed(0)
        u = self._sample_generic_configuration(generator).requires_grad_()
        reaching_groups = dict[str, list[str]]()  # names, by that of the scene input
        with torch.enable_grad():
            inputs = self.scene.input_assembler(self.space.inputs(u))
            for name, tensor in inputs.items():
                if tensor.requires_grad:
                    gradient = _differentiate_input_sum(tensor, u, generator)
                    if gradient is not None:
                        reaching_groups[name] = _list_reaching_groups(groups, gradient)
        return {
            group.name: _find_inputs_of(group.name, reaching_groups) for group in groups
        }

    def _sample_generic_configuration(self, generator: torch.Generator) -> Tensor:
        """Sample a configuration (d,) half way from the start to the center of the box.

        It has some noise, since at borders and special values a derivative may be zero
        by chance.
        """
        noise = torch.rand(self.start.shape, generator=generator)
        configuration: Tensor = 0.5 * self.start + 0.25 + 0.1 * (noise - 0.5)
        return configuration


def _list_reaching_groups(groups: Sequence[Group], gradient: Tensor) -> list[str]:
    """Return the names of the groups that reach a scene input.

    Args:
        groups: groups of coordinates.
        gradient: derivative (d,) of the input by all coordinates.
    """
    return [group.name for group in groups if gradient[group.coordinates].any()]


def _find_inputs_of(
    group_name: str, reaching_groups: Mapping[str, Sequence[str]]
) -> frozenset[str]:
    """Return the scene inputs that a group of coordinates reaches.

    Args:
        group_name: name of the group.
        reaching_groups: names of the groups that reach an input, by the input's name.
    """
    return frozenset(
        name
        for name, group_names in reaching_groups.items()
        if group_name in group_names
    )


def _derive_camera_seed(seed: int, index: int) -> int:
    """Return the seed of the noise of one camera of a rig.

    The first camera has the noise of a scene without a rig.
    """
    return seed if index == 0 else seeds.derive_seed(seed, "camera", index)


@cache_per_scene
def _get_camera_pose_and_center(description: SceneDescription) -> tuple[Tensor, Tensor]:
    """Return the camera's pose (4, 4) and the object's center (3,) in a scene.

    They are those of the scene itself, before a configuration moves anything. They are
    cached, since the center is computed from all vertices.
    """
    pose = camera_to_world(description)
    center = compute_center(description)
    return torch.from_numpy(pose).float(), torch.from_numpy(center).float()


def _check_in_unit_box(u: Tensor) -> None:
    """Check that all numbers of a configuration are in [0, 1].

    Raises:
        InputError: one is not, or is NaN.
    """
    # An empty configuration has no smallest number. NaN fails both comparisons.
    is_in_range = True
    if u.numel():
        smallest, largest = torch.aminmax(u.detach())
        is_in_range = bool((smallest >= 0.0) & (largest <= 1.0))
    if not is_in_range:
        raise InputError(
            "render: expected every entry of u in [0, 1]; project u "
            "before you render it"
        )


def _check_can_have_gradient(u: Tensor) -> None:
    """Check that a configuration that requires a gradient can have one.

    Raises:
        InputError: it was made in torch's inference mode.
    """
    if u.is_inference() and u.requires_grad:
        raise InputError(
            "render: u was made in `torch.inference_mode()`, so that nothing can "
            "be differentiated with respect to "
            "it; make it outside, or pass `u.detach()` for the picture alone"
        )


def _list_measured_coordinates(groups: Sequence[Group]) -> list[int]:
    """Return the coordinates whose motion of outlines is measured.

    Groups of more than `MAX_MEASURED_SIZE` coordinates are left out.
    """
    coordinates: list[int] = []
    for group in groups:
        # "adjoint" and "image" are valid only for groups that move no outline, so
        # that any other valid estimator is a sign of motion.
        may_move = {*group.valid} - {"adjoint", "image"}
        if may_move and group.size <= MAX_MEASURED_SIZE:
            coordinates += range(group.begin, group.begin + group.size)
    return coordinates


def _differentiate_input_sum(
    tensor: Tensor, u: Tensor, generator: torch.Generator
) -> Tensor | None:
    """Return the derivative (d,) of a weighted sum of a tensor by u; None without one.

    The random weights keep the derivatives of the entries from cancelling in the sum.

    Args:
        tensor: tensor with a graph.
        u: (d,) configuration.
        generator: samples the weights.
    """
    weights = torch.rand(tensor.shape, generator=generator)
    gradient: Tensor | None = torch.autograd.grad(
        (tensor * weights).sum(), u, retain_graph=True, allow_unused=True
    )[0]
    return gradient


def _remove_hidden_surfaces(
    surfaces: Surfaces, front: Tensor, subdivision: int
) -> None:
    """Set the ids of surfaces behind something of a photograph to 0, in place.

    Where something in front hides most of a pixel, no surface of the scene is visible.

    Args:
        surfaces: surfaces at (subdivision H, subdivision W) points.
        front: (H, W, 2) hidden fractions of the object and of the ground.
        subdivision: number of rows and columns of points in a pixel.
    """
    is_hidden = front[..., 0] > 0.5
    for dim in (0, 1):  # a pixel's value for all of its points
        is_hidden = is_hidden.repeat_interleave(subdivision, dim)
    surfaces.id[is_hidden] = 0  # no surface; depths stay


def _add_photograph_noise(
    image: Tensor, coverage: Tensor, inputs: Mapping[str, Tensor]
) -> Tensor:
    """Add noise to an image where the object is visible.

    The photograph around it has its own noise.

    Args:
        image: (H, W, 3) sRGB.
        coverage: (H, W, 1) of the scene's surfaces.
        inputs: scene inputs with the noise.
    """
    if "backdrop.front" in inputs:
        coverage = coverage * (1.0 - inputs["backdrop.front"][..., :1])
    return (image + coverage * inputs["backdrop.noise"]).clamp(0.0, 1.0)


def _select_scene_inputs(inputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the inputs that belong to Mitsuba's scene, not to the finished image."""
    return {name: value for name, value in inputs.items() if name not in IMAGE_INPUTS}


def _leave_inference_mode() -> AbstractContextManager[object]:
    """Return a context that leaves torch's inference mode.

    Outside of inference mode it does nothing, since entering a context takes time.
    """
    if torch.is_inference_mode_enabled():
        return torch.inference_mode(False)
    return nullcontext()


def _to_tensor(u: Configuration) -> Tensor:
    """Convert a configuration to a float32 tensor."""
    try:
        return torch.as_tensor(u, dtype=torch.float32)
    except (TypeError, ValueError, RuntimeError):
        raise InputError(
            "render: expected u as a tensor or an array of numbers, got "
            f"{type(u).__name__}"
        ) from None


class _Radiance(torch.autograd.Function):
    """Mitsuba as one torch operation, whose backward pass renders the adjoint."""

    @staticmethod
    def forward(
        ctx: Any,
        renderer: Renderer,
        names: tuple[str, ...],
        seed: int,
        spp: int,
        hide: bool,
        denoised: bool,
        *tensors: Tensor,
    ) -> Tensor:
        """Render the radiance of scene inputs; it counts as one render.

        NaN and infinite values become zero.

        Args:
            ctx: autograd's context, which stores what `backward` needs.
            renderer: renderer of the scene.
            names: names of the inputs, in the order of `tensors`.
            seed: seed of the noise.
            spp: samples per pixel.
            hide: hide the environment behind a backdrop.
            denoised: denoise the result if the formation requires it.
            *tensors: values of the inputs.

        Returns:
            (h, w, C) radiance, of the window of the renderer's crop if it has one.
        """
        ctx.renderer = renderer
        ctx.names = names
        ctx.seed = seed
        ctx.spp = spp
        ctx.hide = hide
        ctx.window = renderer.window
        ctx.save_for_backward(*tensors)
        inputs = dict(zip(names, tensors, strict=True))
        needs_guides = denoised and renderer.formation.denoiser == "oidn"
        image_seeds = _derive_image_seeds(renderer.root_seed, seed, hide, needs_guides)
        # in the order of `image_seeds`
        images = _render_seeded_images(renderer, inputs, image_seeds, spp)
        rendered = renderer.replace_non_finite(images[0])
        if len(images) > 1:
            rendered = _denoise_with_guides(renderer, rendered, images[1], hide)
        renderer.n_renders += 1
        return rendered

    @staticmethod
    @forbid_second_derivatives
    def backward(ctx: Any, cotangent: Tensor) -> tuple[Tensor | None, ...]:
        """Return the gradient of `sum(cotangent * radiance)` by an adjoint.

        Only inputs that a coordinate with an adjoint estimator reaches get a gradient;
        that of all others is None. The denoiser is taken for the identity.
        """
        renderer: Renderer = ctx.renderer
        inputs = dict(zip(ctx.names, ctx.saved_tensors, strict=True))
        noise_seed = seeds.derive_seed(renderer.root_seed, "gradient", ctx.seed)
        cotangent = renderer.replace_non_finite(cotangent)
        gradient_of_input = _render_input_gradients(ctx, inputs, cotangent, noise_seed)
        for name, gradient in gradient_of_input.items():
            gradient_of_input[name] = renderer.replace_non_finite(gradient)
        # The six arguments of `forward` between `ctx` and the tensors have no
        # gradients.
        no_gradients = (None,) * 6
        return (*no_gradients, *map(gradient_of_input.get, ctx.names))


def _derive_image_seeds(
    root_seed: int, seed: int, hide: bool, needs_guides: bool
) -> dict[str, int]:
    """Return the seeds of the images that a render takes, by kind; radiance first.

    Args:
        root_seed: the renderer's seed.
        seed: seed of the noise of this render.
        hide: hide the environment behind a backdrop.
        needs_guides: render the denoiser's guides, too.
    """
    noise_seed = seeds.derive_seed(root_seed, "primal", seed)
    image_seeds = {"hidden" if hide else "path": noise_seed}
    if needs_guides:
        image_seeds["guides"] = seeds.derive_seed(root_seed, "guides", seed)
    return image_seeds


def _render_seeded_images(
    renderer: Renderer,
    inputs: Mapping[str, Tensor],
    image_seeds: Mapping[str, int],
    spp: int,
) -> list[Tensor]:
    """Render images of a scene, in the window of the renderer's crop if it has one.

    Another program renders only the radiance, which is the first image, and denoises it
    itself.

    Args:
        renderer: renderer of the scene.
        inputs: inputs of the scene.
        image_seeds: seed of each image by its kind, such as "path"; radiance first.
        spp: samples per pixel.
    """
    if renderer._external_render is not None:
        radiance_seed, *_ = image_seeds.values()
        return [renderer._external_render(inputs, radiance_seed, spp)]
    scene: MitsubaScene | SharedPaths = renderer.scene
    # Shared paths are stored for full images only.
    if renderer.shared_paths is not None and renderer.window is None:
        scene = renderer.shared_paths
    with renderer.scene.limit_window(renderer.window):
        return scene.render_images(inputs, image_seeds, spp)


def _denoise_with_guides(
    renderer: Renderer, rendered: Tensor, guides: Tensor, hide: bool
) -> Tensor:
    """Return denoised radiance.

    Args:
        renderer: renderer of the scene.
        rendered: (h, w, C) radiance.
        guides: (h, w, 6) albedo and normals.
        hide: whether the environment is hidden behind a backdrop.
    """
    return denoise_image(
        rendered,
        albedo=guides[..., :3],
        normal=guides[..., 3:],
        plane_radiance=renderer.scene.plane_radiance if hide else None,
        quick=renderer.formation.quick,
    )


def _render_input_gradients(
    ctx: Any, inputs: dict[str, Tensor], cotangent: Tensor, noise_seed: int
) -> dict[str, Tensor]:
    """Return the gradients of the inputs that coordinates with an adjoint reach.

    Each of the two adjoints is rendered only if an input needs it. The arguments are
    those of `_render_material_gradients`.
    """
    # The material form is right for more inputs. So it differentiates those that are
    # reached by groups of both estimators.
    by_material = _select_reached_inputs(ctx.renderer, "material")
    by_interior = _select_reached_inputs(ctx.renderer, "adjoint") - by_material
    material_names = [name for name in inputs if name in by_material]
    interior_names = [name for name in inputs if name in by_interior]
    gradient_of_input = dict[str, Tensor]()
    if material_names:
        gradient_of_input |= _render_material_gradients(
            ctx, inputs, cotangent, noise_seed, material_names
        )
    if interior_names:
        gradient_of_input |= _render_interior_gradients(
            ctx, inputs, cotangent, noise_seed, interior_names
        )
    return gradient_of_input


def _render_material_gradients(
    ctx: Any,
    inputs: dict[str, Tensor],
    cotangent: Tensor,
    noise_seed: int,
    names: Sequence[str],
) -> dict[str, Tensor]:
    """Return the gradients of inputs of meshes by the material form; one adjoint render.

    The result has the vertices and the normals of each mesh, and both are used.

    Args:
        ctx: autograd's context of `_Radiance`.
        inputs: inputs of the scene.
        cotangent: (h, w, C) derivative of a loss by the radiance.
        noise_seed: seed of the noise.
        names: names of the inputs.
    """
    renderer: Renderer = ctx.renderer
    meshes = sorted({name.rpartition(".")[0] for name in names})
    # Only the radiance is differentiated, not further channels.
    gradient_of_input = renderer.scene.render_material_adjoint(
        inputs, cotangent[..., :3], noise_seed, ctx.spp, meshes=meshes
    )
    renderer.n_gradients += 1
    return gradient_of_input


def _render_interior_gradients(
    ctx: Any,
    inputs: dict[str, Tensor],
    cotangent: Tensor,
    noise_seed: int,
    names: Sequence[str],
) -> dict[str, Tensor]:
    """Return the gradients of inputs by the interior adjoint; one adjoint render.

    The arguments are those of `_render_material_gradients`.
    """
    renderer: Renderer = ctx.renderer
    method = "hidden" if ctx.hide else "path"
    with renderer.scene.limit_window(ctx.window):
        gradient_of_input = renderer.scene.render_adjoint(
            inputs, cotangent, noise_seed, ctx.spp, wrt=names, method=method
        )
    renderer.n_gradients += 1
    return gradient_of_input


def _select_reached_inputs(renderer: Renderer, estimator: str) -> frozenset[str]:
    """Return the scene inputs that coordinates with an estimator reach.

    For the estimator "adjoint", the interior adjoint, only the inputs that it
    differentiates correctly are returned.
    """
    reached: frozenset[str] = frozenset()
    for group in renderer.plan.select_groups(estimator):
        reached |= renderer.inputs_by_group.get(group.name, frozenset())
    if estimator == "adjoint":
        return reached & renderer.scene.interior_inputs
    return reached


class _Differences(torch.autograd.Function):
    """The identity on an image, with a derivative by differences.

    In the forward pass the image passes through. In the backward pass, the
    configuration u gets the derivative of the coordinates that the plan assigns to
    differences. It is added to the derivative that autograd computes through the image.
    """

    @staticmethod
    def forward(
        ctx: Any, renderer: Renderer, seed: int, spp: int, u: Tensor, image: Tensor
    ) -> Tensor:
        """Return the image as it is, and store what the backward pass needs."""
        ctx.renderer = renderer
        ctx.seed = seed
        ctx.spp = spp
        ctx.save_for_backward(u)
        # A view, since an output that is the input itself needs care in autograd.
        return image.view_as(image)

    @staticmethod
    @forbid_second_derivatives
    def backward(ctx: Any, cotangent: Tensor) -> tuple[Tensor | None, ...]:
        """Return the derivative of u by differences, and the image's unchanged."""
        (u,) = ctx.saved_tensors
        derivative = ctx.renderer.compute_differences(u, cotangent, ctx.seed, ctx.spp)
        return None, None, None, derivative, cotangent
