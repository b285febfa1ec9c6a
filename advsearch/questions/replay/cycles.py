"""Render a scene with Cycles, Blender's path tracer, in a separate process.

Blender reads the scene as glTF, so that images differ in more than noise: textures have
8 bits, materials are those of Blender, and spherical lamps have facets.
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

MAX_RENDER_SECONDS = 300
"""Time limit of one image, including the start of Blender; `stored_files.scale_limit`
adapts it.
"""
POLL_INTERVAL = 0.02
"""Seconds between two checks of whether an image is finished."""
MATT = assets.Material(roughness=1.0, metallic=0.0, specular=0.0)
"""Material of the ground."""

RENDER_SCRIPT = """
import json, math, os, sys
import bpy
from mathutils import Matrix

folder = sys.argv[-1]
with open(os.path.join(folder, "scene.json")) as file:
    settings = json.load(file)
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.import_scene.gltf(filepath=os.path.join(folder, "scene.glb"))
scene = bpy.context.scene


def add_object(name, data, matrix):
    added = bpy.data.objects.new(name, data)
    added.matrix_world = Matrix(matrix)
    scene.collection.objects.link(added)
    return added


def add_point_lamp(lamp):
    strength = max(lamp["color"]) or 1.0
    data = bpy.data.lights.new("lamp", "POINT")
    data.energy = 4.0 * math.pi * strength
    data.color = [value / strength for value in lamp["color"]]
    data.shadow_soft_size = 0.0
    add_object("lamp", data, lamp["to_world"])


def add_ball_lamp(lamp):
    strength = max(lamp["color"]) or 1.0
    color = [value / strength for value in lamp["color"]]
    bpy.ops.mesh.primitive_uv_sphere_add(segments=64, ring_count=32, radius=1.0)
    ball = bpy.context.object
    ball.matrix_world = Matrix(lamp["ball"])
    ball.visible_shadow = False
    bpy.ops.object.shade_smooth()
    material = bpy.data.materials.new("lamp")
    material.use_nodes = True
    nodes = material.node_tree.nodes
    links = material.node_tree.links
    nodes.clear()
    emission = nodes.new("ShaderNodeEmission")
    output = nodes.new("ShaderNodeOutputMaterial")
    # A ball without a shadow would show its inside too: only the front emits.
    geometry = nodes.new("ShaderNodeNewGeometry")
    is_front = nodes.new("ShaderNodeMath")
    is_front.operation = "LESS_THAN"
    is_front.inputs[1].default_value = 0.5
    links.new(geometry.outputs["Backfacing"], is_front.inputs[0])
    power = nodes.new("ShaderNodeMath")
    power.operation = "MULTIPLY"
    power.inputs[1].default_value = strength
    links.new(is_front.outputs[0], power.inputs[0])
    links.new(power.outputs[0], emission.inputs["Strength"])
    emission.inputs["Color"].default_value = (*color, 1.0)
    links.new(emission.outputs[0], output.inputs["Surface"])
    ball.data.materials.append(material)


def add_environment(world):
    nodes = world.node_tree.nodes
    links = world.node_tree.links
    nodes.clear()
    background = nodes.new("ShaderNodeBackground")
    output = nodes.new("ShaderNodeOutputWorld")
    background.inputs["Color"].default_value = (0.0, 0.0, 0.0, 1.0)
    links.new(background.outputs[0], output.inputs["Surface"])
    if not settings["environment"]:
        return
    image = bpy.data.images.load(os.path.join(folder, "environment.exr"))
    image.colorspace_settings.name = "Linear Rec.709"
    texture = nodes.new("ShaderNodeTexEnvironment")
    texture.image = image
    rotation = nodes.new("ShaderNodeMapping")
    rotation.vector_type = "POINT"
    rotation.inputs["Rotation"].default_value = (0.0, 0.0, settings["turn"])
    coordinates = nodes.new("ShaderNodeTexCoord")
    links.new(coordinates.outputs["Generated"], rotation.inputs["Vector"])
    links.new(rotation.outputs[0], texture.inputs["Vector"])
    links.new(texture.outputs["Color"], background.inputs["Color"])
    background.inputs["Strength"].default_value = settings["strength"]


