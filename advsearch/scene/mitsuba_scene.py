"""A described scene inside Mitsuba: built once, changed only through named inputs, rendered and differentiated.

Inputs are torch tensors with names of ours (`object.base_color`), so that nothing outside this room knows Mitsuba's
parameter paths. Every call states all inputs it wants changed; those it does not name have their base values, so that
no configuration is ever applied on top of another.
"""

from __future__ import annotations

import gc
import weakref
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from torch import Tensor

from advsearch.errors import InputError
from advsearch.scene.assembly import Assembly
from advsearch.scene.backend import mitsuba
from advsearch.scene.color import srgb_to_linear
from advsearch.scene.description import SceneDescription
from advsearch.scene.geometry import camera_to_world, object_to_world
from advsearch.scene.parts import MeshPart, PartInput, as_is, number, transform

MAX_DEPTH = 6
"""Longest light path in segments: five bounces off surfaces."""
NO_ROULETTE = 1000
"""Russian roulette never starts: it adds noise, and paths are short already."""

SHADOW_SPP = 4
"""Samples a pixel of the material form's shadow term; without it a resting object's gradient has a cosine of 0.66."""

BASE_COLOR = "object.base_color"
"""Input: (h, w, 3) linear reflectance of the object, row 0 at v = 1 (top of the image)."""

ENVIRONMENT_INPUT = PartInput("environment.padded", "environment.data", as_is, interior=True)
"""(H, W + 2, 3): Mitsuba keeps a copy of the last column before the first, and of the first after the last."""


class _Population:
    """The scenes inside Mitsuba that this process holds, and when they may go.

    A recorded kernel refers to the objects of all scenes that lived when it was recorded, and Dr.Jit leaves undefined
    what happens when it is replayed after one was added or removed. So every change of the population makes every
    recording stale, and a scene that nobody uses any more is kept until no render is under way: Python's garbage
    collector may strike in the middle of one.
    """

    def __init__(self) -> None:
        self.changes = 0
        self._held: dict[int, tuple[Any, ...]] = {}
        self._unused: list[int] = []

    def add(self, owner: MitsubaScene, *objects: Any) -> None:
        """Hold Mitsuba's objects for as long as their owner lives, and a little longer."""
        self.changes += 1
        self._held[self.changes] = objects
        weakref.finalize(owner, self._unused.append, self.changes)

    def bury(self) -> None:
        """Let go of what has lost its owner. Call it between renders only."""
        if not self._unused:
            return
        while self._unused:
            self._held.pop(self._unused.pop(), None)
        gc.collect()  # Mitsuba's Python objects form cycles; they have to go now, not during a later render
        self.changes += 1


_population = _Population()


