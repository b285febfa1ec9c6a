"""What a glTF file has and a scene of ours has not, in sentences: nothing is dropped in silence.

Every sentence begins with the name of the file, which the caller puts before it.
"""

from __future__ import annotations

from collections.abc import Iterator

from advsearch.scene.importing.files import shown
from advsearch.scene.importing.gltf_checks import READ
from advsearch.scene.importing.gltf_entries import CUT_OUTS, REPEAT, Header, MaterialEntry, MeshEntry

_OPAQUE = " lets light pass through surfaces with {name}; here they are opaque"

EXTENSIONS = {
    "EXT_mesh_gpu_instancing": " repeats meshes with {name}; each is there once",
    "KHR_materials_diffuse_transmission": _OPAQUE,
    "KHR_materials_pbrSpecularGlossiness": " has {name}, of which only diffuse colour and glossiness are read",
    "KHR_materials_transmission": _OPAQUE,
    "KHR_materials_unlit": " has surfaces that keep their colour in any light ({name}); here they are lit as others",
    "KHR_materials_variants": " has variants of its materials ({name}); those that it shows by itself are taken",
    "KHR_texture_transform": " moves its textures with {name}, which is not applied",
}
"""What becomes of a file with an extension; of all that are not named here, nor understood, `UNKNOWN`."""

UNKNOWN = " uses {name}, which is not understood and left out"

FAR = 1000.0
"""Distance of a directional light, in object sizes."""


def left_out(header: Header) -> Iterator[str]:
    """Yield what the file has that is not carried over, whether one node or all of it is the object."""
    used = {*header.extensionsUsed, *header.extensionsRequired}
    for name in sorted(used & set(EXTENSIONS) | used - set(READ)):
        yield EXTENSIONS.get(name, UNKNOWN).format(name=shown(name, quoted=False))
    drawn = _in_the_scene(header)
    absent = sum(node.mesh is not None for index, node in enumerate(header.nodes) if index not in drawn)
    found = {
        "occlusion map{s}: left out": sum(one.occlusionTexture is not None for one in header.materials),
        "mesh{es} with morph targets, which are left out": sum(map(_is_morphed, header.meshes)),
        "mesh{es} with an opacity in vertex colours, which is left out": sum(
            _has_see_through_vertices(header, mesh) for mesh in header.meshes
        ),
        "skin{s}: what is bound to bones stays as it was drawn": _length(header.skins),
        "animation{s}: left out": _length(header.animations),
        "further scene{s}: left out": max(0, len(header.scenes) - 1),
        "node{s} with a mesh outside of its scene: left out": absent,
    }
    for what, count in found.items():
        if count:
            yield f": {_counted(count, what)}"


def beside(header: Header) -> str | None:
    """Return what a file read as one object leaves out of its scene; None if nothing."""
    lights = sum(node.lamp is not None for node in header.nodes)
    cameras = sum(node.camera is not None for node in header.nodes)
    counted = [_counted(count, what) for count, what in ((lights, "light{s}"), (cameras, "camera{s}")) if count]
    if not counted:
        return None
    verb = "is" if lights + cameras == 1 else "are"
    what_to_do = "name one node as the object, FILE#NODE, to keep the rest around it"
    return f": {' and '.join(counted)} {verb} left out of the object; {what_to_do}"


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
    yield from (f": {_counted(count, what)}" for what, count in found.items() if count)


EDGES = " has textures that are not to repeat beyond their edges; here they do"


def repeats(header: Header, material: MaterialEntry) -> bool:
    """Whether the textures of a material go on beyond their edges as all do here."""
    surface = material.plain().pbrMetallicRoughness
    uses = (surface.baseColorTexture, surface.metallicRoughnessTexture) if surface else ()
    numbers = [use.index for use in (*uses, material.normalTexture, material.emissiveTexture) if use is not None]
    samplers = [header.textures[number].sampler for number in numbers]
    found = [header.samplers[number] for number in samplers if number is not None]
    return all(one.wrapS == one.wrapT == REPEAT for one in found)


def _counted(count: int, what: str) -> str:
    return f"{count} {what.format(s='' if count == 1 else 's', es='' if count == 1 else 'es')}"


def _length(entries: object) -> int:
    return len(entries) if isinstance(entries, list) else 0


def _is_morphed(mesh: MeshEntry) -> bool:
    return any(primitive.targets for primitive in mesh.primitives)


def _has_see_through_vertices(header: Header, mesh: MeshEntry) -> bool:
    """Whether the colours of its vertices have an alpha that its material lets count."""
    return any(
        primitive.material is not None
        and header.materials[primitive.material].alphaMode in CUT_OUTS
        and "COLOR_0" in primitive.attributes
        and header.accessors[primitive.attributes["COLOR_0"]].type == "VEC4"
        for primitive in mesh.primitives
    )


def _in_the_scene(header: Header) -> set[int]:
    """The nodes of the scene that is read."""
    if not header.scenes:
        return set(range(len(header.nodes)))
    found: set[int] = set()
    level = list(header.scenes[header.scene or 0].nodes)
    while level:
        found.update(level)
        level = [child for index in level for child in header.nodes[index].children]
    return found
