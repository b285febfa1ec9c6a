"""A scene with its inputs set, as an XML file that stock Mitsuba loads, with meshes
(PLY) and pictures (EXR) beside it.

Every number is written with all of its digits, meshes and pictures in float32.
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
from advsearch.scene.assets import Floats
from advsearch.scene.color import linear_to_srgb
from advsearch.scene.description import OBJECT
from advsearch.scene.mitsuba_backend.meshes import (
    base_texture,
    emitter,
    matt,
    own_surface,
    principled,
)
from advsearch.scene.mitsuba_backend.parts import (
    CAMERA_NUMBERS,
    GROUND,
    scene_dict,
    translation,
)
from advsearch.scene.mitsuba_backend.scene import MitsubaScene
from advsearch.scene.mitsuba_backend.variant import VARIANT, Plugin, mi

NAME = "scene.xml"
MATERIAL = ("roughness", "metallic", "specular", "clearcoat")
# segments that paths in haze have beyond those between surfaces: stock Mitsuba counts
# both alike
SCATTERINGS = 3
# entries that a dictionary need not have for them to be set
ABSENT = ("to_world", *CAMERA_NUMBERS.values())
# entries of a mesh from a file that are in what is written
BAKED = ("filename", "to_world", "flip_tex_coords")


def write_scene(
    scene: MitsubaScene,
    inputs: Mapping[str, Tensor],
    path: Path,
    note: str,
    *,
    hide: bool = False,
) -> None:
    """Write a scene with its inputs set, and the visible environment hidden or not, as
    of `MitsubaScene.pictures`, as XML that stock Mitsuba loads, into a folder that is
    there, with meshes and pictures beside it, and a note as a comment.

    Raises:
        InputError: something in it is no part of stock Mitsuba.
    """
    description, filter = scene.made
    if description.camera_model is not None:
        raise InputError(
            "camera: stock Mitsuba has no sensor with distortion; export "
            "the run as glTF (.glb) instead"
        )
    # not `prbvolpath`, which starts outside of all media
    kind = "volpath" if scene.volumetric else "path"
    integrator: Plugin = {
        "type": kind,
        "max_depth": scene.max_depth,
        "rr_depth": scene.roulette,
        "hide_emitters": hide,
    }
    whole: Plugin = {
        "integrator": integrator,
        **scene_dict(description, scene.resolution, filter, scene.sampler),
    }
    left = {
        name: value.detach().cpu().numpy().astype(np.float32)
        for name, value in inputs.items()
    }
    if "camera.fov" in left:  # along the larger side, as in the dictionary
        whole["camera"]["fov"] = float(left.pop("camera.fov")[0])
    if "environment.padded" in left:
        left["environment.padded"] = left["environment.padded"][:, 1:-1]
    if description.photograph is not None:
        whole[GROUND] = {
            "type": "ply",
            "bsdf": matt(description.photograph.base.numpy()),
        }
    for part in (description.meshes[OBJECT], *description.parts):
        if isinstance(part, parts.HazePart):
            _put_haze(whole, part, left)
        elif isinstance(part, parts.MeshPart):
            whole[part.name] = _mesh(description.placed(part), left)
        else:
            whole |= translation(description.placed(part)).plugins
        if not isinstance(whole.get(part.name, {}), Mapping):
            raise InputError(
                f"out: stock Mitsuba has nothing for {part.name}; export "
                "a run without it"
            )
    unplaced = [
        name
        for name in sorted(left)
        if not _put(whole, scene.declared[name][0].split("."), left[name])
    ]
    if unplaced:
        raise InputError(
            f"out: stock Mitsuba has nothing for {', '.join(unplaced)}; "
            "export another run"
        )
    meshes = {
        shape.id(): shape for shape in scene.held(inputs).shapes() if shape.is_mesh()
    }
    write_xml(
        path,
        whole,
        {name: mesh for name, mesh in meshes.items() if name in whole},
        note,
    )


def _put_haze(scene: Plugin, haze: parts.HazePart, left: Plugin) -> None:
    """Fill a ball and the camera in it with haze, unless its density is 0; takes its
    inputs from what is left.
    """
    density = left.pop(f"{haze.name}.density", np.array([haze.density])).tolist()
    albedo = left.pop(f"{haze.name}.albedo", np.array(haze.albedo)).tolist()
    if not density[0] > 0.0:
        return
    medium = f"{haze.name}-medium"
    inside = {"type": "ref", "id": medium}
    scene[medium] = {
        "type": "homogeneous",
        "sigma_t": density[0],
        "albedo": {"type": "rgb", "value": albedo},
    }
    scene[haze.name] = {
        "type": "sphere",
        "radius": haze.radius,
        "bsdf": {"type": "null"},
        "interior": inside,
    }
    scene["camera"]["medium"] = inside
    scene["integrator"]["max_depth"] += SCATTERINGS


def _put(plugin: Plugin, key: list[str], value: Floats) -> bool:
    """Set a number, colour, transform or picture by Mitsuba's name, where a dictionary
    has it; whether it does.
    """
    here, *rest = key
    if here.startswith("brdf_") and here not in plugin:  # the one surface of two sides
        here = next(
            (name for name, inner in plugin.items() if isinstance(inner, Mapping)), here
        )
    here = "bitmap" if here == "data" else here
    inner = plugin.get(here)
    if isinstance(inner, Mapping):
        plugin[here] = dict(inner)
        return bool(rest) and _put(plugin[here], rest, value)
    if rest or (inner is None and here not in ABSENT):
        return False
    if here == "bitmap":
        plugin[here] = mi.Bitmap(np.ascontiguousarray(value))
    elif value.shape == (4, 4):
        plugin[here] = mi.ScalarTransform4f(value)
    else:
        plugin[here] = value.tolist() if value.size > 1 else float(value[0])
    return True


def _mesh(part: parts.MeshPart, left: Plugin) -> Plugin:
    inputs = {
        name.partition(".")[2]: left.pop(name)
        for name in list(left)
        if name.startswith(f"{part.name}.")
    }
    if "base_color" in inputs:
        part = replace(
            part,
            base_color=linear_to_srgb(
                torch.from_numpy(inputs.pop("base_color"))
            ).numpy(),
        )
    if "radiance" in inputs:
        radiance = inputs.pop("radiance")
        part = replace(
            part,
            emission=radiance.reshape(
                -1, *radiance.shape[-2:] if radiance.ndim > 1 else (1, 3)
            ),
        )
    if part.surface is None:
        numbers = {
            name: float(inputs.pop(name)[0]) for name in MATERIAL if name in inputs
        }
        surface = principled(replace(part, material=replace(part.material, **numbers)))
    else:
        base_color = part.base_color
        surface = own_surface(
            part.surface, lambda options: base_texture(base_color, options)
        )
    # the mesh that is written has them
    inputs.pop("vertices", None), inputs.pop("normals", None)
    left |= {f"{part.name}.{name}": value for name, value in inputs.items()}
    light = emitter(part)
    return {"type": "ply", "bsdf": surface, **({"emitter": light} if light else {})}


def write_xml(path: Path, scene: Plugin, meshes: Mapping[str, Any], note: str) -> None:
    """Write a scene's dictionary, of `described`, by Mitsuba's own writer into a folder
    that is there, and beside it what it needs, in files whose names begin with its own:
    Mitsuba's meshes, by the names of the entries of the type "ply", and pictures. The
    note is a comment at the beginning.
    """

    taken = set[Path]()

    def beside(name: str, suffix: str) -> Path:
        free = path.with_name(f"{path.stem}-{name}{suffix}")
        while free in taken:
            free = free.with_stem(f"{free.stem}-2")
        taken.add(free)
        return free

    def filed(name: str, plugin: Mapping[str, Any]) -> Plugin:
        """The plugin with its pictures, and the files that it names, beside the
        scene.
        """
        copied: Plugin = {}
        for key, entry in plugin.items():
            if isinstance(entry, mi.Bitmap):
                key = "filename"
                file = beside(name, ".exr")
                values = np.array(entry, dtype=np.float32)
                grey = values.ndim < 3 or values.shape[2] == 1
                channels = (
                    {"Y": values.reshape(values.shape[:2])}
                    if grey
                    else {"RGBA"[: values.shape[2]]: values}
                )
                # Mitsuba's waits forever where Dr.Jit has one thread
                with OpenEXR.File({}, channels) as picture:
                    picture.write(str(file))
                entry = file.name
            elif isinstance(entry, Mapping):
                entry = filed(f"{name}-{key}", entry)
            elif key == "filename" and os.path.isabs(entry):
                file = beside(name, Path(entry).suffix)
                shutil.copyfile(entry, file)
                entry = file.name
            copied[key] = entry
        return copied

    whole: Plugin = {"type": "scene"}
    for name, plugin in scene.items():
        if name == "type":
            continue
        if plugin["type"] == "ply" and name in meshes:
            file = beside(name, ".ply")
            meshes[name].write_ply(str(file))
            plugin = {
                **{key: entry for key, entry in plugin.items() if key not in BAKED},
                "filename": file.name,
            }
        whole[name] = filed(name, plugin)
    try:
        text = mi.parser.write_string(
            mi.parser.parse_dict(mi.parser.ParserConfig(VARIANT), whole)
        )
    except (RuntimeError, TypeError) as error:
        raise InputError(
            f"out: XML of Mitsuba cannot say the scene: {error}; export another run"
        ) from error
    root = ElementTree.fromstring(text)
    # Mitsuba calls parameters by ids, and writes only those referred to
    for entry in root.findall("*[@type]"):
        entry.set("id", entry.attrib.pop("name"))
    text = ElementTree.tostring(root, encoding="unicode")
    path.write_text(f"<!-- {note.replace('--', '- -')} -->\n{text}\n", "utf-8")
