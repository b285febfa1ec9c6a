"""Write a scene as an XML file that stock Mitsuba loads, with meshes and images.

Every number is written with all of its digits, meshes (PLY) and images (EXR) in
float32.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import OpenEXR
import torch
from torch import Tensor

from advsearch.errors import InputError
from advsearch.scene import parts
from advsearch.scene.assets import Float32Array
from advsearch.scene.color import linear_to_srgb
from advsearch.scene.description import OBJECT, SceneDescription
from advsearch.scene.geometry import get_positioned_part
from advsearch.scene.mitsuba_backend.meshes import (
    fill_base_color,
    make_base_texture,
    make_diffuse,
    make_emitter,
    make_principled,
)
from advsearch.scene.mitsuba_backend.parts import (
    CAMERA_KEYS,
    GROUND_NAME,
    make_scene_dict,
    translate_part,
)
from advsearch.scene.mitsuba_backend.scene import MitsubaScene
from advsearch.scene.mitsuba_backend.variant import VARIANT, Plugin, mi

SCENE_FILE_NAME = "scene.xml"
MATERIAL_INPUTS = ("roughness", "metallic", "specular", "clearcoat")
# further segments of paths in haze: stock Mitsuba counts those between scatterings as
# well
EXTRA_DEPTH = 3
# entries that can be set although a dictionary does not have them
OPTIONAL_ENTRIES = ("to_world", *CAMERA_KEYS.values())
# entries of a mesh from a file that the written mesh includes
BAKED_ENTRIES = ("filename", "to_world", "flip_tex_coords")


def write_scene(
    scene: MitsubaScene,
    inputs: Mapping[str, Tensor],
    path: Path,
    note: str,
    *,
    hide_environment: bool = False,
) -> None:
    """Write a scene with its inputs set as XML that stock Mitsuba loads.

    Meshes and images are written next to it. Inputs of the camera and of the parts are
    put into the scene's dictionary first, and then the others, by Mitsuba's keys.

    Args:
        scene: the scene.
        inputs: values of inputs that differ from the base values.
        path: path of the XML file, in a folder that exists.
        note: becomes a comment.
        hide_environment: hide the visible environment.

    Raises:
        InputError: something in it is no part of stock Mitsuba.
    """
    _check_has_stock_lens(scene)
    xml_scene = _make_xml_scene(scene, hide_environment)
    # inputs that are not in the dictionary yet: `_put_part` takes some of them out
    remaining_inputs = _convert_to_arrays(inputs)
    _put_camera_and_map(xml_scene, remaining_inputs)
    description, _filter = scene.description_and_filter
    _put_photographed_ground(xml_scene, description)
    for part in (description.meshes[OBJECT], *description.parts):
        _put_part(xml_scene, description, part, remaining_inputs)
    _put_all_inputs(xml_scene, scene, remaining_inputs)
    meshes = _list_file_meshes(scene, inputs, xml_scene)
    write_xml(path, xml_scene, meshes, note)


def _convert_to_arrays(inputs: Mapping[str, Tensor]) -> dict[str, Float32Array]:
    """Return inputs as arrays, by name."""
    return {
        name: value.detach().cpu().numpy().astype(np.float32)
        for name, value in inputs.items()
    }


def _list_file_meshes(
    scene: MitsubaScene, inputs: Mapping[str, Tensor], xml_scene: Plugin
) -> dict[str, Any]:
    """Return Mitsuba's meshes with inputs set, by their entries in a dictionary."""
    return {
        shape.id(): shape
        for shape in scene.set_inputs(inputs).shapes()
        if shape.is_mesh() and shape.id() in xml_scene
    }


def _check_has_stock_lens(scene: MitsubaScene) -> None:
    """Raise InputError if the camera has a lens that stock Mitsuba does not have."""
    description, _filter = scene.description_and_filter
    if description.camera_model is not None:
        raise InputError(
            "camera: stock Mitsuba has no sensor with distortion; export "
            "the run as glTF (.glb) instead"
        )


def _make_xml_scene(scene: MitsubaScene, hide_environment: bool) -> Plugin:
    """Return the dictionary of a scene and its integrator, without its inputs."""
    description, filter_name = scene.description_and_filter
    return {
        "integrator": _make_integrator(scene, hide_environment),
        **make_scene_dict(
            description, scene.resolution, filter_name, scene.sampler_name
        ),
    }


def _put_camera_and_map(xml_scene: Plugin, remaining_inputs: Plugin) -> None:
    """Put the field of view into a scene's dictionary, and prepare the map's input.

    Args:
        xml_scene: the scene's dictionary, which is changed.
        remaining_inputs: inputs that are not in the dictionary yet; the field of view
            is removed, and the map gets the columns that a dictionary has.
    """
    if "camera.fov" in remaining_inputs:  # along the larger side, as in the dictionary
        xml_scene["camera"]["fov"] = float(remaining_inputs.pop("camera.fov")[0])
    if "environment.padded" in remaining_inputs:
        # without the copied columns at both ends, which only the loaded scene has
        padded = remaining_inputs["environment.padded"]
        remaining_inputs["environment.padded"] = padded[:, 1:-1]