camera = bpy.data.cameras.new("camera")
camera.sensor_fit = "AUTO"
camera.angle = settings["fov"]
camera.clip_start = 0.01
camera.clip_end = 1e5
camera.shift_x, camera.shift_y = settings["shift"]
scene.camera = add_object("camera", camera, settings["camera"])
for lamp in settings["lamps"]:
    if lamp["ball"] is None:
        add_point_lamp(lamp)
    else:
        add_ball_lamp(lamp)
world = bpy.data.worlds.new("world")
scene.world = world
world.use_nodes = True
add_environment(world)

render = scene.render
render.engine = "CYCLES"
render.resolution_x = settings["width"]
render.resolution_y = settings["height"]
render.resolution_percentage = 100
render.use_file_extension = False
render.use_compositing = False
render.image_settings.file_format = "OPEN_EXR"
render.image_settings.color_depth = "32"
cycles = scene.cycles
cycles.device = "CPU"
cycles.pixel_filter_type = "BOX"
cycles.filter_width = 1.0
cycles.use_adaptive_sampling = False
cycles.use_denoising = settings["denoise"]
cycles.sample_clamp_direct = 0.0
cycles.sample_clamp_indirect = 0.0
cycles.blur_glossy = 0.0
for kind in ("max_bounces", "diffuse_bounces", "glossy_bounces", "transmission_bounces"):
    setattr(cycles, kind, settings["bounces"])

for line in sys.stdin:
    seed, samples, name = (int(field) for field in line.split())
    cycles.samples = samples
    cycles.seed = seed % 2 ** 31
    path = os.path.join(folder, str(name))
    render.filepath = path + ".part"
    bpy.ops.render.render(write_still=True)
    os.replace(path + ".part", path + ".exr")
"""
"""Script that Blender runs. It loads the scene, then renders an image for each line of
its standard input.