class MitsubaScene:
    """Renders one scene at one size.

    Attributes:
        assembly: turns the inputs of a space into those of this scene.
        names: every input that can be set.
        interior: those that the interior adjoint differentiates correctly.

    Args:
        description: what to build.
        resolution: (height, width) in pixels.
        filter: reconstruction filter, "box" or "gaussian".
        freeze: record primal renders once and replay them (`dr.freeze`); off only to measure what it brings.
        max_depth: longest light path in segments.
        sampler: Mitsuba's name of the sampler; some round sample counts up, see `advsearch.api.measuring`.
        integrator: Mitsuba's name of the path integrator of primal renders, where there is no medium.
    """

    def __init__(
        self,
        description: SceneDescription,
        resolution: tuple[int, int],
        *,
        filter: str = "box",
        freeze: bool = True,
        max_depth: int = MAX_DEPTH,
        sampler: str = "independent",
        integrator: str = "prb",
    ) -> None:
        mi = mitsuba()
        self._made = (description, resolution, filter, freeze)
        self.resolution = resolution
        self.assembly = Assembly(description)
        self.max_depth = max_depth
        self._freeze = freeze and not description.thin_lens  # Dr.Jit cannot record Mitsuba's thin lens
        self._backdrop = description.backdrop
        object_part = MeshPart(
            "object",
            description.object.mesh,
            object_to_world(description),
            description.object.base_color,
            description.material,
        )
        parts = (object_part, *description.parts)
        self.volumetric = any(part.volumetric for part in parts)
        plugins = _scene_dict(description, resolution, filter)
        plugins["camera"]["sampler"] = {"type": sampler}
        for part in parts:
            plugins |= part.plugins()
            plugins["camera"] |= part.sensor()
        self._path: dict[str, Any] = {"type": integrator}
        for part in parts:
            self._path |= part.integrator(plugins)
        self._scene = mi.load_dict(plugins, optimize=False)
        self._sensor = self._scene.sensors()[0]
        self._parameters = mi.traverse(self._scene)
        self._integrators: dict[str, Any] = {}
        declared = [*_camera_inputs(resolution), ENVIRONMENT_INPUT, *(one for part in parts for one in part.inputs())]
        self._inputs = {one.name: (key, one) for one in declared if (key := _key(self._parameters, one.key))}
        self.names = frozenset(self._inputs)
        self.interior = frozenset(name for name, (_, one) in self._inputs.items() if one.interior)
        self._shapes = frozenset(name for name, (key, _) in self._inputs.items() if _is_of_a_shape(key))
        self._unsettled: set[str] = set()
        self._base: dict[str, Any] = {}
        self._applied: dict[str, Tensor] = {}
        self._recorded: dict[tuple[str, int], Callable[..., Any]] = {}
        self._recorded_at = (0, 0)
        _population.bury()
        _population.add(self, self._scene, self._integrators, self._parameters)

    def like(self, **changes: Any) -> MitsubaScene:
        """Return another scene made as this one was, but with another `max_depth`, `sampler` or `integrator`."""
        description, resolution, filter, freeze = self._made
        settings = {"max_depth": self.max_depth, **changes}
        other = MitsubaScene(description, resolution, filter=filter, freeze=freeze, **settings)
        for what in ("path", "guides"):
            other._integrator(what)  # one that comes later makes the recordings of all scenes stale
        return other

    def base(self, name: str) -> Tensor:
        """Return the base value of an input, as a fresh torch tensor of the input's shape."""
        key, one = self._inputs[name]
        self._apply({})
        value = _torch(self._parameters[key])
        return value if one.shape is None else value.reshape(one.shape)

    def radiance(self, inputs: Mapping[str, Tensor], seed: int, spp: int, *, hide: bool = False) -> Tensor:
        """Render linear radiance with `spp` independent samples a pixel.

        Args:
            inputs: what differs from the base values.
            seed: number of the noise.
            spp: samples a pixel.
            hide: leave out what the environment shows directly, for a backdrop.

        Returns:
            (H, W, 3) float32; (H, W, 4) with the coverage of the scene's surfaces where the scene has a backdrop.
        """
        self._apply(inputs)
        return self._render("hidden" if hide else "path", seed, spp)

    def guides(self, inputs: Mapping[str, Tensor], seed: int, spp: int) -> tuple[Tensor, Tensor]:
        """Render what guides the denoiser: first-hit albedo and shading normal, each (H, W, 3) float32."""
        self._apply(inputs)
        both = self._render("guides", seed, spp)[..., -6:]
        return both[..., :3].clamp(0.0, 1.0), both[..., 3:6]

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
        """Return the gradient of `sum(cotangent * radiance)` with respect to named inputs.

        Args:
            inputs: as in `radiance`.
            cotangent: (H, W, 3) float32.
            seed: should differ from the primal's, or the gradient of a noisy picture is returned.
            spp: independent samples a pixel.
            wrt: the inputs whose gradients are wanted; None means all that are named.
            method: "path", the interior adjoint (path replay backpropagation, Vicini et al. 2021), unbiased for inputs
                that do not move silhouettes; "hidden", the same without the visible environment; "boundary", Mitsuba's
                projective integrator without guiding (Zhang et al. 2023), for vertices too.

        Returns:
            For each of `wrt` a float32 tensor of the input's shape.
        """
        mi = mitsuba()
        import drjit as dr

        self._apply(inputs)
        wanted = tuple(inputs if wrt is None else wrt)
        tracked = {name: mi.TensorXf(_contiguous(inputs[name])) for name in wanted}
        try:
            for name, value in tracked.items():
                dr.enable_grad(value)
                self._write(name, value)
            self._parameters.update()
            shown = _contiguous(cotangent)
            if self._backdrop:
                shown = torch.cat([shown, torch.zeros_like(shown[..., :1])], dim=-1)
            arriving = mi.TensorXf(shown)
            with _fewer_warnings():
                self._integrator(method).render_backward(
                    self._scene, self._parameters, arriving, sensor=self._sensor, seed=seed, spp=spp
                )
            return {name: _torch(dr.grad(value)).reshape(inputs[name].shape) for name, value in tracked.items()}
        finally:
            for name in wanted:
                self._write(name, mi.TensorXf(_contiguous(inputs[name])))
            self._parameters.update()

    def material_adjoint(
        self, inputs: Mapping[str, Tensor], cotangent: Tensor, seed: int, spp: int, *, meshes: Collection[str]
    ) -> dict[str, Tensor]:
        """Return the gradient with respect to the vertices and normals of some meshes, by the material form.

        Args:
            inputs: as in `radiance`; has `NAME.vertices` and `NAME.normals` of each mesh.
            cotangent: (H, W, 3) float32.
            seed: as in `adjoint`.
            spp: samples a pixel of the interior term.
            meshes: names of the meshes.
        """
        from advsearch.scene.material_form import material_adjoint

        self._apply(inputs)
        names = list(meshes)
        by_vertices, by_normals = material_adjoint(
            self._scene,
            self._sensor,
            self._parameters,
            mesh_key=names,
            vertices=[inputs[f"{name}.vertices"] for name in names],
            normals=[inputs[f"{name}.normals"] for name in names],
            cotangent=cotangent,
            seed=seed,
            spp=spp,
            max_depth=self.max_depth,
            shadow_spp=SHADOW_SPP,
        )
        _population.changes += 1  # the first call loads integrators of its own
        found = {f"{name}.vertices": one for name, one in zip(names, by_vertices, strict=True)}
        return found | {f"{name}.normals": one for name, one in zip(names, by_normals, strict=True)}

    # ---- inside -----------------------------------------------------------------------------------------------------

    def _apply(self, inputs: Mapping[str, Tensor]) -> None:
        """Set exactly these inputs, everything else at its base value; does nothing for what is set already."""
        mi = mitsuba()

        unknown = [name for name in inputs if name not in self._inputs]
        if unknown:
            raise InputError(f"the scene has no input {', '.join(unknown)}; it has {', '.join(sorted(self._inputs))}")
        changed: set[str] = set()
        for name in [name for name in self._applied if name not in inputs]:
            self._parameters[self._inputs[name][0]] = type(self._base[name])(self._base[name])
            del self._applied[name]
            changed.add(name)
        for name, tensor in inputs.items():
            value = _contiguous(tensor)
            held = self._applied.get(name)
            if held is not None and held.shape == value.shape and torch.equal(held, value):
                continue
            if name not in self._base:
                own = self._parameters[self._inputs[name][0]]
                self._base[name] = type(own)(own)
            self._write(name, mi.TensorXf(value))
            self._applied[name] = value.clone()
            changed.add(name)
        if changed:
            self._parameters.update()
        if not changed.isdisjoint(self._shapes):
            self._unsettled = {"path", "hidden", "guides"}
            _population.changes += 1

    def _write(self, name: str, value: Any) -> None:
        key, one = self._inputs[name]
        self._parameters[key] = one.write(value)

    def _integrator(self, method: str) -> Any:
        """Return the integrator of one method, made on first use."""
        if method not in self._integrators:
            mi = mitsuba()
            path = {"type": "prb", "max_depth": self.max_depth, "rr_depth": NO_ROULETTE, **self._path}
            recipes: dict[str, dict[str, Any]] = {
                "path": path,
                "hidden": {**path, "hide_emitters": True},
                "guides": {"type": "aov", "aovs": "albedo:albedo,normal:sh_normal"},
                "boundary": {
                    "type": "prb_projective",
                    "max_depth": self.max_depth,
                    "rr_depth": NO_ROULETTE,
                    "guiding": "none",
                },
                "guided": {"type": "prb_projective", "max_depth": self.max_depth, "rr_depth": NO_ROULETTE},
            }
            self._integrators[method] = mi.load_dict(recipes[method])
            _population.changes += 1
        return self._integrators[method]

    def _render(self, what: str, seed: int, spp: int) -> Tensor:
        mi = mitsuba()
        import drjit as dr

        def record(scene: Any, sensor: Any, integrator: Any, seed: Any) -> Any:
            image = integrator.render(scene, sensor=sensor, seed=seed, spp=spp, develop=True, evaluate=False)
            sensor.sampler().seed(0, 1)  # otherwise the sampler's state keeps the whole render alive
            return image

        integrator = self._integrator(what)
        function = self._function(what, spp, record)
        return _torch(function(self._scene, self._sensor, integrator, dr.opaque(mi.UInt32, seed)))

    def _function(self, what: str, spp: int, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return the recorded function for one job at one sample count, recording it on first use.

        Only primal renders are recorded. Dr.Jit 1.5.0 corrupts memory when it replays some adjoints (a texture of
        32 x 32 under a film of 32 x 32 pixels, say), and the gain there is small. A recording made before a shape
        moved renders something else (measured: wrong from the third pose on), so that every move makes all of them
        stale, and the first render after a move is not recorded: in a search over poses none would be replayed.
        """
        import drjit as dr

        _population.bury()
        now = (_population.changes, dr.thread_count())  # a recording crashes in another thread pool
        if self._recorded_at != now:
            self._recorded.clear()
            self._recorded_at = now
        if not self._freeze or what in self._unsettled:
            self._unsettled.discard(what)
            return function
        if (what, spp) not in self._recorded:
            self._recorded[what, spp] = dr.freeze(function)
        return self._recorded[what, spp]


@contextmanager
def _fewer_warnings() -> Iterator[None]:
    """Keep Mitsuba from advising a film that samples beyond its border, at every call."""
    mi = mitsuba()
    before = mi.log_level()
    mi.set_log_level(mi.LogLevel.Error)
    try:
        yield
    finally:
        mi.set_log_level(before)


def _contiguous(tensor: Tensor) -> Tensor:
    return tensor.detach().to(torch.float32).contiguous()


def _torch(value: Any) -> Tensor:
    """Return a Dr.Jit value as a torch tensor with memory of its own."""
    value = getattr(value, "matrix", value)
    if hasattr(value, "torch"):
        tensor: Tensor = value.torch()
        return tensor.clone()
    return torch.tensor(np.array(value, dtype=np.float32))


def _is_of_a_shape(key: str) -> bool:
    """Whether a change of this Mitsuba parameter moves a shape, so that ray tracing is set up anew."""
    return key.endswith(("vertex_positions", "vertex_normals")) or (
        key.endswith("to_world") and not key.startswith(("camera", "environment"))
    )


def _key(parameters: Any, pattern: str) -> str | None:
    """Return the parameter that a pattern with at most one "*" means, or None if the scene has none such.

    Raises:
        RuntimeError: there are several.
    """
    before, star, after = pattern.partition("*")
    found = [
        key for key in parameters.keys() if (key.startswith(before) and key.endswith(after) if star else key == pattern)
    ]
    if len(found) > 1:
        raise RuntimeError(f"expected one Mitsuba parameter {pattern}, found {found}")
    return str(found[0]) if found else None


def _scene_dict(description: SceneDescription, resolution: tuple[int, int], filter: str) -> dict[str, Any]:
    """Everything but the object and the parts."""
    mi = mitsuba()
    place = mi.ScalarTransform4f
    number = description.number
    scene: dict[str, Any] = {
        "type": "scene",
        "camera": _camera(description, resolution, filter),
        "environment": {
            "type": "envmap",
            "bitmap": mi.Bitmap(np.ascontiguousarray(description.environment.radiance, dtype=np.float32)),
            "scale": 2.0 ** number("environment.exposure"),
            "to_world": place().rotate([0, 0, 1], number("environment.rotation")).rotate([1, 0, 0], 90),
        },
    }
    if number("ground.size") > 0.0:
        color = [number(f"ground.{channel}") for channel in ("red", "green", "blue")]
        reflectance = srgb_to_linear(np.array(color, np.float32)).tolist()
        scene["ground"] = {
            "type": "rectangle",
            "to_world": place().scale(number("ground.size") / 2.0),
            "bsdf": {
                "type": "twosided",
                "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": reflectance}},
            },
        }
    return scene


def _camera(description: SceneDescription, resolution: tuple[int, int], filter: str) -> dict[str, Any]:
    height, width = resolution
    camera: dict[str, Any] = {
        "type": "thinlens" if description.thin_lens else "perspective",
        "fov": description.number("camera.fov"),
        "fov_axis": "larger",
        "near_clip": 0.01,
        "far_clip": 1e5,
        "to_world": mitsuba().ScalarTransform4f(camera_to_world(description, width / height)),
        "film": {
            "type": "hdrfilm",
            "width": width,
            "height": height,
            "pixel_format": "rgba" if description.backdrop else "rgb",
            "component_format": "float32",
            "rfilter": {"type": filter},
        },
        "sampler": {"type": "independent"},
    }
    if description.thin_lens:
        camera |= {"aperture_radius": 1e-4, "focus_distance": 1.0}
    return camera


def _camera_inputs(resolution: tuple[int, int]) -> tuple[PartInput, ...]:
    """The camera's inputs. Our field of view is along the larger side, Mitsuba's parameter along the width."""
    height, width = resolution

    def along_width(value: Any) -> Any:
        import drjit as dr

        half = dr.deg2rad(value.array) / 2.0
        return mitsuba().Float(2.0 * dr.rad2deg(dr.atan(dr.tan(half) * min(1.0, width / height))))

    return (
        PartInput("camera.to_world", "camera.to_world", transform, shape=(4, 4)),
        PartInput("camera.fov", "camera.x_fov", along_width, shape=(1,)),
        PartInput("camera.shift_x", "camera.principal_point_offset_x", number, shape=(1,)),
        PartInput("camera.shift_y", "camera.principal_point_offset_y", number, shape=(1,)),
        PartInput("camera.aperture", "camera.aperture_radius", number, shape=(1,)),
        PartInput("camera.focus", "camera.focus_distance", number, shape=(1,)),
    )