def _put_photographed_ground(xml_scene: Plugin, description: SceneDescription) -> None:
    """Put a ground that the map of the environment shows into a scene's dictionary.

    It is a mesh. `write_xml` writes its file, as those of all entries of the type
    "ply".
    """
    if description.photograph is not None:
        xml_scene[GROUND_NAME] = {
            "type": "ply",
            "bsdf": make_diffuse(description.photograph.base_color.numpy()),
        }


def _make_integrator(scene: MitsubaScene, hide_environment: bool) -> Plugin:
    """Return the dictionary of stock Mitsuba's integrator for a scene."""
    return {
        # Haze needs a type with media; its paths start in the camera's medium.
        "type": "volpath" if scene.is_volumetric else "path",
        "max_depth": scene.max_depth,
        "rr_depth": scene.roulette_depth,
        "hide_emitters": hide_environment,
    }


def _put_part(
    xml_scene: Plugin,
    description: SceneDescription,
    part: parts.ScenePart,
    remaining_inputs: Plugin,
) -> None:
    """Put a part into a scene's dictionary, and remove its inputs from the others.

    Args:
        xml_scene: the scene's dictionary, which is changed.
        description: the scene.
        part: the part.
        remaining_inputs: inputs that are not in the dictionary yet; those of the part
            are removed.

    Raises:
        InputError: stock Mitsuba has no such part.
    """
    if isinstance(part, parts.HazePart):
        _put_haze(xml_scene, part, remaining_inputs)
    elif isinstance(part, parts.MeshPart):
        xml_scene[part.name] = _make_mesh(
            get_positioned_part(description, part), remaining_inputs
        )
    else:
        xml_scene |= translate_part(get_positioned_part(description, part)).plugins
    _check_entry(xml_scene, part.name)


def _check_entry(xml_scene: Plugin, name: str) -> None:
    """Raise InputError if the entry of a name is of no plugin of stock Mitsuba.

    A part may have no entry of its own name. An entry that is no dictionary is an
    object of a plugin that stock Mitsuba does not have.
    """
    entry = xml_scene.get(name, {})
    if not isinstance(entry, Mapping):
        raise InputError(
            f"out: stock Mitsuba has nothing for {name}; export a run without it"
        )


def _put_all_inputs(
    xml_scene: Plugin, scene: MitsubaScene, inputs: Mapping[str, Float32Array]
) -> None:
    """Put inputs into a scene's dictionary by Mitsuba's keys.

    Args:
        xml_scene: the dictionary, which is changed.
        scene: the scene, which knows Mitsuba's key of each input.
        inputs: values of the inputs by name.

    Raises:
        InputError: the dictionary has no place for an input.
    """
    unset_names = []
    for name in sorted(inputs):
        key, _ = scene.declared_inputs[name]
        was_put = _put_input(xml_scene, key.split("."), inputs[name])
        if not was_put:
            unset_names.append(name)
    if unset_names:
        raise InputError(
            f"out: stock Mitsuba has nothing for {', '.join(unset_names)}; "
            "export a run without it"
        )


def _put_haze(scene: Plugin, haze: parts.HazePart, remaining_inputs: Plugin) -> None:
    """Put haze into a scene's dictionary: a ball filled with a medium, and the camera
    in it.

    Nothing is put in if the density is 0. Otherwise light paths may have `EXTRA_DEPTH`
    more segments, since stock Mitsuba counts scatterings in the haze too.

    Args:
        scene: the scene's dictionary, which is changed.
        haze: the haze.
        remaining_inputs: inputs that are not in the dictionary yet; those of the haze
            are removed.
    """
    density = remaining_inputs.pop(
        f"{haze.name}.density", np.array([haze.density])
    ).tolist()
    albedo = remaining_inputs.pop(f"{haze.name}.albedo", np.array(haze.albedo)).tolist()
    if not density[0] > 0.0:
        return  # without haze its inputs have no effect
    _put_haze_ball(scene, haze, density[0], albedo)
    scene["integrator"]["max_depth"] += EXTRA_DEPTH


