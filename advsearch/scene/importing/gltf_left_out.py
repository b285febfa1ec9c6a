"""What a glTF file has and a scene of ours has not, in sentences: nothing is dropped in silence.

Each of them begins with the name of the file, which the caller puts before it.
"""

from __future__ import annotations

from collections.abc import Iterator

from pydantic import BaseModel

from advsearch.scene.importing.files import Notes, shown
from advsearch.scene.importing.gltf import READ
from advsearch.scene.importing.gltf_entries import CUT_OUTS, Header
from advsearch.scene.importing.usd import GENERATOR
from advsearch.scene.skeleton import Skeleton

_OPAQUE = " lets light pass through surfaces with {name}; here they are opaque"

EXTENSIONS = {
    "EXT_mesh_gpu_instancing": " repeats meshes with {name}; each is there once",
    "KHR_materials_diffuse_transmission": _OPAQUE,
    "KHR_materials_pbrSpecularGlossiness": " has {name}, of which only diffuse colour and glossiness are read",
    "KHR_materials_transmission": _OPAQUE,
    "KHR_materials_unlit": " has surfaces that keep their colour in any light ({name}); here they are lit as others",
    "KHR_materials_variants": " has variants of its materials ({name}); those that it shows by itself are taken",
}
"""What becomes of a file with an extension; of all that are not named here, nor understood, `UNKNOWN`."""

UNKNOWN = " uses {name}, which is not understood and left out"

FAR = 1000.0
"""Distance of a directional light, in object sizes."""


def left_out(header: Header, notes: Notes) -> None:
    """Say what the file has that is not carried over, whether one node or all of it is the object."""
    if header.asset.generator == GENERATOR and isinstance(header.asset.extras, dict):
        told = header.asset.extras.get("left_out")
        for what in told if isinstance(told, list) else ():
            notes.say(" " + shown(str(what), quoted=False))
    used = {*header.extensionsUsed, *header.extensionsRequired}
    for name in sorted(used & set(EXTENSIONS) | used - set(READ)):
        notes.say(EXTENSIONS.get(name, UNKNOWN).format(name=shown(name, quoted=False)))
    drawn = in_the_scene(header)
    absent = sum(node.mesh is not None for index, node in enumerate(header.nodes) if index not in drawn)
    found = {
        "occlusion map{s}: left out": sum(one.occlusionTexture is not None for one in header.materials),
        "normal map{s} with other texture coordinates than the base colour: left out": sum(
            not one.reads(one.normalTexture) for one in header.materials
        ),
        "emission texture{s} with other coordinates than the base colour: left out, with the emission": sum(
            any(one.emission) and not one.reads(one.emissiveTexture) for one in header.materials
        ),
        "material{s} with an alphaMode that glTF does not have: opaque": sum(
            one.alphaMode not in ("OPAQUE", *CUT_OUTS) for one in header.materials
        ),
        "further scene{s}: left out": max(0, len(header.scenes) - 1),
        "node{s} with a mesh outside of its scene: left out": absent,
    }
    for what, count in found.items():
        if count:
            notes.say(counted(count, what))
    _note_unread(header, notes)


def moves(skeleton: Skeleton) -> str:
    """Say what of a file moves, and how."""
    names = [one.name for one in skeleton.clips]
    clips = f", and plays {', '.join(names[:5])}{', ...' if len(names) > 5 else ''}" if names else ""
    return f" is shown at rest: the control body moves it{clips}"


WORDS = {
    "Header": "entry",
    "MaterialEntry": "entry of a material",
    "MetallicRoughness": "entry of a material",
    "TextureUse": "entry of a material's texture",
    "NormalUse": "entry of a material's texture",
    "MeshEntry": "entry of a mesh",
    "Primitive": "entry of a primitive",
    "Node": "entry of a node",
    "Sampler": "entry of a sampler",
    "Texture": "entry of a texture",
    "Image": "entry of an image",
    "LightEntry": "entry of a light",
}
"""What is left out of entries whose contents are seen."""

PLAIN = frozenset(("name", "weights", "extensions"))
"""Keys without a field that make no difference, or are named with what they belong to."""


def _note_unread(header: Header, notes: Notes) -> None:
    """Note every key, extras of materials among them, and every attribute that is not read."""
    level: list[object] = [header]
    for entry in level:  # which grows
        if isinstance(entry, list):
            level.extend(one for one in entry if isinstance(one, BaseModel))
        elif isinstance(entry, BaseModel):
            kind = WORDS.get(type(entry).__name__)
            for key in (entry.model_extra or {}) if kind else ():
                notes.has(str(kind), key)
            level.extend(getattr(entry, name) for name in type(entry).model_fields)
    for kind in set(WORDS.values()):
        for key in PLAIN if "material" in kind or "texture" in kind else {*PLAIN, "extras"}:  # notes of applications
            notes.take(kind, key)
    for mesh in header.meshes:
        for primitive in mesh.primitives:
            material = None if primitive.material is None else header.materials[primitive.material]
            read = {"POSITION", "NORMAL", "COLOR_0", "TEXCOORD_0", material.attribute if material else ""}
            for name in primitive.attributes:
                if name not in read and not (header.skins and name.startswith(("JOINTS_", "WEIGHTS_"))):
                    notes.has("attribute", name)


def beside(header: Header) -> str | None:
    """Return what a file read as one object leaves out of its scene; None if nothing."""
    lights = sum(node.lamp is not None for node in header.nodes)
    cameras = sum(node.camera is not None for node in header.nodes)
    found = [counted(count, what) for count, what in ((lights, "light{s}"), (cameras, "camera{s}")) if count]
    if not found:
        return None
    verb = "is" if lights + cameras == 1 else "are"
    what_to_do = "name one node as the object, FILE#NODE, to keep the rest around it"
    return f": {' and '.join(found)} {verb} left out of the object; {what_to_do}"


def lights_and_cameras(header: Header) -> Iterator[str]:
    """Yield what becomes of lights and cameras that are not what they are in the file."""
    distant = [light.type == "directional" for light in header.lights]
    found = {
        f"directional light{{s}}, here as lamps {FAR:g} object sizes away": sum(distant),
        "light{s} with a range, which is left out: light reaches beyond it": sum(
            light.range is not None for light in header.lights
        ),
        "camera{s} without perspective: left out": sum(one.perspective is None for one in header.cameras),
    }
    yield from (f": {counted(count, what)}" for what, count in found.items() if count)


def counted(count: int, what: str) -> str:
    return f"{count} {what.format(s='' if count == 1 else 's', es='' if count == 1 else 'es')}"


def in_the_scene(header: Header) -> set[int]:
    """The nodes of the scene that is read."""
    if not header.scenes:
        return set(range(len(header.nodes)))
    found: set[int] = set()
    level = list(header.scenes[header.scene or 0].nodes)
    while level:
        found.update(level)
        level = [child for index in level for child in header.nodes[index].children]
    return found
