"""Pictures of a scene by Cycles, Blender's path tracer, in a process of Blender's own
that reads the scene as glTF.

It is the same scene in other words, not the same picture: textures have 8 bits,
surfaces are Blender's, round lamps are faceted, and light is sampled in Cycles' way.
"""

from __future__ import annotations

import json
import math
import subprocess
import tempfile
import time
import weakref
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenEXR
import torch
from torch import Tensor

from advsearch.extend import (
    SceneDescription,
    assets,
    color,
    errors,
    geometry,
    parts,
    stored_files,
    workbench,
)

LONGEST = 300  # seconds that one picture may take, the start included, before `scaled`
MATT = assets.Material(roughness=1.0, metallic=0.0, specular=0.0)  # of the ground
PAUSE = 0.02  # seconds between looks at whether a picture is there

RENDER = """
import json, math, os, sys
import bpy
from mathutils import Matrix
folder = sys.argv[-1]
with open(os.path.join(folder, "scene.json")) as file:
    told = json.load(file)
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.import_scene.gltf(filepath=os.path.join(folder, "scene.glb"))
scene = bpy.context.scene
def put(name, data, matrix):
    found = bpy.data.objects.new(name, data)
    found.matrix_world = Matrix(matrix)
    scene.collection.objects.link(found)
    return found
camera = bpy.data.cameras.new("camera")
camera.sensor_fit, camera.angle, camera.clip_start, camera.clip_end = "AUTO", told["fov"], 0.01, 1e5
camera.shift_x, camera.shift_y = told["shift"]
scene.camera = put("camera", camera, told["camera"])
for one in told["lamps"]:
    strength = max(one["color"]) or 1.0
    color = [value / strength for value in one["color"]]
    if one["ball"] is None:
        lamp = bpy.data.lights.new("lamp", "POINT")
        lamp.energy, lamp.color, lamp.shadow_soft_size = 4.0 * math.pi * strength, color, 0.0
        put("lamp", lamp, one["place"])
        continue
    bpy.ops.mesh.primitive_uv_sphere_add(segments=64, ring_count=32, radius=1.0)
    ball = bpy.context.object
    ball.matrix_world, ball.visible_shadow = Matrix(one["ball"]), False
    bpy.ops.object.shade_smooth()
    material = bpy.data.materials.new("lamp")
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    glow, out = nodes.new("ShaderNodeEmission"), nodes.new("ShaderNodeOutputMaterial")
    side, front = nodes.new("ShaderNodeNewGeometry"), nodes.new("ShaderNodeMath")  # a ball that throws no shadow
    front.operation, front.inputs[1].default_value = "LESS_THAN", 0.5               # would show its inside too
    links.new(side.outputs["Backfacing"], front.inputs[0])
    power = nodes.new("ShaderNodeMath")
    power.operation, power.inputs[1].default_value = "MULTIPLY", strength
    links.new(front.outputs[0], power.inputs[0])
    links.new(power.outputs[0], glow.inputs["Strength"])
    glow.inputs["Color"].default_value = (*color, 1.0)
    links.new(glow.outputs[0], out.inputs["Surface"])
    ball.data.materials.append(material)
world = bpy.data.worlds.new("world")
scene.world = world
world.use_nodes = True
nodes, links = world.node_tree.nodes, world.node_tree.links
nodes.clear()
back, out = nodes.new("ShaderNodeBackground"), nodes.new("ShaderNodeOutputWorld")
back.inputs["Color"].default_value = (0.0, 0.0, 0.0, 1.0)
links.new(back.outputs[0], out.inputs["Surface"])
if told["environment"]:
    image = bpy.data.images.load(os.path.join(folder, "environment.exr"))
    image.colorspace_settings.name = "Linear Rec.709"
    texture, turn = nodes.new("ShaderNodeTexEnvironment"), nodes.new("ShaderNodeMapping")
    texture.image, turn.vector_type = image, "POINT"
    turn.inputs["Rotation"].default_value = (0.0, 0.0, told["turn"])
    links.new(nodes.new("ShaderNodeTexCoord").outputs["Generated"], turn.inputs["Vector"])
    links.new(turn.outputs[0], texture.inputs["Vector"])
    links.new(texture.outputs["Color"], back.inputs["Color"])
    back.inputs["Strength"].default_value = told["strength"]
render, cycles = scene.render, scene.cycles
render.engine, render.resolution_x, render.resolution_y = "CYCLES", told["width"], told["height"]
render.resolution_percentage, render.use_file_extension, render.use_compositing = 100, False, False
render.image_settings.file_format, render.image_settings.color_depth = "OPEN_EXR", "32"
cycles.device, cycles.pixel_filter_type, cycles.filter_width = "CPU", "BOX", 1.0
cycles.use_adaptive_sampling, cycles.use_denoising = False, told["denoise"]
cycles.sample_clamp_direct = cycles.sample_clamp_indirect = cycles.blur_glossy = 0.0
for kind in ("max_bounces", "diffuse_bounces", "glossy_bounces", "transmission_bounces"):
    setattr(cycles, kind, told["bounces"])
for line in sys.stdin:
    seed, cycles.samples, name = (int(part) for part in line.split())
    cycles.seed = seed % 2 ** 31
    path = os.path.join(folder, str(name))
    render.filepath = path + ".part"
    bpy.ops.render.render(write_still=True)
    os.replace(path + ".part", path + ".exr")
"""


