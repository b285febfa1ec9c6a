"""A described scene inside Mitsuba: built once, changed only through named inputs, rendered and differentiated.

Inputs are torch tensors with names of ours (`object.base_color`), so that nothing outside this file knows Mitsuba's
parameter paths. Every call states all inputs it wants changed; those it does not name have their base values, so that
no configuration is ever applied on top of another.
"""

from __future__ import annotations

import gc
import weakref
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from advsearch.scene.assets import Mesh
from advsearch.scene.backend import mitsuba
from advsearch.scene.color import srgb_to_linear
from advsearch.scene.description import SceneDescription
from advsearch.scene.geometry import camera_to_world, object_to_world

MAX_DEPTH = 6
"""Longest light path in segments: five bounces off surfaces."""
NO_ROULETTE = 1000
"""Russian roulette never starts: it adds noise, and paths are short already."""

BASE_COLOR = "object.base_color"
"""Input: (h, w, 3) linear reflectance of the object, row 0 at v = 1 (top of the image)."""


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

    Args:
        description: what to build.
        resolution: (height, width) in pixels.
        filter: reconstruction filter, "box" or "gaussian".
        freeze: record primal renders once and replay them (`dr.freeze`); off only to measure what it brings.
        max_depth: longest light path in segments.
    """

    def __init__(
        self,
        description: SceneDescription,
        resolution: tuple[int, int],
        *,
        filter: str = "box",
        freeze: bool = True,
        max_depth: int = MAX_DEPTH,
    ) -> None:
        mi = mitsuba()
        self.resolution = resolution
        self._freeze = freeze
        self._scene = mi.load_dict(_scene_dict(description, resolution, filter), optimize=False)
        self._sensor = self._scene.sensors()[0]
        self._path = mi.load_dict({"type": "prb", "max_depth": max_depth, "rr_depth": NO_ROULETTE})
        self._guides = mi.load_dict({"type": "aov", "aovs": "albedo:albedo,normal:sh_normal"})
        self._parameters = mi.traverse(self._scene)
        self._keys = {BASE_COLOR: _only(self._parameters, "object.", ".base_color.data")}
        self._base = {name: mi.TensorXf(self._parameters[key]) for name, key in self._keys.items()}
        self._applied: dict[str, tuple[Tensor, int]] = {}
        self._recorded: dict[tuple[str, int], Callable[..., Any]] = {}
        self._recorded_at = 0
        _population.bury()
        _population.add(self, self._scene, self._path, self._guides, self._parameters)

    def base(self, name: str) -> Tensor:
        """Return the base value of an input, as a fresh torch tensor."""
        return _torch(self._base[name])

    def radiance(self, inputs: Mapping[str, Tensor], seed: int, spp: int) -> Tensor:
        """Render linear radiance, (H, W, 3) float32, with `spp` independent samples a pixel."""
        self._apply(inputs)
        return self._render("path", self._path, seed, spp)

    def guides(self, inputs: Mapping[str, Tensor], seed: int, spp: int) -> tuple[Tensor, Tensor]:
        """Render what guides the denoiser: first-hit albedo and shading normal, each (H, W, 3) float32."""
        self._apply(inputs)
        both = self._render("guides", self._guides, seed, spp)
        return both[..., :3].clamp(0.0, 1.0), both[..., 3:6]

    def adjoint(self, inputs: Mapping[str, Tensor], cotangent: Tensor, seed: int, spp: int) -> dict[str, Tensor]:
        """Return the gradient of `sum(cotangent * radiance)` with respect to every named input.

        Path replay backpropagation (Vicini et al. 2021): unbiased for inputs that do not move silhouettes.

        Args:
            inputs: as in `radiance`; the gradient has one tensor of the same shape for each.
            cotangent: (H, W, 3) float32.
            seed: should differ from the primal's, or the gradient of a noisy picture is returned.
            spp: independent samples a pixel.
        """
        mi = mitsuba()
        import drjit as dr

        self._apply(inputs)
        tracked = {name: mi.TensorXf(_contiguous(tensor)) for name, tensor in inputs.items()}
        for name, value in tracked.items():
            dr.enable_grad(value)
            self._parameters[self._keys[name]] = value
        self._parameters.update()
        arriving = mi.TensorXf(_contiguous(cotangent))
        self._path.render_backward(self._scene, self._parameters, arriving, sensor=self._sensor, seed=seed, spp=spp)
        gradients = {name: _torch(dr.grad(value)) for name, value in tracked.items()}
        for name, value in tracked.items():
            self._parameters[self._keys[name]] = dr.detach(value)
        self._parameters.update()
        return gradients

    # ---- inside -----------------------------------------------------------------------------------------------------

    def _apply(self, inputs: Mapping[str, Tensor]) -> None:
        """Set exactly these inputs, everything else at its base value; does nothing for what is set already."""
        mi = mitsuba()
        changed = False
        for name, key in self._keys.items():
            tensor = inputs.get(name)
            if tensor is None:
                if self._applied.pop(name, None) is not None:
                    self._parameters[key] = mi.TensorXf(self._base[name])
                    changed = True
                continue
            held = self._applied.get(name)
            if held is not None and held[0] is tensor and held[1] == tensor._version:
                continue
            self._parameters[key] = mi.TensorXf(_contiguous(tensor))
            self._applied[name] = (tensor, tensor._version)
            changed = True
        if changed:
            self._parameters.update()

    def _render(self, what: str, integrator: Any, seed: int, spp: int) -> Tensor:
        mi = mitsuba()
        import drjit as dr

        def record(scene: Any, sensor: Any, integrator: Any, seed: Any) -> Any:
            image = integrator.render(scene, sensor=sensor, seed=seed, spp=spp, develop=True, evaluate=False)
            sensor.sampler().seed(0, 1)  # otherwise the sampler's state keeps the whole render alive
            return image

        function = self._function(what, spp, record)
        return _torch(function(self._scene, self._sensor, integrator, dr.opaque(mi.UInt32, seed)))

    def _function(self, what: str, spp: int, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return the recorded function for one job at one sample count, recording it on first use.

        Only primal renders are recorded. Dr.Jit 1.5.0 corrupts memory when it replays some adjoints (a texture of
        32 x 32 under a film of 32 x 32 pixels, say), and the gain there is small.
        """
        import drjit as dr

        _population.bury()
        if self._recorded_at != _population.changes:
            self._recorded.clear()
            self._recorded_at = _population.changes
        if not self._freeze:
            return function
        if (what, spp) not in self._recorded:
            self._recorded[what, spp] = dr.freeze(function)
        return self._recorded[what, spp]