A line has the seed, the samples per pixel and the number of the image.
"""


# Cameras of Blender look along their -z axis, and ours along +z.
TO_BLENDER_CAMERA = np.diag([-1.0, 1.0, -1.0, 1.0])


class BlenderError(Exception):
    """Blender is not installed, cannot render a scene, or stopped."""


class Cycles:
    """Render the configurations of one scene with Cycles.

    Args:
        description: the scene.
        size: (height, width) of the images in pixels.
        max_depth: segments of the longest light path.
        denoise: whether Blender's Open Image Denoise is applied.

    Raises:
        BlenderError: Blender is not installed, or the scene has parts that cannot be
            transferred.
    """

    def __init__(
        self,
        description: SceneDescription,
        size: tuple[int, int],
        *,
        max_depth: int,
        denoise: bool,
    ) -> None:
        """Find Blender, and check the scene; no process is started yet.

        Args:
            description: the scene.
            size: height and width of the images in pixels.
            max_depth: maximum number of segments of a light path.
            denoise: whether Blender denoises the images.

        Raises:
            BlenderError: Blender is not installed, or the scene has something that
                cannot be exported to Blender.
        """
        self._command = _find_blender_command()
        _check_supported(description)
        self._description = description
        self._resolution = size
        self._depth = max_depth
        self._denoise = denoise
        # inputs of the scene that the process has loaded
        self._inputs: dict[str, Tensor] = {}
        self._process: _Process | None = None

    def radiance(self, inputs: Mapping[str, Tensor], seed: int, spp: int) -> Tensor:
        """Render linear radiance (H, W, 3), as `MitsubaScene.radiance` does.

        A process of Blender is used as long as the inputs stay the same. For other
        inputs a new process is started.

        Raises:
            BlenderError: Blender stopped, or took too long.
        """
        is_same_scene = self._inputs.keys() == inputs.keys() and all(
            torch.equal(self._inputs[name], inputs[name]) for name in inputs
        )
        if self._process is None or not is_same_scene:
            self._process = None  # ends the earlier process of Blender, if there is one
            self._process = _Process(self._command, *self._export(inputs))
            self._inputs = {
                name: value.detach().clone() for name, value in inputs.items()
            }
        return self._process.render(seed, spp)

    def _export(
        self, inputs: Mapping[str, Tensor]
    ) -> tuple[dict[str, object], bytes, np.ndarray | None]:
        """Return the settings for Blender, the meshes as glTF, and the environment.

        The environment is linear radiance (H, W, 3), or None if no map lights the
        scene.

        Args:
            inputs: values of the scene's inputs by name, such as
                "mug.bsdf.reflectance"; they take precedence over the description.
        """
        scene = self._description
        height, width = self._resolution
        values = {name: value.detach().cpu() for name, value in inputs.items()}
        meshes = [workbench.pose_mesh(part, values) for part in scene.meshes.values()]
        meshes += _make_ground(scene, values.get("ground.reflectance"))
        radiance = _get_radiance(scene, values)
        blender_settings = self._make_settings(
            values, width, height, has_environment=radiance is not None
        )
        shapes = [_turn_for_blender(mesh) for mesh in meshes]
        return blender_settings, workbench.encode_glb(shapes), radiance

    def _make_settings(
        self,
        values: Mapping[str, Tensor],
        width: int,
        height: int,
        *,
        has_environment: bool,
    ) -> dict[str, object]:
        """Return what `RENDER_SCRIPT` reads: image size, camera, lamps, environment.

        Args:
            values: the scene's inputs by name; an input that is missing has the value
                of the scene's description.
            width, height: width and height of the image, pixels.
            has_environment: whether an environment map lights the scene.
        """
        scene = self._description
        # Radians. Blender's environment maps are rotated by a quarter turn compared to
        # ours.
        turn = math.pi / 2.0 - math.radians(scene.get_number("environment.rotation"))
        return {
            "width": width,
            "height": height,
            **self._make_camera_settings(values, width, height),
            "lamps": _describe_lamps(scene, values),
            "environment": has_environment,
            "turn": turn,
            # The exposure is in stops: one stop doubles the radiance.
            "strength": 2.0 ** scene.get_number("environment.exposure"),
            # The depth is the number of segments of a path. The two segments from the
            # light to a surface and to the camera are no bounce.
            "bounces": max(0, self._depth - 2),
            "denoise": self._denoise,
        }

    def _make_camera_settings(
        self, values: Mapping[str, Tensor], width: int, height: int
    ) -> dict[str, object]:
        """Return the camera for `RENDER_SCRIPT`.

        Args:
            values: the scene's inputs by name, such as "camera.fov" in degrees. Missing
                ones have the values of the scene's description; a missing shift is 0.
            width, height: width and height of the image in pixels.
        """
        scene = self._description
        to_world = values.get(
            "camera.to_world",
            torch.from_numpy(geometry.camera_to_world(scene, width / height)),
        )
        fov = _get_number(values, "camera.fov", scene.get_number("camera.fov"))
        shift_x = _get_number(values, "camera.shift_x", 0.0)
        shift_y = _get_number(values, "camera.shift_y", 0.0)
        # Our shift is a fraction of the width or the height, and its y axis points
        # down. Blender's is a fraction of the longer side, and its y axis points up.
        longer_side = max(width, height)
        return {
            # Blender's camera has other axes than ours.
            "camera": (to_world.double().numpy() @ TO_BLENDER_CAMERA).tolist(),
            "fov": math.radians(fov),
            "shift": [shift_x * width / longer_side, -shift_y * height / longer_side],
        }


def _find_blender_command() -> list[str]:
    """Return the command that runs a script in Blender.

    Raises:
        BlenderError: Blender is not installed.
    """
    try:
        return workbench.find_blender(
            "Blender's Cycles has to render it", "leave `ways=blender` out"
        )
    except errors.FileFormatError as error:
        raise BlenderError(str(error)) from None


def _get_radiance(
    scene: SceneDescription, values: Mapping[str, Tensor]
) -> np.ndarray | None:
    """Return the radiance (H, W, 3) of the environment map; None without one.

    Args:
        scene: the scene.
        values: the scene's inputs by name.
    """
    radiance = None
    if scene.environment is not None:
        radiance = np.asarray(scene.environment.radiance, np.float32)
    if "environment.padded" in values:
        # An environment map that is searched has an additional column at each side,
        # so that interpolation wraps around. These two columns are removed.
        radiance = values["environment.padded"][:, 1:-1].numpy()
    return radiance


def _get_number(values: Mapping[str, Tensor], name: str, default: float) -> float:
    """Return the number in an input of a scene (1,), in float32.

    Args:
        values: the scene's inputs by name.
        name: name of the input.
        default: the number if there is no such input.
    """
    return float(values.get(name, torch.tensor([default]))[0])


def _check_supported(description: SceneDescription) -> None:
    """Raise an error if a scene has parts that cannot be transferred to Blender."""
    unsupported = _find_unsupported(description)
    if unsupported:
        raise BlenderError(
            # Five names are enough for a message.
            f"the scene has {', '.join(unsupported[:5])}, which is not "
            "carried over to Blender"
        )


def _find_unsupported(description: SceneDescription) -> list[str]:
    """Return the parts of a scene that cannot be transferred to Blender."""
    supported_types = (parts.MeshPart, parts.PointLamp, parts.BallLamp)
    unsupported = [
        part.name for part in description.parts if not isinstance(part, supported_types)
    ]
    for name, mesh in description.meshes.items():
        if mesh.surface:  # a BSDF of Mitsuba, which Blender does not have
            unsupported.append(f"a surface of Mitsuba's own on the {name}")
    if description.thin_lens or description.camera_model:
        unsupported.append("a lens")
    if description.backdrop_photograph:
        unsupported.append("a photograph behind the object")
    elif description.backdrop:
        unsupported.append("a plain background")
    return unsupported


def _describe_lamps(
    scene: SceneDescription, values: Mapping[str, Tensor]
) -> list[dict[str, object]]:
    """Return the lamps that are switched on, for `RENDER_SCRIPT`.

    Each lamp is a mapping. "color" is its linear radiance or intensity (3,). A
    spherical lamp has in "ball" the matrix (4, 4) from the unit sphere to the world. A
    point lamp has None there, and its position in "to_world" (4, 4).

    Args:
        scene: the scene.
        values: the scene's inputs by name; missing ones have the values of the scene.
    """
    lamps = []
    for lamp in scene.lamps.values():
        if isinstance(lamp, parts.BallLamp):
            described, color = _describe_ball(lamp, values)
        else:
            assert isinstance(lamp, parts.PointLamp)  # see `_find_unsupported`
            described, color = _describe_point(lamp, values)
        is_on = bool((color > 0.0).any())
        if is_on:
            lamps.append({**described, "color": color.tolist()})
    return lamps


def _describe_ball(
    lamp: parts.BallLamp, values: Mapping[str, Tensor]
) -> tuple[dict[str, object], Tensor]:
    """Return pose and radiance (3,) of a spherical lamp; see `_describe_lamps`."""
    default_ball = torch.from_numpy(
        assets.make_pose(lamp.radius * np.eye(3), lamp.center)
    )
    ball = values.get(f"{lamp.name}.ball", default_ball).double().tolist()
    color = values.get(f"{lamp.name}.radiance", torch.tensor(lamp.radiance))
    return {"ball": ball, "to_world": np.eye(4).tolist()}, color


def _describe_point(
    lamp: parts.PointLamp, values: Mapping[str, Tensor]
) -> tuple[dict[str, object], Tensor]:
    """Return position and intensity (3,) of a point lamp; see `_describe_lamps`."""
    to_world = np.eye(4)
    position = values.get(f"{lamp.name}.position", torch.tensor(lamp.position))
    to_world[:3, 3] = position.numpy()
    color = values.get(f"{lamp.name}.intensity", torch.tensor(lamp.intensity))
    return {"ball": None, "to_world": to_world.tolist()}, color


def _turn_for_blender(shape: assets.Shape) -> assets.Shape:
    """Rotate a mesh by 90 degrees around the vertical axis (z), before it is exported.

    The export as glTF and the import by Blender rotate it back by the same angle: what
    is in front in glTF is at -y in Blender. So the mesh has the same coordinates in
    Blender as in our scene.
    """
    rotation = np.array(
        [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], np.float32
    )
    mesh = shape.mesh
    rotated = replace(
        mesh, vertices=mesh.vertices @ rotation.T, normals=mesh.normals @ rotation.T
    )
    return replace(shape, mesh=rotated)


def _make_ground(
    scene: SceneDescription, reflectance: Tensor | None
) -> list[assets.Shape]:
    """Return the ground of a scene as a mesh, a square around the origin at height 0.

    The list is empty if the scene has no ground, or if one of its meshes is the ground
    already.

    Args:
        scene: the scene.
        reflectance: linear reflectance (H, W, 3) that replaces the photograph on the
            ground; None for the photograph itself.
    """
    photograph = scene.photograph
    if photograph is not None:
        # The ground is a mesh onto which the photograph is projected. Colors are linear
        # here, and textures are in sRGB.
        base_color = photograph.base_color if reflectance is None else reflectance
        texture = color.linear_to_srgb(base_color.clamp(0.0, 1.0)).numpy()
        return [assets.Shape("ground", photograph.mesh, texture, MATT)]

    half_size = np.float32(scene.get_number("ground.size") / 2.0)
    # A scene is paved if one of its meshes is the ground.
    has_plain_ground = half_size > 0.0 and not workbench.is_paved(scene)
    if not has_plain_ground:
        return []
    # one texel of the color of the ground, which is in sRGB already
    texture = np.full((1, 1, 3), scene.ground_color, np.float32)
    return [assets.Shape("ground", _make_square(half_size), texture, MATT)]


def _make_square(half_size: np.float32) -> assets.Mesh:
    """Return a horizontal square around the origin, by half the length of its side."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)
    normals = np.tile(np.array([[0, 0, 1]], np.float32), (4, 1))
    # from 0 to 1 where the corners are at -1 and 1
    texture_coordinates = corners[:, :2] * np.float32(0.5) + np.float32(0.5)
    return assets.Mesh(corners * half_size, faces, normals, texture_coordinates)


