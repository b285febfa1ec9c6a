"""A described scene inside Mitsuba, changed only through named inputs.

It is built once, rendered and differentiated. Inputs are torch tensors with our own
names (`object.base_color`), so that nothing outside this package knows Mitsuba's
parameter paths. Every call states all inputs that it changes; all others have their
base values, so that no configuration is ever applied on top of another.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from advsearch.errors import InputError
from advsearch.interrupts import INTERRUPTS
from advsearch.scene.assembly import InputAssembler
from advsearch.scene.backdrop import compute_plane_radiance
from advsearch.scene.description import OBJECT, SceneDescription
from advsearch.scene.formation import (
    ALL_OMISSIONS,
    SAMPLER,
    Surfaces,
    round_sample_count,
)
from advsearch.scene.geometry import get_positioned_part
from advsearch.scene.grounds import is_enclosed
from advsearch.scene.mitsuba_backend import parts
from advsearch.scene.mitsuba_backend.meshes import (
    NORMALS,
    POSITIONS,
    compute_sampling_weights,
    has_textured_emission,
    to_repeating_uv,
)
from advsearch.scene.mitsuba_backend.transport import (
    TracedPaths,
    collect_paths,
    find_first_hits,
)
from advsearch.scene.mitsuba_backend.variant import (
    Plugin,
    Recordings,
    add_without_copies,
    dr,
    mi,
    mitsuba_lock,
    scene_registry,
)
from advsearch.scene.parts import BASE_COLOR as BASE_COLOR_TYPE
from advsearch.scene.parts import PATTERN_SUFFIX, Lamp, LampGlass, iterate_plugins
from advsearch.scene.window import Window

MAX_DEPTH = 6  # longest light path in segments: five bounces off surfaces
NO_ROULETTE_DEPTH = 1000
ROULETTE_DEPTH = 2
"""Bounces from which on Russian roulette may end a path of a primal render.