def _put_haze_ball(
    scene: Plugin, haze: parts.HazePart, density: float, albedo: list[float]
) -> None:
    """Put the ball and the medium of a haze into a scene's dictionary.

    The camera gets the medium as well, since it stands in it.

    Args:
        scene: the scene's dictionary, which is changed.
        haze: the haze.
        density: its extinction per object size.
        albedo: its albedo (RGB).
    """
    medium_name = f"{haze.name}-medium"
    medium_reference = {"type": "ref", "id": medium_name}
    scene[medium_name] = {
        "type": "homogeneous",
        "sigma_t": density,
        "albedo": {"type": "rgb", "value": albedo},
    }
    scene[haze.name] = {
        "type": "sphere",
        "radius": haze.radius,
        "bsdf": {"type": "null"},
        "interior": medium_reference,
    }
    scene["camera"]["medium"] = medium_reference


def _put_input(plugin: Plugin, key_parts: list[str], value: Float32Array) -> bool:
    """Set a number, color, transform or image of a dictionary by Mitsuba's key.

    Inner dictionaries are copied, so that those of the scene stay as they are.

    Args:
        plugin: the dictionary, which is changed.
        key_parts: Mitsuba's key, cut at its dots.
        value: value of the input.

    Returns:
        Whether the dictionary has such an entry.
    """
    first_part, *inner_parts = key_parts
    name = _find_entry_name(plugin, first_part)
    entry = plugin.get(name)
    if isinstance(entry, Mapping):
        # The key leads on into a copy of the inner plugin.
        plugin[name] = dict(entry)
        return bool(inner_parts) and _put_input(plugin[name], inner_parts, value)
    is_missing = entry is None and name not in OPTIONAL_ENTRIES
    # the key leads into a value, or to nothing
    if inner_parts or is_missing:
        return False
    plugin[name] = _to_entry(name, value)
    return True


def _find_entry_name(plugin: Plugin, key_part: str) -> str:
    """Return the name of a dictionary's entry by the part of Mitsuba's key for it."""
    name = key_part
    if name.startswith("brdf_") and name not in plugin:
        # Mitsuba has a surface for each side, "brdf_0" and "brdf_1". A dictionary has
        # one for both, which is the only inner plugin.
        inner_names = [key for key in plugin if isinstance(plugin[key], Mapping)]
        if inner_names:
            name = inner_names[0]
    if name == "data":  # what a loaded texture calls its texels
        name = "bitmap"
    return name


def _to_entry(name: str, value: Float32Array) -> object:
    """Convert the value of an input to an entry of a dictionary."""
    if name == "bitmap":
        return mi.Bitmap(np.ascontiguousarray(value))
    if value.shape == (4, 4):
        return mi.ScalarTransform4f(value)
    return value.tolist() if value.size > 1 else float(value[0])


def _make_mesh(part: parts.MeshPart, remaining_inputs: Plugin) -> Plugin:
    """Return a mesh's plugin, with the values that its inputs have.

    Base color, light and the numbers of the surface are set here. Vertices and normals
    are dropped, since the mesh's file has them.

    Args:
        part: the mesh.
        remaining_inputs: inputs that are not in the dictionary yet; those that are set
            here or dropped are removed.
    """
    part_inputs = _pop_part_inputs(remaining_inputs, part.name)
    part = _set_color_and_light(part, part_inputs)
    # This also removes the numbers of the surface from `part_inputs`.
    surface = _make_surface(part, part_inputs)
    # Vertices and normals are in the file of the mesh.
    part_inputs.pop("vertices", None)
    part_inputs.pop("normals", None)
    # What is left was not set here, and goes back to the other inputs.
    remaining_inputs |= {
        f"{part.name}.{name}": value for name, value in part_inputs.items()
    }
    mesh: Plugin = {"type": "ply", "bsdf": surface}
    light = make_emitter(part)
    if light:
        mesh["emitter"] = light
    return mesh


def _pop_part_inputs(inputs: Plugin, part_name: str) -> Plugin:
    """Remove the inputs of a part, and return them without the part's name."""
    return {
        name.partition(".")[2]: inputs.pop(name)
        for name in list(inputs)
        if name.startswith(f"{part_name}.")
    }


def _set_color_and_light(part: parts.MeshPart, part_inputs: Plugin) -> parts.MeshPart:
    """Return a mesh with the base color and the light of its inputs.

    These are removed from the inputs.
    """
    if "base_color" in part_inputs:
        linear = torch.from_numpy(part_inputs.pop("base_color"))
        part = replace(part, base_color=linear_to_srgb(linear).numpy())
    if "radiance" in part_inputs:
        radiance = part_inputs.pop("radiance")
        if radiance.ndim == 1:  # one color (3,), and no texture (h, w, 3)
            radiance = radiance.reshape(1, 1, 3)
        part = replace(part, emission=radiance)
    return part


