"""What a glTF file has and a scene of ours has not, in sentences: nothing is dropped in silence.

Each of them begins with the name of the file, which the caller puts before it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from pydantic import BaseModel

from advsearch.scene.importing.files import Notes, shown
from advsearch.scene.importing.gltf import READ
from advsearch.scene.importing.gltf_entries import CUT_OUTS, Header
from advsearch.scene.importing.usd import GENERATOR

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
        sentences = header.asset.extras.get("left_out")
        for what in sentences if isinstance(sentences, list) else ():
            notes.say(" " + shown(str(what), quoted=False))
    used = {*header.extensionsUsed, *header.extensionsRequired}
    for name in sorted(used & set(EXTENSIONS) | used - set(READ)):
        notes.say(EXTENSIONS.get(name, UNKNOWN).format(name=shown(name, quoted=False)))
    drawn = header.below(header.scenes[header.scene or 0].nodes if header.scenes else range(len(header.nodes)))
    looks = header.materials
    kinds = {
        "occlusion map{s}: left out": (look.occlusionTexture is not None for look in looks),
        "normal map{s} with other texture coordinates than the base colour: left out": (
            not look.reads(look.normalTexture) for look in looks
        ),
        "emission texture{s} with other coordinates than the base colour: left out, with the emission": (
            any(look.emission) and not look.reads(look.emissiveTexture) for look in looks
        ),
        "material{s} with an alphaMode that glTF does not have: opaque": (
            look.alphaMode not in ("OPAQUE", *CUT_OUTS) for look in looks
        ),
        "further scene{s}: left out": (True for _ in header.scenes[1:]),
        "node{s} with a mesh outside of its scene: left out": (
            node.mesh is not None for index, node in enumerate(header.nodes) if index not in drawn
        ),
    }
    for sentence in _counts(kinds):
        notes.say(sentence)
    _note_unread(header, notes)


WORDS = {
    "Header": "entry",
    **dict.fromkeys(("MaterialEntry", "MetallicRoughness"), "entry of a material"),
    **dict.fromkeys(("TextureUse", "NormalUse"), "entry of a material's texture"),
    **{name: f"entry of a {name.lower()}" for name in ("Primitive", "Node", "Sampler", "Texture")},
    **{"MeshEntry": "entry of a mesh", "Image": "entry of an image", "LightEntry": "entry of a light"},
}
"""What is left out of entries whose contents are seen."""
PLAIN = frozenset(("name", "weights", "extensions"))
"""Keys without a field that make no difference, or are named with what they belong to."""


def _note_unread(header: Header, notes: Notes) -> None:
    """Note every key, extras of materials among them, and every attribute that is not read."""
    level: list[object] = [header]
    for entry in level:  # which grows
        if isinstance(entry, list):
            level.extend(inner for inner in entry if isinstance(inner, BaseModel))
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


def beside(header: Header, file: str) -> list[str]:
    """Return what a file of that name, read as one object, leaves out of its scene: one sentence, or none."""
    lights, cameras = ([getattr(node, kind) is not None for node in header.nodes] for kind in ("lamp", "camera"))
    what = _counts({"light{s}": lights, "camera{s}": cameras})
    left = f"{'is' if sum(lights + cameras) == 1 else 'are'} left out of the object"
    what_to_do = "name one node as the object, FILE#NODE, to keep the rest around it"
    return [f"{file}: {' and '.join(what)} {left}; {what_to_do}"] if what else []


def lights_and_cameras(header: Header, file: str) -> list[str]:
    """Return what becomes of lights and cameras that are not what they are in a file of that name."""
    distant = f"directional light{{s}}, here as lamps {FAR:g} object sizes away"
    ranged = "light{s} with a range, which is left out: light reaches beyond it"
    kinds = {
        distant: (light.type == "directional" for light in header.lights),
        ranged: (light.range is not None for light in header.lights),
        "camera{s} without perspective: left out": (camera.perspective is None for camera in header.cameras),
    }
    return [f"{file}: {sentence}" for sentence in _counts(kinds)]


def _counts(kinds: Mapping[str, Iterable[bool]]) -> list[str]:
    """Return how many there are of each kind, but for those of which there are none."""
    return [counted(count, what) for what, those in kinds.items() if (count := sum(those))]


def counted(count: int, what: str) -> str:
    """Return a count of things, whose words have {s} or {es} where several have that."""
    return f"{count} {what.format(s='' if count == 1 else 's', es='' if count == 1 else 'es')}"