There is no roulette in open scenes, where paths soon leave the scene by themselves.
Among houses, 2 takes a fifth less time than 3, at a tenth less squared error times time
of denoised images (`benchmarks/avenue.py --roulette`). With 1 it is less still, but
then the denoiser loses more: the model's margin falls by .4 at 16 samples, and
verification needs more.
"""
GRADIENT_ROULETTE_DEPTH = 2
"""The same depth for an adjoint, which counts one bounce less. With 1, single gradients
were a fifth off.
"""
# samples per pixel of the shadow term; without it the gradient of an object on the
# ground has a cosine of 0.66 to the true one
SHADOW_SPP = 4
# input: (h, w, 3) linear reflectance of the object, row 0 at v = 1 (top of the image)
BASE_COLOR = "object.base_color"


class MitsubaScene:
    """Render one scene at one size.

    Attributes:
        max_depth: longest light path in segments, as the argument.
        current_max_depth: current longest light path; `limit_depth` makes it smaller
            for a time.
        input_assembler: function that turns the inputs of a space into those of this
            scene.
        description_and_filter: description of the scene, and name of the filter.
        input_names: names of all inputs that can be set.
        parameters: Mitsuba's parameters of the scene, from `mi.traverse`.
        plane_radiance: (3,) radiance, without the object, of the plane that receives
            the shadow in a photograph; None if there is no plane.
        integrator_name: Mitsuba's name of the path integrator of primal renders.
        roulette_depth: bounces from which on Russian roulette may end a path there.
        declared_inputs: for each input its key in `parameters`, and its definition.
        interior_inputs: inputs that the interior adjoint differentiates correctly.
        window: part of the image that is rendered; None for all of it.

    Args:
        description: the scene.
        resolution: (height, width) in pixels.
        filter: reconstruction filter, "box" or "gaussian".
        leave_out: names from `advsearch.scene.formation.OMISSIONS`: work that is not
            needed. The default is all of it; less is only for measuring what it saves.
        max_depth: longest light path in segments.
        sampler: Mitsuba's name of the sampler; some round sample counts up, see
            `round_sample_count`.
        integrator: Mitsuba's name of the path integrator of primal renders without
            media. None chooses `path` in scenes with roulette, and else `prb`.
    """

    def __init__(
        self,
        description: SceneDescription,
        resolution: tuple[int, int],
        *,
        filter: str = "box",
        leave_out: Collection[str] = ALL_OMISSIONS,
        max_depth: int = MAX_DEPTH,
        sampler: str = SAMPLER,
        integrator: str | None = None,
    ) -> None:
        """Load a description into Mitsuba, and find which inputs it has.

        Args:
            description: the scene.
            resolution: (height, width) in pixels.
            filter: reconstruction filter, "box" or "gaussian".
            leave_out: names of work that is left out; see the class.
            max_depth: longest light path in segments.
            sampler: Mitsuba's name of the sampler, such as "independent".
            integrator: Mitsuba's name of the path integrator; None chooses one.
        """
        with mitsuba_lock:
            # The import registers the plugins, which needs the variant.
            import advsearch.scene.mitsuba_backend.own_plugins  # noqa: F401

            # Free unused scenes before the new one is loaded: their objects have ids,
            # for which kernels are compiled, and which are used again then.
            if scene_registry.unused_keys:
                scene_registry.free_unused()
            self.description_and_filter = (description, filter)
            self.resolution = resolution
            self.sampler_name = sampler
            self.input_assembler = InputAssembler(description, resolution)
            self.max_depth = max_depth
            self.current_max_depth = max_depth
            self.window: Window | None = None
            self._leave_out = frozenset(leave_out)
            # Recordings save work that is called "tracing": if that is left out, they
            # are used.
            self._uses_recordings = "tracing" in leave_out and _can_be_recorded(
                description
            )
            self._set_integrator(integrator)
            self._examine_description(description)
            self._build_scene()
            self._store_base_values()

    def _examine_description(self, description: SceneDescription) -> None:
        """Set what depends on the description alone, before the scene is loaded."""
        self._pinhole = not description.thin_lens and description.camera_model is None
        self._backdrop = description.backdrop
        self.plane_radiance = compute_plane_radiance(description)
        _check_emission(description)
        self._guides = _make_guides_plugin(description)
        self.is_volumetric = any(part.volumetric for part in description.parts)
        # entries of every path integrator, which `_load_scene` fills in
        self._path_entries: Plugin = {}

    def _build_scene(self) -> None:
        """Load Mitsuba's scene, find its inputs, and register its objects."""
        inputs = self._load_scene()
        self._sensor = self._scene.sensors()[0]
        self.parameters = mi.traverse(self._scene)
        self._set_sampling_weights()
        self._integrators: dict[tuple[str, int], Any] = {}
        self._declare_inputs(inputs)
        self._recorded = Recordings()
        scene_registry.hold_objects(
            self,
            self._scene,
            self._integrators,
            self.parameters,
            media=self._find_media(),
        )

    def _store_base_values(self) -> None:
        """Set which values of inputs are written, at first and at each render.

        "uploads" is the work of setting inputs that do not change. If it is not left
        out, the base values of all inputs are set at each render.
        """
        # base values of inputs that were changed at least once
        self._base_values: dict[str, Any] = {}
        # values of inputs that do not have their base value now
        self._applied_values: dict[str, Tensor] = {}
        self._values_to_upload: dict[str, Tensor] = {}
        if "uploads" not in self._leave_out:
            self._values_to_upload = {
                name: self.get_base_value(name) for name in sorted(self.input_names)
            }

    def _set_sampling_weights(self) -> None:
        """Set how often each mesh that emits light is sampled as a light."""
        meshes = self.description_and_filter[0].meshes.values()
        for name, weight in compute_sampling_weights(meshes).items():
            self.parameters[f"{name}.emitter.sampling_weight"] = weight
        self.parameters.update()

    def _set_integrator(self, integrator: str | None) -> None:
        """Set the integrator of images, and the lengths from which paths may end early.

        Among walls light is reflected many times: there Russian roulette saves more
        time than its noise costs. `integrator` is Mitsuba's type; None takes "path"
        there, and "prb" elsewhere.
        """
        self.integrator_name = integrator or "prb"
        self.roulette_depth = NO_ROULETTE_DEPTH
        self._gradient_roulette_depth = NO_ROULETTE_DEPTH
        if is_enclosed(self.description_and_filter[0]):
            self.integrator_name = integrator or "path"
            self.roulette_depth = ROULETTE_DEPTH
            self._gradient_roulette_depth = GRADIENT_ROULETTE_DEPTH

    def _load_scene(self) -> list[parts.SceneInput]:
        """Load Mitsuba's scene, and return the inputs that it may have.

        This also extends `_path_entries`, which every path integrator of the scene
        needs.
        """
        description, filter_name = self.description_and_filter
        plugins = parts.make_scene_dict(
            description, self.resolution, filter_name, self.sampler_name
        )
        with parts.convert_refusals(description):
            translations = self._translate_parts(description)
            for translation in translations:
                plugins |= translation.plugins
                self._path_entries |= translation.integrator_entries
            if "emitters" in self._leave_out:
                _leave_out_dark_lamps(plugins, description)
            self._scene = mi.load_dict(plugins, optimize=False)
        inputs = list(parts.make_scene_inputs(self.resolution))
        for translation in translations:
            inputs += translation.inputs
        return inputs

    def _translate_parts(
        self, description: SceneDescription
    ) -> list[parts.TranslatedPart]:
        """Turn each part into Mitsuba's plugins, entries of integrators, and inputs."""
        # Lobes of the principled plugin that have no effect, but take time. They
        # are part of the plugin only if they are not left out.
        idle_lobes = None if "lobes" in self._leave_out else parts.IDLE_LOBES
        translations = [parts.translate_mesh(description.meshes[OBJECT], idle_lobes)]
        # each part becomes Mitsuba's plugins, entries of integrators, and inputs
        translations += [
            parts.translate_part(get_positioned_part(description, part))
            for part in description.parts
        ]
        return translations

    def _declare_inputs(self, inputs: Sequence[parts.SceneInput]) -> None:
        """Store the inputs that the scene really has, in `declared_inputs` and in sets.

        An input is left out if Mitsuba has no parameter for it.
        """
        self.declared_inputs = dict[str, tuple[str, parts.SceneInput]]()
        for scene_input in inputs:
            key = parts.find_key(self.parameters, scene_input)
            if key:  # empty if Mitsuba has no such parameter
                self.declared_inputs[scene_input.name] = (key, scene_input)
        self.input_names = frozenset(self.declared_inputs)
        self.interior_inputs = self._select_inputs(
            lambda _key, scene_input: scene_input.has_interior_adjoint
        )
        # Vertices and normals, which are written into the memory that they have.
        self._buffers = self._select_inputs(
            lambda key, _scene_input: key.endswith((POSITIONS, NORMALS))
        )
        # Numbers that Mitsuba compiles into its kernels, as constants.
        self._constants = self._select_inputs(
            lambda _key, scene_input: (
                scene_input.convert_to_mitsuba is parts.to_constant
            )
        )

    def _select_inputs(
        self, condition: Callable[[str, parts.SceneInput], bool]
    ) -> frozenset[str]:
        """Return the names of inputs whose key and definition meet a condition."""
        return frozenset(
            name
            for name, (key, scene_input) in self.declared_inputs.items()
            if condition(key, scene_input)
        )

    def _find_media(self) -> tuple[Any, ...]:
        """Return the media inside and outside of all shapes."""
        media = []
        for shape in self._scene.shapes() if self.is_volumetric else []:
            media += [shape.interior_medium(), shape.exterior_medium()]
        return tuple(medium for medium in media if medium is not None)

    def copy_with(self, **changes: Any) -> MitsubaScene:
        """Return another scene, made with the same arguments except for some changes.

        `changes` may have `max_depth`, `sampler`, `integrator` and `leave_out`. Without
        an integrator there, the other scene chooses one by itself.
        """
        description, filter_name = self.description_and_filter
        arguments = {
            "max_depth": self.max_depth,
            "leave_out": self._leave_out,
            "sampler": self.sampler_name,
            **changes,
        }
        other = MitsubaScene(
            description, self.resolution, filter=filter_name, **arguments
        )
        # An integrator is loaded on first use, which makes the recordings of all scenes
        # stale. So that happens now, and not later between renders.
        for method in ("path", "guides"):
            other._get_integrator(method)
        return other

    @contextmanager
    def limit_depth(self, depth: int | None) -> Iterator[None]:
        """Limit light paths to `depth` segments inside the `with`, if it is not None.

        `current_max_depth` is the limit that holds.
        """
        depth_before = self.current_max_depth
        if depth is not None:
            self.current_max_depth = min(depth, self.max_depth)
        try:
            yield
        finally:
            self.current_max_depth = depth_before

    @contextmanager
    def limit_window(self, window: Window | None) -> Iterator[None]:
        """Render a window of the image alone inside the `with`, if it is not None."""
        window_before = self.window
        self.window = window
        try:
            yield
        finally:
            self.window = window_before

    @property
    def window_size(self) -> tuple[int, int]:
        """Height and width of what is rendered, in pixels."""
        if self.window is None:
            return self.resolution
        return self.window.height, self.window.width

    @contextmanager
    def _crop_film(self) -> Iterator[None]:
        """Crop the camera's film to the window inside the `with`."""
        if self.window is None:
            yield
            return
        self._write_crop(self.window)
        try:
            yield
        finally:
            height, width = self.resolution
            self._write_crop(Window(top=0, left=0, height=height, width=width))

    def _write_crop(self, window: Window) -> None:
        """Set which window of the image the camera's film has."""
        film = "camera.film"
        size = mi.ScalarVector2u(window.width, window.height)
        self.parameters[f"{film}.crop_size"] = size
        offset = mi.ScalarPoint2u(window.left, window.top)
        self.parameters[f"{film}.crop_offset"] = offset
        self.parameters.update()

    def round_sample_count(self, samples: float, sampler: str | None = None) -> int:
        """Return how many samples the sampler takes when at least `samples` are needed.

        The scene's sampler is the default.
        """
        return round_sample_count(sampler or self.sampler_name, samples)

    def get_base_value(self, name: str) -> Tensor:
        """Return the base value of an input, as a fresh tensor of the input's shape.

        To read it, all inputs of the scene are reset to their base values.
        """
        key, scene_input = self.declared_inputs[name]
        self._set_inputs_exactly({})  # Mitsuba's parameter then has the base value
        value = parts.to_torch(self.parameters[key])
        if scene_input.shape is None:
            return value
        return value.reshape(scene_input.shape)

    def render_images(
        self, inputs: Mapping[str, Tensor], seeds: Mapping[str, int], spp: int
    ) -> list[Tensor]:
        """Render images of one configuration, each with independent samples.

        A render is recorded on first use and replayed later. Only primal ones are:
        Dr.Jit 1.5.0 corrupts memory when it replays some adjoints (a texture of 32 x 32
        under a film of 32 x 32 pixels, say), and the gain there is small.

        Args:
            inputs: inputs that differ from the base values.
            seeds: seed of each image, by its kind. "path" is the linear radiance;
                "hidden" is the same without the environment that the camera sees
                directly, for a backdrop; "guides" is the image of the denoiser's
                guides.
            spp: samples per pixel.

        Returns:
            For each of `seeds` a float32 image, of the window if there is one. Its
            shape is

            - (H, W, 3), the radiance;
            - (H, W, 4) with a backdrop: radiance, and coverage by surfaces;
            - (H, W, 7) with a plane that receives the shadow in a photograph: the last
              three are the change of the plane's radiance;
            - (H, W, 13) if that plane has a coat: then also the change of what the coat
              reflects, and the environment in the coat;
            - (H, W, 6) for "guides": the first hit's albedo in [0, 1], and its shading
              normal.
        """
        INTERRUPTS.raise_pending()  # stops here if the user has interrupted the run
        with mitsuba_lock, self._crop_film():
            self._set_inputs_exactly(inputs)
            if scene_registry.unused_keys:
                scene_registry.free_unused()
            spp = self.round_sample_count(spp)
            # All are loaded before the first render: to load one makes the recordings
            # stale.
            integrators = {method: self._get_integrator(method) for method in seeds}
            return [
                self._render_by_method(method, integrators[method], seed, spp)
                for method, seed in seeds.items()
            ]

    def _render_by_method(
        self, method: str, integrator: Any, seed: int, spp: int
    ) -> Tensor:
        """Render one image, see `render_images`; it is recorded if that saves time."""
        render = self._get_render_function(method, spp)
        # opaque: a literal seed would be a constant of the recorded kernel
        opaque_seed = dr.opaque(mi.UInt32, seed)
        drjit_image = render(self._scene, self._sensor, integrator, opaque_seed)
        image: Tensor = drjit_image.torch().clone()
        if method == "guides":
            # Albedo and normal are the last six channels. There may be a color
            # before them.
            image = image[..., -6:]
            image[..., :3].clamp_(0.0, 1.0)
        return image

    def _get_render_function(self, method: str, spp: int) -> Callable[..., Any]:
        """Return the function that renders images by a method, recorded or not."""
        render = _make_render_function(spp)
        if not self._uses_recordings:
            return render
        media = scene_registry.list_media() if self.is_volumetric else []
        key = (method, spp, self.current_max_depth, self.window)
        return self._recorded.get_or_record(key, render, media)

    @property
    def mitsuba_shapes(self) -> list[Any]:
        """Mitsuba's shapes."""
        return list(self._scene.shapes())

    def run_recorded(self, key: Any, function: Callable[..., Any], *args: Any) -> Any:
        """Return `function(scene, camera, *args)` of Mitsuba's objects.

        It is recorded at the first call with a key, and replayed later.
        """
        if self._uses_recordings:
            # Media are state that the recording reads.
            media = scene_registry.list_media() if self.is_volumetric else []
            function = self._recorded.get_or_record(key, function, media)
        return function(self._scene, self._sensor, *args)

    def render_radiance(
        self, inputs: Mapping[str, Tensor], seed: int, spp: int
    ) -> Tensor:
        """Render the linear radiance (H, W, 3 or more channels), see `render_images`.

        Args:
            inputs: what differs from the base values.
            seed: seed of the samples.
            spp: samples per pixel.
        """
        return self.render_images(inputs, {"path": seed}, spp)[0]

    def render_guides(
        self, inputs: Mapping[str, Tensor], seed: int, spp: int
    ) -> tuple[Tensor, Tensor]:
        """Render the guides of the denoiser.

        Args:
            inputs: what differs from the base values.
            seed: seed of the samples.
            spp: samples per pixel.

        Returns:
            First-hit albedo and shading normal, each (H, W, 3) float32.
        """
        guides = self.render_images(inputs, {"guides": seed}, spp)[0]
        return guides[..., :3], guides[..., 3:]

    def set_inputs(self, inputs: Mapping[str, Tensor]) -> Any:
        """Set inputs and return Mitsuba's scene, which has them until the next call."""
        with mitsuba_lock:
            self._set_inputs_exactly(inputs)
            return self._scene

    def set_geometry(self, inputs: Mapping[str, Tensor]) -> None:
        """Make sure that the scene has the vertices and normals of some inputs.

        If it has them already, nothing is set, not even the other inputs. Otherwise all
        of `inputs` are set.
        """
        # Buffers without an entry have their base values, in both dictionaries.
        requested = {name: inputs[name] for name in inputs if name in self._buffers}
        applied = {
            name: self._applied_values[name]
            for name in self._applied_values
            if name in self._buffers
        }
        is_set = requested.keys() == applied.keys() and all(
            torch.equal(requested[name].float(), applied[name]) for name in requested
        )
        if not is_set:
            self.set_inputs(inputs)

    def find_surfaces(
        self, inputs: Mapping[str, Tensor], subdivision: int = 1
    ) -> Surfaces:
        """Find the first surface that the camera sees through the center of each pixel.

        Lengths are in object sizes.

        Args:
            inputs: inputs that differ from the base values.
            subdivision: look-ups along each side of a pixel; the images of the result
                are larger by this factor.
        """
        with mitsuba_lock:
            self._set_inputs_exactly(inputs)
            height, width = self.resolution
            hits = find_first_hits(
                self._scene, self._sensor, (height * subdivision, width * subdivision)
            )
            self._map_glass_to_carriers(hits)
            return hits

    def _map_glass_to_carriers(self, hits: Surfaces) -> None:
        """Turn hits on the glass of lamps into hits on the meshes that carry it.

        The glass was cut out of its carrier. A hit on it counts as a hit on that face
        of the carrier.
        """
        for part in self.description_and_filter[0].parts:
            if isinstance(part, LampGlass):
                on_glass = hits.visible_mask(part.name)
                carrier_face = torch.from_numpy(part.face_of_carrier)
                hits.face_index[on_glass] = carrier_face[hits.face_index[on_glass]]
                # ids count from 1, and 0 is no surface
                hits.id[on_glass] = hits.shape_names.index(part.carrier) + 1

    def render_adjoint(
        self,
        inputs: Mapping[str, Tensor],
        cotangent: Tensor,
        seed: int,
        spp: int,
        *,
        wrt: Collection[str] | None = None,
        method: str = "path",
    ) -> dict[str, Tensor]:
        """Return the gradient of `sum(cotangent * radiance)` by some inputs.

        Args:
            inputs: what differs from the base values.
            cotangent: (H, W, 3) float32, or of as many channels as the image has; of
                the window if there is one.
            seed: should differ from the primal's, or the gradient of a noisy image is
                returned.
            spp: independent samples per pixel.
            wrt: the inputs whose gradients are returned; None means all of `inputs`.
            method: "path", the interior adjoint (path replay backpropagation, Vicini et
                al. 2021), unbiased for inputs that do not move silhouettes; "hidden",
                the same without the visible environment. If boundary terms are not left
                out, Mitsuba's projective integrator (Zhang et al. 2023) takes the place
                of "path".

        Returns:
            For each of `wrt` a float32 tensor of the input's shape.
        """
        with mitsuba_lock:
            requested = tuple(inputs if wrt is None else wrt)
            method, extra = self._choose_adjoint(method)
            image_gradient = self._make_image_gradient(cotangent)
            self._set_inputs_exactly(inputs)
            names = (*sorted(extra - set(requested)), *requested)
            with self._tracked(names, inputs) as tracked, self._crop_film():
                self._backpropagate(method, image_gradient, seed, spp)
                return _collect_gradients(tracked, requested, inputs)

    def _choose_adjoint(self, method: str) -> tuple[str, set[str]]:
        """Return the method of an integrator for the adjoint, and the inputs it adds.

        These are differentiated although they are not requested. Usually there are
        none, since "gradients" is left out. To measure what these gradients take, it is
        not left out.

        Args:
            method: as in `render_adjoint`.
        """
        extra = set[str]()
        if "gradients" not in self._leave_out:
            extra = set(self.interior_inputs)
        # The projective integrator supports no lens and no medium.
        can_be_projective = (
            method == "path" and self._pinhole and not self.is_volumetric
        )
        if can_be_projective and "boundary" not in self._leave_out:
            method = "boundary"
            extra = extra | self._buffers
        # The integrator of images may be "path", which has no adjoint; "prb" has.
        if method == "path" and self.integrator_name != "prb":
            method = "adjoint"
        return method, extra

    def _backpropagate(
        self, method: str, image_gradient: Tensor, seed: int, spp: int
    ) -> None:
        """Add the derivatives of an image's loss to the gradients of tracked inputs.

        Args:
            method: method of the integrator, see `_get_integrator`.
            image_gradient: derivative of the loss by the channels of Mitsuba's image.
            seed, spp: as in `render_adjoint`.
        """
        # `PhotographPath` adds to the gradients of lamps before its loop and in it.
        is_photograph = method == "hidden" and self.plane_radiance is not None
        with add_without_copies() if is_photograph else nullcontext():
            self._get_integrator(method).render_backward(
                self._scene,
                self.parameters,
                mi.TensorXf(image_gradient),
                sensor=self._sensor,
                seed=seed,
                spp=self.round_sample_count(spp),
            )

    def _make_image_gradient(self, cotangent: Tensor) -> Tensor:
        """Return a cotangent with the channels of the image that Mitsuba renders.

        Without a backdrop these are the 3 channels of the radiance. With a backdrop,
        coverage is the fourth; its cotangent is 0, since it has no derivative here. The
        channels after it, of a plane in a photograph, are copied if there are any.

        Args:
            cotangent: (H, W, C), where C may also be 3 with a backdrop.
        """
        gradient = cotangent.detach().to(torch.float32)
        image_gradient = gradient[..., :3]
        if self._backdrop:
            coverage_gradient = torch.zeros(*gradient.shape[:2], 1)
            plane_gradient = gradient[..., 4:]  # no channels without a plane
            image_gradient = torch.cat(
                [image_gradient, coverage_gradient, plane_gradient], dim=-1
            )
        return image_gradient.contiguous()

    @contextmanager
    def _tracked(
        self, names: Sequence[str], inputs: Mapping[str, Tensor]
    ) -> Iterator[dict[str, Any]]:
        """Replace inputs by Dr.Jit tensors with gradients inside the `with`.

        Afterwards the inputs have their old values again.

        Args:
            names: inputs that are tracked.
            inputs: values of some of them; the others keep the values that they have.

        Yields:
            The tensors with gradients, by the inputs' names.
        """
        old_values = dict[str, Any]()
        tracked = dict[str, Any]()
        level = mi.log_level()
        try:
            for name in names:
                tracked[name] = self._track_input(name, inputs.get(name), old_values)
            self.parameters.update()
            # Mitsuba warns at every call if a film samples beyond its border.
            mi.set_log_level(mi.LogLevel.Error)
            yield tracked
        finally:
            mi.set_log_level(level)
            self._restore_parameters(old_values)

    def _track_input(
        self, name: str, rendered: Tensor | None, old_values: dict[str, Any]
    ) -> Any:
        """Replace one input by a Dr.Jit tensor with gradients, and return that.

        Args:
            name: the input.
            rendered: its value; None is the value that it has.
            old_values: gets a copy of the parameter's value, by its key.
        """
        key, scene_input = self.declared_inputs[name]
        value = self.parameters[key]
        # a copy: the parameter itself is replaced below
        old_values[key] = type(value)(value)
        if rendered is None:
            tensor = mi.TensorXf(parts.to_torch(value))
        else:
            # `to_rendered` limits the value to what Mitsuba can render.
            tensor = mi.TensorXf(scene_input.to_rendered(rendered))
        dr.enable_grad(tensor)
        # Mitsuba's parameter may have another type than a tensor.
        convert = scene_input.convert_to_mitsuba
        self.parameters[key] = convert(tensor) if convert else tensor
        return tensor

    def _restore_parameters(self, old_values: dict[str, Any]) -> None:
        """Put the values of parameters back, and empty the dictionary of them."""
        # Each value is taken out of the dictionary as it is put back, and its local
        # name is deleted. If two objects owned its array, Dr.Jit would later write
        # to a copy instead of the memory to which recordings refer, see `_write`.
        while old_values:
            key, value = old_values.popitem()
            self.parameters[key] = value
            del value
        self.parameters.update()

    def render_material_adjoint(
        self,
        inputs: Mapping[str, Tensor],
        cotangent: Tensor,
        seed: int,
        spp: int,
        *,
        meshes: Collection[str],
    ) -> dict[str, Tensor]:
        """Return the gradient by the vertices and normals of some meshes.

        It is computed by the material form of the adjoint, see `material_adjoint`.

        Args:
            inputs: inputs that differ from the base values; they include
                `NAME.vertices` and `NAME.normals` of each of the meshes.
            cotangent: (H, W, 3) derivative of the loss by the radiance.
            seed: seed of the samples, which should differ from the primal render's.
            spp: samples per pixel of the interior term.
            meshes: names of the meshes.
        """
        with mitsuba_lock:
            # Imported here, since few searches need it.
            from advsearch.scene.mitsuba_backend.material_adjoint import (
                material_adjoint,
            )

            self._set_inputs_exactly(inputs)
            # The first call loads integrators of its own, which makes recordings stale.
            scene_registry.n_changes += 1
            buffers = ("vertices", "normals")
            moving = [f"{name}.{buffer}" for name in meshes for buffer in buffers]
            return material_adjoint(
                self._scene,
                self._sensor,
                self.parameters,
                {name: inputs[name] for name in moving},
                cotangent=cotangent,
                seed=seed,
                spp=spp,
                max_depth=self.current_max_depth,
                shadow_spp=SHADOW_SPP,
            )

    @property
    def material_limits(self) -> tuple[str, ...]:
        """What `material_adjoint` leaves out or gets wrong, in sentences."""
        # Imported here, since few searches need it.
        from advsearch.scene.mitsuba_backend.material_adjoint import LIMITS

        return tuple(LIMITS)

    def collect_paths(
        self, inputs: Mapping[str, Tensor], name: str, seed: int, spp: int
    ) -> TracedPaths:
        """Trace light paths, and collect where they depend on one texture.

        Each vertex of a path has the derivative of its pixel by the texture there. The
        result also has the images of the paths.

        Args:
            inputs: what differs from the base values.
            name: input of the texture, such as "object.base_color" or a projector's
                pattern.
            seed: seed of the samples.
            spp: samples per pixel.
        """
        with mitsuba_lock, self._crop_film():
            self._set_inputs_exactly(inputs)
            key, _scene_input = self.declared_inputs[name]
            spp = self.round_sample_count(spp)
            noise = self._make_noise(seed, spp)
            projector = self._find_projector_of(name)
            paths = collect_paths(
                self._scene,
                self.parameters,
                key,
                noise,
                size=self.window_size,
                depth=self.current_max_depth,
                spp=spp,
                projector=projector,
                unseen=self._find_plane(),  # its change is rendered apart
                roulette_depth=self.roulette_depth,
            )
            if projector is not None:
                size = self.parameters[key].shape[:2]
                return _repeat_vertices(paths, surface=None, size=size)
            return self._repeat_on_mesh(paths, name, key)

    def _repeat_on_mesh(self, paths: TracedPaths, name: str, key: str) -> TracedPaths:
        """Return paths with texture coordinates for the repeating texture of a mesh.

        They change only on a surface of the user's: one of ours repeats already.

        Args:
            paths: the paths.
            name: input of the texture, such as "mug.base_color".
            key: Mitsuba's key of the texture.
        """
        description, _filter = self.description_and_filter
        surface = description.meshes[name.partition(".")[0]].surface
        if surface is None:
            return paths
        return _repeat_vertices(paths, surface, self.parameters[key].shape[:2])

    def _make_noise(self, seed: int, spp: int) -> Any:
        """Return Mitsuba's sampler, seeded for all samples of the window."""
        noise = mi.load_dict({"type": self.sampler_name, "sample_count": spp})
        noise.set_samples_per_wavefront(spp)
        n_samples = math.prod(self.window_size) * spp
        # `opaque`: a literal seed would be compiled into the kernel as a constant.
        noise.seed(dr.opaque(mi.UInt32, seed), n_samples)
        return noise

    def _find_projector_of(self, input_name: str) -> Any:
        """Return the projector to which an input belongs; None if it is no pattern.

        "mug.base_color" belongs to a mesh, and a pattern to a projector, which is one
        of Mitsuba's emitters.
        """
        if not input_name.endswith(PATTERN_SUFFIX):
            return None
        return self._find_projector(input_name.partition(".")[0])

    def _find_projector(self, name: str) -> Any:
        """Return the emitter of Mitsuba's scene with a name, or None."""
        emitters = {emitter.id(): emitter for emitter in self._scene.emitters()}
        return emitters.get(name)

    # ---- implementation

    def _find_plane(self) -> Any:
        """Return Mitsuba's shape of the plane that receives the shadow, or None."""
        if self.plane_radiance is None:
            return None
        shapes = {shape.id(): shape for shape in self._scene.shapes()}
        return shapes[parts.GROUND_NAME]

    def _set_inputs_exactly(self, inputs: Mapping[str, Tensor]) -> None:
        """Set exactly these inputs, and everything else to its base value.

        Inputs that already have the requested value are not written again. Vertices are
        overwritten in the memory that they have, since recordings refer to it. Some
        numbers are compiled into recordings as constants: if one of them changes, all
        recordings are stale, which `scene_registry.n_changes` counts.
        """
        self._check_known(inputs)
        if self._values_to_upload:
            # Write all inputs: without `_applied_values`, all of them count as changed.
            inputs = {**self._values_to_upload, **inputs}
            self._applied_values.clear()
        changes = self._find_changes(inputs)
        changes_constants = not self._constants.isdisjoint(changes)
        if changes_constants:
            scene_registry.n_changes += 1
        for name, value in changes.items():
            self._apply_change(name, value)
        if changes:
            self.parameters.update()

    def _apply_change(self, name: str, value: Tensor | None) -> None:
        """Write a value of an input, or its base value if it is None, and note that."""
        self._write(name, value)
        if value is None:  # back to the base value
            del self._applied_values[name]
        else:
            self._applied_values[name] = value.clone()

    def _check_known(self, inputs: Mapping[str, Tensor]) -> None:
        """Check that the scene has all of these inputs."""
        unknown = [name for name in inputs if name not in self.declared_inputs]
        if any(name.endswith(".base_color") for name in unknown):
            raise InputError(
                f"{unknown[0]}: the surface is one of Mitsuba's own without a base "
                "color that can be searched; leave "
                "out what changes it, such as texture, material or patch, or search "
                "mitsuba:KEY=[low, high]"
            )
        if unknown:
            raise InputError(
                f"the scene has no input {', '.join(unknown)}; it has "
                f"{', '.join(sorted(self.declared_inputs))}"
            )

    def _find_changes(self, inputs: Mapping[str, Tensor]) -> dict[str, Tensor | None]:
        """Return the new values of inputs that differ from what is set, by name.

        None as a value means that the input goes back to its base value.
        """
        reset = [name for name in self._applied_values if name not in inputs]
        changes: dict[str, Tensor | None] = dict.fromkeys(reset)  # all None
        for name, tensor in inputs.items():
            _key, scene_input = self.declared_inputs[name]
            value = scene_input.to_rendered(tensor)
            if not self._has_applied(name, value):
                changes[name] = value
        return changes

    def _has_applied(self, name: str, value: Tensor) -> bool:
        """Return whether an input has a value already, and not its base value."""
        applied = self._applied_values.get(name)
        return (
            applied is not None
            and applied.shape == value.shape
            and torch.equal(applied, value)
        )

    def _write(self, name: str, tensor: Tensor | None) -> None:
        """Write a value of an input to Mitsuba, or its base value if it is None.

        At the first write the base value is stored.

        Raises:
            InputError: the value has the wrong number of elements.
        """
        key, scene_input = self.declared_inputs[name]
        current = self.parameters[key]
        _check_input_size(name, scene_input, tensor)
        is_buffer = name in self._buffers
        if name not in self._base_values:
            self._base_values[name] = _copy_parameter(current, is_buffer)
        if tensor is None:
            # a copy, so that the stored value is not what Mitsuba changes
            value = type(current)(self._base_values[name])
        else:
            value = _to_mitsuba(scene_input, tensor)
        if is_buffer:
            self._overwrite_buffer(current, value)
            self.parameters.set_dirty(key)
        else:
            self.parameters[key] = value

    def _overwrite_buffer(self, buffer: Any, value: Any) -> None:
        """Write vertices or normals into the memory that they have.

        Recordings refer to that memory. If another array shares it, Dr.Jit writes to a
        copy instead. Then the address differs, and all recordings are stale.
        """
        address = buffer.torch().data_ptr()
        dr.scatter(buffer, value, dr.arange(mi.UInt32, len(buffer)))
        dr.eval(buffer)
        if buffer.torch().data_ptr() != address:
            scene_registry.n_changes += 1

    def _get_integrator(self, method: str) -> Any:
        """Return the integrator of a method at the current depth, loaded on first use.

        Args:
            method: "path" for images; "adjoint" for derivatives of images; "hidden" for
                both, without the environment that the camera sees; "guides" for the
                denoiser; "boundary" for derivatives with the terms of moving outlines.
        """
        key = (method, self.current_max_depth)
        if key not in self._integrators:
            recipe = self._list_integrators()[method]
            self._integrators[key] = mi.load_dict(recipe)
            scene_registry.n_changes += 1
        return self._integrators[key]

    def _list_integrators(self) -> dict[str, Plugin]:
        """Return the plugins of integrators at the current depth, by the method."""
        adjoint = self._make_path_integrator("prb", self._gradient_roulette_depth)
        return {
            "path": self._make_path_integrator(
                self.integrator_name, self.roulette_depth
            ),
            "adjoint": adjoint,
            "hidden": self._make_hidden_integrator(adjoint),
            "guides": self._guides,
            "boundary": {
                "type": "prb_projective",
                "max_depth": self.current_max_depth,
                "rr_depth": NO_ROULETTE_DEPTH,
                "guiding": "none",
            },
        }

    def _make_path_integrator(self, kind: str, roulette_depth: int) -> Plugin:
        """Return the plugin of a path integrator at the current depth.

        Args:
            kind: Mitsuba's type of the integrator.
            roulette_depth: bounces from which on Russian roulette may end a path.
        """
        return {
            "type": kind,
            "max_depth": self.current_max_depth,
            "rr_depth": roulette_depth,
            # What a part of the scene needs. That of haze replaces the type, so that
            # these entries come last.
            **self._path_entries,
        }

    def _make_hidden_integrator(self, adjoint: Plugin) -> Plugin:
        """Return the integrator that leaves out the environment that the camera sees.

        It is made of `adjoint`, since it has to have derivatives as well as images.
        """
        hidden = {**adjoint, "hide_emitters": True}
        if self.plane_radiance is None:
            return hidden
        description, _filter = self.description_and_filter
        hidden["type"] = "advsearch_photograph"
        # gloss and roughness of the plane's coat, by the names of the properties of
        # `PhotographPath`
        hidden["reflectance"] = description.get_number("ground.gloss")
        hidden["roughness"] = description.get_number("ground.roughness")
        return hidden