class _Process:
    """A process of Blender that has loaded one configuration.

    Args:
        program: the command that starts Blender with a script.
        blender_settings: what `RENDER_SCRIPT` reads as JSON.
        meshes: the scene as glTF.
        radiance: radiance of the environment, linear (H, W, 3); None if there is none.

    Raises:
        BlenderError: Blender can't be started.
    """

    def __init__(
        self,
        program: list[str],
        blender_settings: dict[str, object],
        meshes: bytes,
        radiance: np.ndarray | None,
    ) -> None:
        """Write the scene to a temporary directory, and start Blender.

        Args:
            program: command that starts Blender.
            blender_settings: camera, lamps and image size for the script.
            meshes: meshes as a glTF file.
            radiance: environment map (H, W, 3), linear; None for none.
        """
        self._temporary = tempfile.TemporaryDirectory(prefix="advsearch-cycles-")
        self._directory = Path(self._temporary.name)
        self._log = self._directory / "log.txt"
        self._n_images = 0
        self._write_scene(blender_settings, meshes, radiance)
        self._process = self._start(program)
        # Blender runs until this object is collected or Python exits.
        weakref.finalize(self, _stop, self._process, self._temporary)

    def _write_scene(
        self,
        blender_settings: dict[str, object],
        meshes: bytes,
        radiance: np.ndarray | None,
    ) -> None:
        """Write the files that the script reads, and the script itself.

        Args:
            blender_settings: camera, lamps and image size.
            meshes: meshes as a glTF file.
            radiance: environment map (H, W, 3), linear; None for none.
        """
        settings_text = json.dumps(blender_settings)
        (self._directory / "scene.json").write_text(settings_text, "utf-8")
        (self._directory / "scene.glb").write_bytes(meshes)
        (self._directory / "render.py").write_text(RENDER_SCRIPT, "utf-8")
        if radiance is not None:
            with OpenEXR.File({}, {"RGB": np.ascontiguousarray(radiance)}) as image:
                image.write(str(self._directory / "environment.exr"))

    def _start(self, program: list[str]) -> subprocess.Popen[bytes]:
        """Start Blender with the script that renders.

        Args:
            program: command that starts Blender, or a Python that has the module bpy.

        Raises:
            BlenderError: Blender can't be started.
        """
        script = self._directory / "render.py"
        # Blender passes arguments after "--" to the script. The program may also be a
        # Python with the module bpy, which is started with "-I" and needs no "--".
        separator = [] if "-I" in program else ["--"]
        with self._log.open("wb") as log:
            try:
                return subprocess.Popen(
                    [*program, str(script), *separator, str(self._directory)],
                    cwd=self._directory,
                    env=workbench.make_environment(str(self._directory)),
                    # The log is a file: a pipe would block Blender when it is full.
                    stdin=subprocess.PIPE,
                    stdout=log,
                    stderr=log,
                )
            except OSError as error:
                raise BlenderError(
                    f"Blender can't be started ({error.strerror}); check {program[0]}"
                ) from error

    def render(self, seed: int, spp: int) -> Tensor:
        """Render one image, linear (H, W, 3).

        The process runs already and waits for lines of "seed spp number" on its
        standard input. It writes the image NUMBER.exr.

        Args:
            seed: seed of the noise.
            spp: samples per pixel.

        Raises:
            BlenderError: Blender stopped, or took too long.
        """
        time_limit = stored_files.scale_limit(MAX_RENDER_SECONDS)
        deadline = time.monotonic() + time_limit
        path = self._request_image(seed, spp)
        # Blender writes the file under its final name when it is complete.
        while not path.is_file():
            self._check_running(path)
            if time.monotonic() > deadline:
                raise BlenderError(
                    f"Blender had not rendered it after {time_limit} seconds"
                )
            time.sleep(POLL_INTERVAL)
        radiance = _read_radiance(path)
        path.unlink()
        return radiance

    def _request_image(self, seed: int, spp: int) -> Path:
        """Tell Blender to render an image, and return the path that it will write."""
        self._n_images += 1
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(f"{seed} {spp} {self._n_images}\n".encode())
            self._process.stdin.flush()
        except OSError:
            pass  # Blender has stopped, which `_check_running` reports
        return self._directory / f"{self._n_images}.exr"

    def _check_running(self, path: Path) -> None:
        """Raise an error if Blender has stopped before it has written an image."""
        has_stopped = self._process.poll() is not None
        # Blender may have written the file just before it stopped.
        if has_stopped and not path.is_file():
            log = self._log.read_text("utf-8", "replace")
            raise BlenderError(f"Blender stopped{workbench.get_last_line(log)}")


def _read_radiance(path: Path) -> Tensor:
    """Read the image (H, W, 3) that Blender has written, linear."""
    with OpenEXR.File(str(path)) as image:
        channels = image.channels().values()
        # There is one layer, whose name Blender chooses. It has RGB, perhaps with
        # alpha.
        pixels = next(iter(channels)).pixels
        return torch.from_numpy(np.array(pixels[..., :3], dtype=np.float32))


def _stop(
    process: subprocess.Popen[bytes], temporary: tempfile.TemporaryDirectory[str]
) -> None:
    """Kill Blender, and remove its directory."""
    process.kill()
    process.wait()
    if process.stdin is not None:
        process.stdin.close()
    temporary.cleanup()