def _make_surface(part: parts.MeshPart, part_inputs: Plugin) -> Plugin:
    """Return the surface of a mesh, with the values that its inputs have.

    Args:
        part: the mesh.
        part_inputs: its inputs by names such as "roughness"; those that are set here
            are removed.
    """
    # The caller has put the base color into `part` already. A surface of the user's has
    # no other inputs of ours.
    if part.surface is not None:
        base_color = part.base_color
        return fill_base_color(
            part.surface, lambda options: make_base_texture(base_color, options)
        )
    numbers = {
        name: float(part_inputs.pop(name)[0])  # each (1,)
        for name in MATERIAL_INPUTS
        if name in part_inputs
    }
    return make_principled(replace(part, material=replace(part.material, **numbers)))


def write_xml(path: Path, scene: Plugin, meshes: Mapping[str, Any], note: str) -> None:
    """Write a scene's dictionary by Mitsuba's own writer, with all files that it needs.

    The files' names begin with that of the XML file.

    Args:
        path: path of the XML file, in a folder that exists.
        scene: the dictionary.
        meshes: Mitsuba's meshes, by the names of the entries of the type "ply".
        note: a comment at the beginning.
    """
    files = _SceneFiles(path)
    xml_scene: Plugin = {"type": "scene"}
    for name, plugin in scene.items():
        if name == "type":
            continue
        if plugin["type"] == "ply" and name in meshes:
            plugin = _write_mesh_file(files.reserve(name, ".ply"), plugin, meshes[name])
        xml_scene[name] = files.write_files_of(name, plugin)
    text = _format_xml(xml_scene)
    # XML allows no double hyphen in a comment.
    comment = note.replace("--", "- -")
    path.write_text(f"<!-- {comment} -->\n{text}\n", "utf-8")


def _write_mesh_file(file: Path, plugin: Plugin, mesh: Any) -> Plugin:
    """Write a mesh of Mitsuba's, and return its plugin with the name of the file."""
    mesh.write_ply(str(file))
    entries = {key: entry for key, entry in plugin.items() if key not in BAKED_ENTRIES}
    return {**entries, "filename": file.name}


def _format_xml(scene: Plugin) -> str:
    """Return a scene's dictionary as XML, in which each plugin at the top has an id.

    Mitsuba names the parameters of a scene by the ids of plugins. Its writer gives an
    id only to plugins to which others refer, and a name to the rest: this becomes their
    id.

    Raises:
        InputError: the scene cannot be written.
    """
    root = ElementTree.fromstring(_format_with_mitsuba(scene))
    for entry in root.findall("*[@type]"):
        entry.set("id", entry.attrib.pop("name"))
    return ElementTree.tostring(root, encoding="unicode")


def _format_with_mitsuba(scene: Plugin) -> str:
    """Return a scene's dictionary as XML, as Mitsuba writes it.

    Raises:
        InputError: the scene cannot be written.
    """
    try:
        state = mi.parser.parse_dict(mi.parser.ParserConfig(VARIANT), scene)
        text: str = mi.parser.write_string(state)
    except (RuntimeError, TypeError) as error:
        raise InputError(
            f"out: the scene cannot be written as XML of Mitsuba: {error}; export "
            "another run"
        ) from error
    return text


class _SceneFiles:
    """Write the files of a scene next to its XML file."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._used = set[Path]()

    def reserve(self, name: str, suffix: str) -> Path:
        """Return a path that no other file of the scene has."""
        path = self._path.with_name(f"{self._path.stem}-{name}{suffix}")
        while path in self._used:
            path = path.with_stem(f"{path.stem}-2")
        self._used.add(path)
        return path

    def write_files_of(self, name: str, plugin: Mapping[str, Any]) -> Plugin:
        """Write a plugin's images, copy the files that it names, and return it.

        The returned plugin has the names of the new files.
        """
        entries: Plugin = {}
        for key, entry in plugin.items():
            if isinstance(entry, mi.Bitmap):
                # under the key by which Mitsuba loads an image from a file
                entries["filename"] = self._write_image(name, entry)
            elif isinstance(entry, Mapping):
                entries[key] = self.write_files_of(f"{name}-{key}", entry)
            elif key == "filename" and os.path.isabs(entry):
                # a relative name is that of a file that was written here
                file = self.reserve(name, Path(entry).suffix)
                shutil.copyfile(entry, file)
                entries[key] = file.name
            else:
                entries[key] = entry
        return entries

    def _write_image(self, name: str, bitmap: Any) -> str:
        """Write a bitmap as EXR and return the file's name."""
        file = self.reserve(name, ".exr")
        values = np.array(bitmap, dtype=np.float32)
        if values.ndim < 3 or values.shape[2] == 1:
            channels = {"Y": values.reshape(values.shape[:2])}
        else:
            # "RGB" or "RGBA": the name of a group of channels
            channels = {"RGBA"[: values.shape[2]]: values}
        # Not by Mitsuba's own writer, which waits forever if Dr.Jit has one thread.
        with OpenEXR.File({}, channels) as image:
            image.write(str(file))
        return file.name