def _copy_parameter(value: Any, is_buffer: bool) -> Any:
    """Return a copy of a parameter's value.

    The memory of a buffer is copied, since it is overwritten in place. Other values are
    replaced.
    """
    return type(value)(value.torch().clone() if is_buffer else value)


def _can_be_recorded(description: SceneDescription) -> bool:
    """Return whether Dr.Jit can record renders of a scene.

    It can record neither a thin lens nor a textured emission.
    """
    has_texture = any(map(has_textured_emission, description.meshes.values()))
    return not description.thin_lens and not has_texture


def _leave_out_dark_lamps(plugins: Plugin, description: SceneDescription) -> None:
    """Leave lamps that are dark by default out of the sampling of lights.

    If an input switches one on, paths still find it when they meet it by chance.
    """
    for part in description.parts:
        if isinstance(part, Lamp) and part.dark:
            lamp = plugins[part.name]
            # a lamp is an emitter, or a shape that has one
            lamp.get("emitter", lamp)["sampling_weight"] = 0.0


def _make_render_function(spp: int) -> Callable[..., Any]:
    """Return the function that renders one image, which Dr.Jit records.

    Its only variable from outside is `spp`, since Dr.Jit reads those too.
    """

    def render(scene: Any, sensor: Any, integrator: Any, seed: Any) -> Any:
        """Render one image; this is the function that Dr.Jit records."""
        image = integrator.render(
            scene,
            sensor=sensor,
            seed=seed,
            spp=spp,
            develop=True,
            evaluate=False,
        )
        # After the render the sampler's state refers to its full computation.
        # A new seed, for a single sample, releases that.
        sensor.sampler().seed(0, 1)
        return image

    return render