def _contiguous(tensor: Tensor) -> Tensor:
    return tensor.detach().to(torch.float32).contiguous()


def _torch(value: Any) -> Tensor:
    """Return a Dr.Jit tensor as a torch tensor with memory of its own."""
    tensor: Tensor = value.torch()
    return tensor.clone()


def _only(parameters: Any, prefix: str, suffix: str) -> str:
    found = [key for key in parameters.keys() if key.startswith(prefix) and key.endswith(suffix)]
    if len(found) != 1:
        raise RuntimeError(f"expected one Mitsuba parameter {prefix}*{suffix}, found {found}")
    return str(found[0])


def _scene_dict(description: SceneDescription, resolution: tuple[int, int], filter: str) -> dict[str, Any]:
    mi = mitsuba()
    transform = mi.ScalarTransform4f
    height, width = resolution
    number = description.number
    scene: dict[str, Any] = {
        "type": "scene",
        "sensor": {
            "type": "perspective",
            "fov": number("camera.fov"),
            "fov_axis": "larger",
            "near_clip": 0.01,
            "far_clip": 1e5,
            "to_world": transform(camera_to_world(description, width / height)),
            "film": {
                "type": "hdrfilm",
                "width": width,
                "height": height,
                "pixel_format": "rgb",
                "component_format": "float32",
                "rfilter": {"type": filter},
            },
            "sampler": {"type": "independent"},
        },
        "environment": {
            "type": "envmap",
            "bitmap": mi.Bitmap(np.ascontiguousarray(description.environment.radiance, dtype=np.float32)),
            "scale": 2.0 ** number("environment.exposure"),
            "to_world": transform().rotate([0, 0, 1], number("environment.rotation")).rotate([1, 0, 0], 90),
        },
        "object": mitsuba_mesh("object", description.object.mesh, object_to_world(description), surface(description)),
    }
    if number("ground.size") > 0.0:
        color = [number(f"ground.{channel}") for channel in ("red", "green", "blue")]
        scene["ground"] = {
            "type": "rectangle",
            "to_world": transform().scale(number("ground.size") / 2.0),
            "bsdf": {
                "type": "twosided",
                "bsdf": {
                    "type": "diffuse",
                    "reflectance": {"type": "rgb", "value": srgb_to_linear(np.array(color, np.float32)).tolist()},
                },
            },
        }
    return scene


def surface(description: SceneDescription) -> dict[str, Any]:
    """The object's BSDF: principled, two-sided, with the base colour as a bilinear texture of linear reflectance."""
    mi = mitsuba()
    material = description.material
    linear = srgb_to_linear(description.object.base_color)
    principled: dict[str, Any] = {
        "type": "principled",
        "base_color": {
            "type": "bitmap",
            "bitmap": mi.Bitmap(np.ascontiguousarray(linear, dtype=np.float32)),
            "raw": True,
            "filter_type": "bilinear",
        },
        "roughness": material.roughness,
        "metallic": material.metallic,
        "specular": material.specular,
    }
    if material.clearcoat > 0.0:
        principled["clearcoat"] = material.clearcoat
    return {"type": "twosided", "bsdf": principled}


def mitsuba_mesh(name: str, mesh: Mesh, to_world: Any, bsdf: dict[str, Any]) -> Any:
    """Return a Mitsuba mesh of the given geometry under a pose, with shading normals and texture coordinates.

    Mitsuba's bitmaps have row 0 at v = 0 while ours have it at v = 1, hence the flip.
    """
    mi = mitsuba()
    vertices = mesh.vertices.astype(np.float64) @ to_world[:3, :3].T + to_world[:3, 3]
    normals = mesh.normals.astype(np.float64) @ np.linalg.inv(to_world[:3, :3])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    uvs = np.stack([mesh.uvs[:, 0], 1.0 - mesh.uvs[:, 1]], axis=1)
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(bsdf)
    result = mi.Mesh(
        name,
        vertex_count=len(vertices),
        face_count=len(mesh.faces),
        has_vertex_normals=True,
        has_vertex_texcoords=True,
        props=properties,
    )
    parameters = mi.traverse(result)
    parameters["vertex_positions"] = mi.Float(vertices.astype(np.float32).ravel())
    parameters["vertex_normals"] = mi.Float(normals.astype(np.float32).ravel())
    parameters["vertex_texcoords"] = mi.Float(uvs.astype(np.float32).ravel())
    parameters["faces"] = mi.UInt32(mesh.faces.astype(np.uint32).ravel())
    parameters.update()
    return result