class BlenderError(Exception):
    """Blender is not there, cannot show a scene, or stopped."""


class Cycles:
    """Renders the configurations of one scene at a size (height, width) by Cycles, with
    light paths of at most so many segments, and with Blender's Open Image Denoise or
    without. Raises BlenderError: there is no Blender, or the scene has what is not
    carried over.
    """

    def __init__(
        self,
        description: SceneDescription,
        size: tuple[int, int],
        *,
        max_depth: int,
        denoise: bool,
    ) -> None:
        try:
            self._command = workbench.find_blender(
                "Blender's Cycles has to render it", "leave `ways=blender` out"
            )
        except errors.FileFormatError as error:
            raise BlenderError(str(error)) from None
        known = (parts.MeshPart, parts.PointLamp, parts.BallLamp)
        unknown = [
            part.name for part in description.parts if not isinstance(part, known)
        ]
        own = [name for name, mesh in description.meshes.items() if mesh.surface]
        unknown += [f"a surface of Mitsuba's own on the {name}" for name in own]
        unknown += (
            ["a lens"] if description.thin_lens or description.camera_model else []
        )
        unknown += ["a plain background"] if description.backdrop else []
        if unknown:
            raise BlenderError(
                f"the scene has {', '.join(unknown[:5])}, which is not "
                "carried over to Blender"
            )
        self._description = description
        self._resolution = size
        self._depth = max_depth
        self._denoise = denoise
        self._held: dict[str, Tensor] = {}
        self._process: _Process | None = None

    def radiance(self, inputs: Mapping[str, Tensor], seed: int, spp: int) -> Tensor:
        """Render linear radiance (H, W, 3), as `MitsubaScene.radiance`. Raises
        BlenderError: Blender stopped, or took too long.
        """
        held = self._held
        same = held.keys() == inputs.keys() and all(
            torch.equal(held[name], inputs[name]) for name in inputs
        )
        if self._process is None or not same:
            self._process = None
            self._process = _Process(self._command, *self._told(inputs))
            self._held = {
                name: value.detach().clone() for name, value in inputs.items()
            }
        return self._process.picture(seed, spp)

    def _told(
        self, inputs: Mapping[str, Tensor]
    ) -> tuple[dict[str, object], bytes, np.ndarray | None]:
        scene = self._description
        (height, width) = self._resolution
        values = {name: value.detach().cpu() for name, value in inputs.items()}
        meshes = [workbench.posed(part, values) for part in scene.meshes.values()]
        meshes += _ground(scene, values.get("ground.reflectance"))
        pose = values.get(
            "camera.to_world",
            torch.from_numpy(geometry.camera_to_world(scene, width / height)),
        )
        camera = pose.double().numpy()
        fov = float(
            values.get("camera.fov", torch.tensor([scene.number("camera.fov")]))[0]
        )
        shift = [
            float(values.get(f"camera.shift_{axis}", torch.zeros(1))[0])
            for axis in "xy"
        ]
        lamps: list[dict[str, object]] = []
        for lamp in scene.lamps.values():
            place = np.eye(4)
            shape = list[list[float]]()
            if isinstance(lamp, parts.BallLamp):
                ball = assets.pose_of(lamp.radius * np.eye(3), lamp.place)
                shape = (
                    values.get(f"{lamp.name}.ball", torch.from_numpy(ball))
                    .double()
                    .tolist()
                )
                color = values.get(f"{lamp.name}.radiance", torch.tensor(lamp.radiance))
            else:
                assert isinstance(lamp, parts.PointLamp)  # others are refused before
                place[:3, 3] = values.get(
                    f"{lamp.name}.position", torch.tensor(lamp.position)
                ).numpy()
                color = values.get(
                    f"{lamp.name}.intensity", torch.tensor(lamp.intensity)
                )
            if bool((color > 0.0).any()):
                lamps.append(
                    {
                        "ball": shape or None,
                        "place": place.tolist(),
                        "color": color.tolist(),
                    }
                )
        radiance = (
            None
            if scene.environment is None
            else np.asarray(scene.environment.radiance, np.float32)
        )
        if "environment.padded" in values:
            radiance = values["environment.padded"][:, 1:-1].numpy()
        message: dict[str, object] = {
            "width": width,
            "height": height,
            # Blender's look along their own -z
            "camera": (camera @ np.diag([-1.0, 1.0, -1.0, 1.0])).tolist(),
            "fov": math.radians(fov),
            "shift": [
                shift[0] * width / max(width, height),
                -shift[1] * height / max(width, height),
            ],
            "lamps": lamps,
            "environment": radiance is not None,
            "turn": math.pi / 2.0 - math.radians(scene.number("environment.rotation")),
            "strength": 2.0 ** scene.number("environment.exposure"),
            "bounces": max(0, self._depth - 2),
            "denoise": self._denoise,
        }
        return (
            message,
            workbench.glb([_turn_for_blender(mesh) for mesh in meshes]),
            radiance,
        )


