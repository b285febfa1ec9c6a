"""A described scene inside Mitsuba: built once, changed only through named inputs,
rendered and differentiated.

Inputs are torch tensors with names of ours (`object.base_color`), so that nothing
outside this room knows Mitsuba's parameter paths. Every call states all inputs it wants
changed; those it does not name have their base values, so that no configuration is ever
applied on top of another.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from advsearch.errors import InputError
from advsearch.interrupts import INTERRUPTS
from advsearch.scene.assembly import Assembly
from advsearch.scene.description import OBJECT, SceneDescription
from advsearch.scene.formation import EVERYTHING, SAMPLER, Surfaces, next_count
from advsearch.scene.grounds import enclosed
from advsearch.scene.mitsuba_backend import parts
from advsearch.scene.mitsuba_backend.meshes import (
    NORMALS,
    POSITIONS,
    repeating,
    sampling_weights,
    textured_emission,
)
from advsearch.scene.mitsuba_backend.transport import Paths, collect, first_hits
from advsearch.scene.mitsuba_backend.variant import (
    Plugin,
    Recordings,
    dr,
    mi,
    one_at_a_time,
    population,
)
from advsearch.scene.parts import BASE_COLOR as BASE_COLOR_PLACE
from advsearch.scene.parts import PATTERN, Lamp, LampGlass, plugins_in

MAX_DEPTH = 6  # longest light path in segments: five bounces off surfaces
NO_ROULETTE = 1000
ROULETTE = 2
"""Segments after which Russian roulette starts: never where paths soon leave the scene
by themselves. Among houses it saves a third of the time without more noise; from 1 on,
single gradients were a fifth off.
"""
# samples a pixel of the shadow term; without it a resting object's gradient has a
# cosine of 0.66
SHADOW_SPP = 4
# input: (h, w, 3) linear reflectance of the object, row 0 at v = 1 (top of the image)
BASE_COLOR = "object.base_color"


class MitsubaScene:
    """Renders one scene at one size.

    Attributes:
        depth: longest light path in segments of the renders now.
        assembly: turns the inputs of a space into those of this scene.
        made: of what scene, and with which filter.
        names: every input that can be set.
        parameters: Mitsuba's own.
        roulette: segments of a light path after which Russian roulette starts.
        declared: for each input the key among them, and what it takes.
        interior: those that the interior adjoint differentiates correctly.

    Args:
        resolution: (height, width) in pixels.
        filter: reconstruction filter, "box" or "gaussian".
        leave_out: names from `advsearch.scene.formation.ITEMS`; less than everything
            only to measure what it brings.
        max_depth: longest light path in segments.
        sampler: Mitsuba's name of the sampler; some round sample counts up, see
            `next_count`.
        integrator: Mitsuba's name of the path integrator of primal renders, where there
            is no medium.
    """

    def __init__(
        self,
        description: SceneDescription,
        resolution: tuple[int, int],
        *,
        filter: str = "box",
        leave_out: Collection[str] = EVERYTHING,
        max_depth: int = MAX_DEPTH,
        sampler: str = SAMPLER,
        integrator: str = "prb",
    ) -> None:
        with one_at_a_time:
            import advsearch.scene.mitsuba_backend.own_plugins  # noqa: F401  (registers them; it needs the variant)

            # first: kernels are compiled for the numbers of their objects, which it
            # sets free
            if population.unused:
                population.bury()
            self.made = (description, filter)
            self.resolution = resolution
            self.sampler = sampler
            self.assembly = Assembly(description)
            self.max_depth = self.depth = max_depth
            self._leave_out = frozenset(leave_out)
            unrecorded = description.thin_lens or any(
                map(textured_emission, description.meshes.values())
            )
            # Dr.Jit can record neither of these
            self._freeze = "tracing" in leave_out and not unrecorded
            self.roulette = ROULETTE if enclosed(description) else NO_ROULETTE
            self._pinhole = (
                not description.thin_lens and description.camera_model is None
            )
            self._backdrop = description.backdrop
            if description.backdrop and description.emits:
                raise InputError(
                    "background: Mitsuba hides surfaces that emit light together with "
                    "the environment; leave the plain "
                    "background out, or take an object and surroundings without "
                    "emission"
                )
            self._guides: Plugin = {
                "type": "aov",
                "aovs": "albedo:albedo,normal:sh_normal",
            }
            if description.cut_out:
                self._guides = {"type": "advsearch_guides"}
            self.volumetric = any(part.volumetric for part in description.parts)
            plugins = parts.scene_dict(description, resolution, filter, sampler)
            self._path: Plugin = {"type": integrator}
            with parts.refusing(description):
                lobes = None if "lobes" in leave_out else parts.IDLE_LOBES
                translated = [parts.mesh_translation(description.meshes[OBJECT], lobes)]
                translated += [
                    parts.translation(description.placed(part))
                    for part in description.parts
                ]
                for part in translated:
                    plugins |= part.plugins
                    self._path |= part.integrator
                # a path that meets a dark lamp by chance still counts, should it be lit
                if "emitters" in leave_out:
                    for lamp in description.parts:
                        if isinstance(lamp, Lamp) and lamp.dark:
                            plugins[lamp.name].get("emitter", plugins[lamp.name])[
                                "sampling_weight"
                            ] = 0.0
                self._scene = mi.load_dict(plugins, optimize=False)
            self._sensor = self._scene.sensors()[0]
            self.parameters = mi.traverse(self._scene)
            for name, weight in sampling_weights(description.meshes.values()).items():
                self.parameters[f"{name}.emitter.sampling_weight"] = weight
            self.parameters.update()
            self._integrators: dict[tuple[str, int], Any] = {}
            inputs = [
                *parts.scene_inputs(resolution),
                *(own for part in translated for own in part.inputs),
            ]
            self.declared = {
                own.name: (key, own)
                for own in inputs
                if (key := parts.key_of(self.parameters, own))
            }
            self.names = frozenset(self.declared)
            self.interior = frozenset(
                name for name, (_, takes) in self.declared.items() if takes.interior
            )
            self._buffers = frozenset(
                n
                for n, (key, _) in self.declared.items()
                if key.endswith((POSITIONS, NORMALS))
            )
            self._literals = frozenset(
                n
                for n, (_, own) in self.declared.items()
                if own.write is parts.plain_number
            )
            self._base: dict[str, Any] = {}
            self._applied: dict[str, Tensor] = {}
            self._recorded = Recordings()
            bounds = self._scene.shapes() if self.volumetric else []
            media = [
                side
                for shape in bounds
                for side in (shape.interior_medium(), shape.exterior_medium())
            ]
            held = self._scene, self._integrators, self.parameters
            population.add(
                self,
                *held,
                media=tuple(medium for medium in media if medium is not None),
            )
            self._every: dict[str, Tensor] = {}
            if "uploads" not in leave_out:
                self._every = {name: self.base(name) for name in sorted(self.names)}

    def like(self, **changes: Any) -> MitsubaScene:
        """Return another scene made as this one was, but for `max_depth`, `sampler`,
        `integrator` or `leave_out`.
        """
        description, filter = self.made
        settings = {
            "max_depth": self.max_depth,
            "leave_out": self._leave_out,
            "sampler": self.sampler,
            **changes,
        }
        other = MitsubaScene(description, self.resolution, filter=filter, **settings)
        for what in ("path", "guides"):
            # one that comes later makes the recordings of all scenes stale
            other._integrator(what)
        return other

    @contextmanager
    def shorter(self, depth: int | None) -> Iterator[None]:
        """Render light paths of at most `depth` segments inside the `with`; None
        changes nothing.
        """
        before = self.depth
        self.depth = self.depth if depth is None else min(depth, self.max_depth)
        try:
            yield
        finally:
            self.depth = before

    def next_count(self, samples: float, sampler: str | None = None) -> int:
        """Return how many samples the scene's sampler, or another one, takes if it is
        asked for at least so many.
        """
        return next_count(sampler or self.sampler, samples)

    def base(self, name: str) -> Tensor:
        """Return the base value of an input, as a fresh torch tensor of the input's
        shape.
        """
        key, takes = self.declared[name]
        self._set({})
        value = parts.as_torch(self.parameters[key])
        return value if takes.shape is None else value.reshape(takes.shape)

    def pictures(
        self, inputs: Mapping[str, Tensor], seeds: Mapping[str, int], spp: int
    ) -> list[Tensor]:
        """Render pictures of one configuration with `spp` independent samples a pixel
        each.

        A render is recorded on first use and replayed later. Only primal ones are:
        Dr.Jit 1.5.0 corrupts memory when it replays some adjoints (a texture of 32 x 32
        under a film of 32 x 32 pixels, say), and the gain there is small.

        Args:
            inputs: what differs from the base values.
            seeds: what is wanted, each with the number of its noise: "path", the linear
                radiance; "hidden", the same without what the environment shows
                directly, for a backdrop; "guides", what guides the denoiser.
            spp: samples a pixel.

        Returns:
            For each of `seeds` (H, W, 3) float32; of a scene with a backdrop (H, W, 4)
            with the coverage of its surfaces; of "guides" (H, W, 6), the first hit's
            albedo in [0, 1] and its shading normal.
        """
        INTERRUPTS.look()
        with one_at_a_time:

            def render(scene: Any, sensor: Any, integrator: Any, seed: Any) -> Any:
                image = integrator.render(
                    scene,
                    sensor=sensor,
                    seed=seed,
                    spp=spp,
                    develop=True,
                    evaluate=False,
                )
                # otherwise the sampler's state keeps the whole render alive
                sensor.sampler().seed(0, 1)
                return image

            self._set(inputs)
            if population.unused:
                population.bury()
            spp = self.next_count(spp)
            integrators = [self._integrator(what) for what in seeds]
            media = population.media() if self.volumetric else []
            pictures: list[Tensor] = []
            for (what, seed), integrator in zip(
                seeds.items(), integrators, strict=True
            ):
                function = (
                    self._recorded.of((what, spp, self.depth), render, media)
                    if self._freeze
                    else render
                )
                image = (
                    function(
                        self._scene,
                        self._sensor,
                        integrator,
                        dr.opaque(mi.UInt32, seed),
                    )
                    .torch()
                    .clone()
                )
                if what == "guides":
                    image = image[..., -6:]
                    image[..., :3].clamp_(0.0, 1.0)
                pictures.append(image)
            return pictures

    def radiance(self, inputs: Mapping[str, Tensor], seed: int, spp: int) -> Tensor:
        """Render linear radiance; as of `pictures`."""
        return self.pictures(inputs, {"path": seed}, spp)[0]

    def guides(
        self, inputs: Mapping[str, Tensor], seed: int, spp: int
    ) -> tuple[Tensor, Tensor]:
        """Render what guides the denoiser: first-hit albedo and shading normal, each
        (H, W, 3) float32.
        """
        both = self.pictures(inputs, {"guides": seed}, spp)[0]
        return both[..., :3], both[..., 3:]

    def held(self, inputs: Mapping[str, Tensor]) -> Any:
        """Return Mitsuba's scene with these inputs set, until the next call of anything
        here.
        """
        with one_at_a_time:
            self._set(inputs)
            return self._scene

    def stand(self, inputs: Mapping[str, Tensor]) -> None:
        """Set the vertices and normals that these inputs have, if others are set;
        everything else may be anything.
        """
        wanted, now = (
            {n: some[n] for n in some if n in self._buffers}
            for some in (inputs, self._applied)
        )
        if wanted.keys() != now.keys() or not all(
            torch.equal(wanted[n].float(), now[n]) for n in wanted
        ):
            self.held(inputs)

    def surfaces(self, inputs: Mapping[str, Tensor], fineness: int = 1) -> Surfaces:
        """Return what the camera sees first through the middle of each pixel; arguments
        as for `Renderer.surfaces`.
        """
        with one_at_a_time:
            self._set(inputs)
            height, width = self.resolution
            hits = first_hits(
                self._scene, self._sensor, (height * fineness, width * fineness)
            )
            for part in self.made[0].parts:
                if isinstance(part, LampGlass):  # it belongs to what carries it
                    glass = hits.seen(part.name)
                    hits.face[glass] = torch.from_numpy(part.lies_on)[hits.face[glass]]
                    hits.id[glass] = hits.names.index(part.carrier) + 1
            return hits

    def adjoint(
        self,
        inputs: Mapping[str, Tensor],
        cotangent: Tensor,
        seed: int,
        spp: int,
        *,
        wrt: Collection[str] | None = None,
        method: str = "path",
    ) -> dict[str, Tensor]:
        """Return the gradient of `sum(cotangent * radiance)` with respect to named
        inputs.

        Args:
            inputs: as in `radiance`.
            cotangent: (H, W, 3) float32.
            seed: should differ from the primal's, or the gradient of a noisy picture is
                returned.
            spp: independent samples a pixel.
            wrt: the inputs whose gradients are wanted; None means all that are named.
            method: "path", the interior adjoint (path replay backpropagation, Vicini et
                al. 2021), unbiased for inputs that do not move silhouettes; "hidden",
                the same without the visible environment. Where boundary terms are not
                left out, Mitsuba's projective integrator (Zhang et al. 2023) takes the
                place of "path".

        Returns:
            For each of `wrt` a float32 tensor of the input's shape.
        """
        with one_at_a_time:
            wanted = tuple(inputs if wrt is None else wrt)
            beside = set() if "gradients" in self._leave_out else set(self.interior)
            plain = method == "path" and self._pinhole and not self.volumetric
            # which knows no lens and no medium
            if "boundary" not in self._leave_out and plain:
                method = "boundary"
                beside = beside | self._buffers
            shown = cotangent.detach().to(torch.float32).contiguous()
            if self._backdrop:
                shown = torch.cat([shown, torch.zeros_like(shown[..., :1])], dim=-1)
            self._set(inputs)
            held = dict[str, Any]()
            tracked = dict[str, Any]()
            gradients = dict[str, Tensor]()
            level = mi.log_level()
            try:
                for name in (*sorted(beside - set(wanted)), *wanted):
                    key, takes = self.declared[name]
                    own = self.parameters[key]
                    held[key] = type(own)(own)
                    tracked[name] = mi.TensorXf(
                        takes.rendered(inputs[name])
                        if name in inputs
                        else parts.as_torch(own)
                    )
                    dr.enable_grad(tracked[name])
                    self.parameters[key] = (
                        takes.write(tracked[name]) if takes.write else tracked[name]
                    )
                self.parameters.update()
                spp = self.next_count(spp)
                arriving = mi.TensorXf(shown)
                # it warns at every call of a film that samples beyond its border
                mi.set_log_level(mi.LogLevel.Error)
                self._integrator(method).render_backward(
                    self._scene,
                    self.parameters,
                    arriving,
                    sensor=self._sensor,
                    seed=seed,
                    spp=spp,
                )
                for name in wanted:
                    gradients[name] = (
                        dr.grad(tracked[name])
                        .torch()
                        .clone()
                        .reshape(inputs[name].shape)
                    )
                return gradients
            finally:
                mi.set_log_level(level)
                while held:  # what is put back must have no second owner, see `_set`
                    self.parameters.__setitem__(*held.popitem())
                self.parameters.update()

    def material_adjoint(
        self,
        inputs: Mapping[str, Tensor],
        cotangent: Tensor,
        seed: int,
        spp: int,
        *,
        meshes: Collection[str],
    ) -> dict[str, Tensor]:
        """Return the gradient with respect to the vertices and normals of some meshes,
        by the material form. The inputs have `NAME.vertices` and `NAME.normals` of
        each, `spp` are the samples of the interior term; the others as of `adjoint`.
        """
        with one_at_a_time:
            # few scenes search a material
            from advsearch.scene.mitsuba_backend.material_adjoint import (
                material_adjoint,
            )

            self._set(inputs)
            population.changes += 1  # the first call loads integrators of its own
            moving = [
                f"{name}.{what}" for name in meshes for what in ("vertices", "normals")
            ]
            counts = {
                "seed": seed,
                "spp": spp,
                "max_depth": self.depth,
                "shadow_spp": SHADOW_SPP,
            }
            held = self._scene, self._sensor, self.parameters
            return material_adjoint(
                *held,
                {name: inputs[name] for name in moving},
                cotangent=cotangent,
                **counts,
            )

    @property
    def material_limits(self) -> tuple[str, ...]:
        """What `material_adjoint` leaves out or gets wrong, in sentences."""
        # few scenes search a material
        from advsearch.scene.mitsuba_backend.material_adjoint import LIMITS

        return tuple(LIMITS)

    def transport(
        self, inputs: Mapping[str, Tensor], name: str, seed: int, spp: int
    ) -> Paths:
        """Return what the vertices of light paths add to their pixels for a unit more
        of an input that is a base colour, or a projector's pattern, and the picture of
        these paths; the others as of `pictures`.
        """
        with one_at_a_time:
            self._set(inputs)
            key = self.declared[name][0]
            spp = self.next_count(spp)
            noise = mi.load_dict({"type": self.sampler, "sample_count": spp})
            noise.set_samples_per_wavefront(spp)
            noise.seed(
                dr.opaque(mi.UInt32, seed),
                self.resolution[0] * self.resolution[1] * spp,
            )
            part = name.partition(".")[0]
            emitters = {emitter.id(): emitter for emitter in self._scene.emitters()}
            projector = emitters.get(part) if name.endswith(PATTERN) else None
            paths = collect(
                self._scene,
                self.parameters,
                key,
                noise,
                self.resolution,
                self.depth,
                spp,
                projector,
            )
            size = self.parameters[key].shape[:2]
            surface = None
            if projector is None:
                surface = self.made[0].meshes[part].surface
                if surface is None:
                    return paths

            def looked_up(uv: Tensor) -> Tensor:
                """Where lookups of a matrix, which repeat at the border, find what is
                shown at texture coordinates.
                """
                if surface is None:  # a projector's picture ends at the border
                    half = 0.5 / torch.tensor(size[::-1])
                    return uv.clamp(half, 1.0 - half)
                options = next(
                    plugin
                    for plugin in plugins_in(surface)
                    if plugin["type"] == BASE_COLOR_PLACE
                )
                return repeating(uv, options, size)

            return replace(
                paths,
                vertices=[
                    replace(some, uv=looked_up(some.uv)) for some in paths.vertices
                ],
            )

    # ---- inside
    # -----------------------------------------------------------------------------------------------------

    def _set(self, inputs: Mapping[str, Tensor]) -> None:
        """Set exactly these inputs, everything else at its base value; does nothing for
        what is set already.

        Vertices are written into the memory where they are: recordings hold on to it.
        Numbers that Mitsuba takes for constants are part of a recording, so that every
        change makes all recordings stale.
        """
        unknown = [name for name in inputs if name not in self.declared]
        if any(name.endswith(".base_color") for name in unknown):
            raise InputError(
                f"{unknown[0]}: the surface is one of Mitsuba's own without a base "
                "colour that can be searched; leave "
                "out what changes it, such as texture, material or patch, or search "
                "mitsuba:KEY=[low, high]"
            )
        if unknown:
            raise InputError(
                f"the scene has no input {', '.join(unknown)}; it has "
                f"{', '.join(sorted(self.declared))}"
            )
        if self._every:
            inputs = {**self._every, **inputs}
            self._applied.clear()
        wanted: dict[str, Tensor | None] = dict.fromkeys(
            [name for name in self._applied if name not in inputs]
        )
        for name, tensor in inputs.items():
            value = self.declared[name][1].rendered(tensor)
            applied = self._applied.get(name)
            if (
                applied is None
                or applied.shape != value.shape
                or not torch.equal(applied, value)
            ):
                wanted[name] = value
        population.changes += not self._literals.isdisjoint(wanted)
        for name, fresh in wanted.items():
            key, takes = self.declared[name]
            current = self.parameters[key]
            if (
                fresh is not None
                and takes.shape is not None
                and fresh.numel() != math.prod(takes.shape)
            ):
                raise InputError(
                    f"{name}: expected shape {takes.shape}, got "
                    f"{tuple(fresh.shape)}, from what sets it"
                )
            if name not in self._base:
                self._base[name] = type(current)(
                    current.torch().clone() if name in self._buffers else current
                )
            value = (
                type(current)(self._base[name]) if fresh is None else mi.TensorXf(fresh)
            )
            if fresh is not None and takes.write:
                value = takes.write(value)
            if name in self._buffers:
                place = current.torch().data_ptr()
                dr.scatter(current, value, dr.arange(mi.UInt32, len(current)))
                dr.eval(current)
                # Dr.Jit copies what has a second owner
                population.changes += current.torch().data_ptr() != place
                self.parameters.set_dirty(key)
            else:
                self.parameters[key] = value
            if fresh is None:
                del self._applied[name]
            else:
                self._applied[name] = fresh.clone()
        if wanted:
            self.parameters.update()

    def _integrator(self, method: str) -> Any:
        key = method, self.depth
        if key not in self._integrators:
            path = {
                "type": "prb",
                "max_depth": self.depth,
                "rr_depth": self.roulette,
                **self._path,
            }
            projective = {
                "type": "prb_projective",
                "max_depth": self.depth,
                "rr_depth": NO_ROULETTE,
            }
            recipes: dict[str, Plugin] = {
                "path": path, "hidden": {**path, "hide_emitters": True}, "guides": self._guides,
                "boundary": {**projective, "guiding": "none"},
            }  # fmt: skip
            self._integrators[key] = mi.load_dict(recipes[method])
            population.changes += 1
        return self._integrators[key]