def _collect_gradients(
    tracked: Mapping[str, Any], names: Sequence[str], inputs: Mapping[str, Tensor]
) -> dict[str, Tensor]:
    """Return the gradients of tracked inputs with some names, in the inputs' shapes."""
    gradients = {name: dr.grad(tracked[name]).torch().clone() for name in names}
    return {
        name: gradient.reshape(inputs[name].shape)
        for name, gradient in gradients.items()
    }


def _repeat_vertices(
    paths: TracedPaths, surface: Mapping[str, object] | None, size: Any
) -> TracedPaths:
    """Return paths with texture coordinates for a texture that repeats.

    The matrix that is made of the vertices repeats the texture. Texture coordinates are
    converted where Mitsuba does not: a projector's image ends at its border, and one of
    Mitsuba's own surfaces may mirror or clamp. A surface of ours repeats, and its
    coordinates stay.

    Args:
        paths: the paths.
        surface: Mitsuba's dictionary of the surface; None for a projector's image.
        size: rows and columns of the texture.
    """
    vertices = [
        replace(vertex, uv=_to_repeating(vertex.uv, surface, size))
        for vertex in paths.vertices
    ]
    return replace(paths, vertices=vertices)


def _check_input_size(
    name: str, scene_input: parts.SceneInput, tensor: Tensor | None
) -> None:
    """Raise InputError if a value of an input has the wrong number of elements."""
    if tensor is not None and scene_input.shape is not None:
        if tensor.numel() != math.prod(scene_input.shape):
            raise InputError(
                f"{name}: expected shape {scene_input.shape}, got "
                f"{tuple(tensor.shape)}, from what sets it"
            )