def _turn_for_blender(shape: assets.Shape) -> assets.Shape:
    """Return a mesh turned so that Blender, for which the front of a glTF file is -y,
    has our axes.
    """
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], np.float32)
    mesh = shape.mesh
    turned = replace(
        mesh, vertices=mesh.vertices @ turn.T, normals=mesh.normals @ turn.T
    )
    return replace(shape, mesh=turned)


def _ground(scene: SceneDescription, reflectance: Tensor | None) -> list[assets.Shape]:
    photograph = scene.photograph
    if photograph is not None:
        shown = photograph.base if reflectance is None else reflectance
        return [
            assets.Shape(
                "ground",
                photograph.mesh,
                color.linear_to_srgb(shown.clamp(0.0, 1.0)).numpy(),
                MATT,
            )
        ]
    half = np.float32(scene.number("ground.size") / 2.0)
    if half <= 0.0 or workbench.paved(scene):
        return []
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)
    up = np.tile(np.array([[0, 0, 1]], np.float32), (4, 1))
    mesh = assets.Mesh(
        corners * half, faces, up, corners[:, :2] * np.float32(0.5) + np.float32(0.5)
    )
    return [
        assets.Shape(
            "ground", mesh, np.full((1, 1, 3), scene.ground_color, np.float32), MATT
        )
    ]


class _Process:
    """Blender with one configuration."""

    def __init__(
        self,
        program: list[str],
        told: dict[str, object],
        meshes: bytes,
        radiance: np.ndarray | None,
    ) -> None:
        self._keeper = tempfile.TemporaryDirectory(prefix="advsearch-cycles-")
        self._folder = Path(self._keeper.name)
        self._count = 0
        (self._folder / "scene.json").write_text(json.dumps(told), "utf-8")
        (self._folder / "scene.glb").write_bytes(meshes)
        (self._folder / "render.py").write_text(RENDER, "utf-8")
        if radiance is not None:
            with OpenEXR.File({}, {"RGB": np.ascontiguousarray(radiance)}) as picture:
                picture.write(str(self._folder / "environment.exr"))
        between = [] if "-I" in program else ["--"]
        self._said = self._folder / "said.txt"
        with self._said.open("wb") as said:
            try:
                self._process = subprocess.Popen(
                    [
                        *program,
                        str(self._folder / "render.py"),
                        *between,
                        str(self._folder),
                    ],
                    cwd=self._folder,
                    env=workbench.surroundings(str(self._folder)),
                    stdin=subprocess.PIPE,
                    stdout=said,
                    stderr=said,
                )
            except OSError as error:
                raise BlenderError(
                    f"Blender can't be started ({error.strerror}); check {program[0]}"
                ) from error
        weakref.finalize(self, _end, self._process, self._keeper)

    def picture(self, seed: int, spp: int) -> Tensor:
        """One picture with its own noise, (H, W, 3)."""
        self._count += 1
        path = self._folder / f"{self._count}.exr"
        until = time.monotonic() + stored_files.scaled(LONGEST)
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(f"{seed} {spp} {self._count}\n".encode())
            self._process.stdin.flush()
        except OSError:
            pass  # it has stopped, which is words below
        while not path.is_file():
            if self._process.poll() is not None and not path.is_file():
                words = workbench.last_line(self._said.read_text("utf-8", "replace"))
                raise BlenderError(f"Blender stopped{words}")
            if time.monotonic() > until:
                raise BlenderError(
                    "Blender had not rendered it after "
                    f"{stored_files.scaled(LONGEST)} seconds"
                )
            time.sleep(PAUSE)
        with OpenEXR.File(str(path)) as picture:
            pixels = next(iter(picture.channels().values())).pixels
            radiance = torch.from_numpy(np.array(pixels[..., :3], dtype=np.float32))
        path.unlink()
        return radiance


def _end(
    process: subprocess.Popen[bytes], keeper: tempfile.TemporaryDirectory[str]
) -> None:
    process.kill()
    process.wait()
    if process.stdin is not None:
        process.stdin.close()
    keeper.cleanup()