def _to_mitsuba(scene_input: parts.SceneInput, tensor: Tensor) -> Any:
    """Convert a value of an input to the type that Mitsuba's parameter has."""
    value = mi.TensorXf(tensor)
    if scene_input.convert_to_mitsuba:
        value = scene_input.convert_to_mitsuba(value)
    return value


def _make_guides_plugin(description: SceneDescription) -> Plugin:
    """Return the integrator of the denoiser's guides.

    Mitsuba's own ("aov") does not see through cut-outs, for which there is one of ours.
    The last six channels of both are albedo and normal.
    """
    if description.has_opacity:
        return {"type": "advsearch_guides"}
    return {"type": "aov", "aovs": "albedo:albedo,normal:sh_normal"}


def _check_emission(description: SceneDescription) -> None:
    """Raise InputError if a scene has both a backdrop and surfaces that emit light."""
    if not description.backdrop or not description.has_emission:
        return
    backdrop = "the plain background"
    if description.backdrop_photograph is not None:
        backdrop = "the photograph"
    raise InputError(
        "background: Mitsuba hides surfaces that emit light together with "
        f"the environment; leave {backdrop} out, or take an object and "
        "surroundings without emission"
    )


def _to_repeating(
    uv: Tensor, surface: Mapping[str, object] | None, size: tuple[int, int]
) -> Tensor:
    """Convert texture coordinates to those for a texture that repeats.

    A look-up that repeats the texture then finds the same texels as Mitsuba's own
    look-up, which may mirror or clamp.

    Args:
        uv: (n, 2) texture coordinates.
        surface: one of Mitsuba's own surfaces; None for a projector's image, which ends
            at its border instead.
        size: rows and columns of the texture.
    """
    if surface is None:
        # a projector's image. Beyond the centers of the outer texels Mitsuba's look-up
        # stays constant, but one that repeats would blend with the other side.
        half_texel = 0.5 / torch.tensor(size[::-1])
        return uv.clamp(half_texel, 1.0 - half_texel)
    options = next(
        plugin
        for plugin in iterate_plugins(surface)
        if plugin["type"] == BASE_COLOR_TYPE
    )
    return to_repeating_uv(uv, options, size)
