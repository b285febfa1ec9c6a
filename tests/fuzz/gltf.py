"""glTF in JSON and binary: other types, hostile counts, planted references, odd trees of nodes."""

from __future__ import annotations

import base64
import json
import math
import struct
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from fuzz.case import OUTSIDE, Case, Maker, Random
from fuzz.mutations import INTEGERS, VALUES, as_json, confused, damaged
from fuzz.pictures import picture, sample


@cache
def box_glb() -> bytes:
    """Return a textured box in a tree of two nodes."""
    box = trimesh.creation.box()
    pixels = np.arange(256, dtype=np.uint8).reshape(8, 8, 4)
    material = PBRMaterial(
        baseColorTexture=Image.fromarray(pixels), baseColorFactor=[0.5, 0.6, 0.7, 0.9], roughnessFactor=0.4,
        alphaMode="MASK", alphaCutoff=0.3, emissiveFactor=[1.0, 0.5, 0.1],
        normalTexture=Image.fromarray(pixels[::-1, :, :3]), emissiveTexture=Image.fromarray(pixels[:, ::-1, :3]),
    )  # fmt: skip
    box.visual = TextureVisuals(uv=box.vertices[:, :2] + 0.5, material=material)
    scene = trimesh.Scene(box)
    scene.add_geometry(trimesh.creation.icosphere(subdivisions=1), transform=trimesh.transformations.scale_matrix(0.5))
    written: bytes = scene.export(file_type="glb")
    return written


def parts(data: bytes) -> tuple[dict[str, Any], bytes]:
    """Return the header and the binary chunk of a GLB."""
    length = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def glb(header: Any, binary: bytes) -> bytes:
    """Return a GLB."""
    text = as_json(header)
    text += b" " * (-len(text) % 4)
    binary += bytes(-len(binary) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def case(random: Random, what: str, header: Any, binary: bytes, extra: dict[str, bytes] | None = None) -> Case:
    """Return a header and its binary data as .glb, .gltf with a file beside it, or .gltf with all inside."""
    form = random.choice(("glb", "gltf", "inside"))
    if form == "glb" or not isinstance(header, dict):
        return Case(f"gltf: glb {what}", "object", "thing.glb", {"thing.glb": glb(header, binary), **(extra or {})})
    header = json.loads(as_json(header))
    uri = "thing.bin" if form == "gltf" else "data:application/octet-stream;base64," + base64.b64encode(binary).decode()
    try:
        header["buffers"][0].setdefault("uri", uri)
    except (KeyError, IndexError, TypeError, AttributeError):
        pass
    files = {"thing.gltf": as_json(header), "thing.bin": binary, **(extra or {})}
    return Case(f"gltf: {form} {what}", "object", "thing.gltf", files)


def bytes_damaged(random: Random) -> Case:
    """A GLB with damaged bytes."""
    what, data = damaged(random, box_glb())
    return Case(f"gltf: glb {what}", "object", "thing.glb", {"thing.glb": data})


def types_confused(random: Random) -> Case:
    """A header with other types in it."""
    header, binary = parts(box_glb())
    return case(random, "types", confused(random, header), binary)


def text(random: Random) -> Case:
    """JSON that is hostile as text."""
    kinds: dict[str, Callable[[], bytes]] = {
        "nested lists": lambda: b"[" * 100_000 + b"]" * 100_000,
        "nested nodes": lambda: b'{"asset": {"version": "2.0"}, "extras": ' + b'{"a":' * 90_000 + b"1" + b"}" * 90_001,
        "an integer of 6,000 digits": lambda: b'{"asset": {"version": "2.0"}, "scene": ' + b"9" * 6_000 + b"}",
        "two million empty lists": lambda: b'{"asset": {"version": "2.0"}, "nodes": [' + b"[]," * 2_000_000 + b"[]]}",
        "a name of 5,000 characters": lambda: b'{"asset": {"version": "' + b"2" * 5_000 + b'"}}',
        "a list": lambda: b"[1, 2]",
        "a number": lambda: b"1",
        "a string": lambda: b'"asset"',
        "an asset of null": lambda: b'{"asset": null}',
        "no text": lambda: b"\xff\xfe\x00\x00",
        "a lone surrogate": lambda: b'{"asset": {"version": "2.0"}, "scenes": [{"name": "\\ud800"}]}',
    }
    what = random.choice(sorted(kinds))
    return Case(f"gltf: {what}", "object", "thing.gltf", {"thing.gltf": kinds[what]()})


def counts(random: Random) -> Case:
    """Accessors and views with hostile numbers."""
    header, binary = parts(box_glb())
    what = random.choice(("count", "no view", "stride", "sparse", "views", "length", "offset", "type"))
    accessor = random.choice(header["accessors"])
    view = header["bufferViews"][accessor["bufferView"]]
    if what == "count":
        accessor["count"] = random.choice((*INTEGERS, -1, 10**12))
    elif what == "no view":
        del accessor["bufferView"]
        accessor["count"] = random.choice((10**7, 10**9, 10**12, 3))
    elif what == "stride":
        view["byteStride"] = random.choice((0, 1, 2, 4, 252, -4, 2**31))
        accessor["count"] = random.choice((3, 100, 10**6))
    elif what == "sparse":
        accessor["sparse"] = {"count": random.choice((1, 10**9)), "indices": {"bufferView": 0, "componentType": 5123}}
    elif what == "views":
        header["bufferViews"] += [{"buffer": 0, "byteLength": len(binary)}] * 20_000
        binary += bytes(1_000_000)
        for extra in header["bufferViews"][-20_000:]:
            extra["byteLength"] = len(binary)
    elif what == "length":
        view["byteLength"] = random.choice((*INTEGERS, -1))
    elif what == "offset":
        random.choice((view, accessor))["byteOffset"] = random.choice((*INTEGERS, -1, -4))
    else:
        accessor["type"] = random.choice(("SCALAR", "VEC2", "VEC4", "MAT4", "VEC9"))
        accessor["componentType"] = random.choice((5120, 5121, 5122, 5123, 5125, 5126, 5130, 9999))
    return case(random, what, header, binary)


def trees(random: Random) -> Case:
    """Odd trees of nodes."""
    header, binary = parts(box_glb())
    what = random.choice(("cycle", "itself", "deep", "doubling", "instances", "primitives", "matrix", "scene", "names"))
    nodes = header["nodes"]
    roots = header["scenes"][0]["nodes"]
    meshes = len(header["meshes"])
    first = len(nodes)
    if what == "cycle":
        nodes += [{"children": [first + 1]}, {"children": [first], "mesh": 0}]
        roots.append(first)
    elif what == "itself":
        nodes.append({"children": [first], "mesh": 0})
        roots.append(first)
    elif what == "deep":
        depth = random.choice((200, 5_000, 50_000))
        nodes += [{"children": [first + k + 1]} for k in range(depth)] + [{"mesh": 0}]
        roots.append(first)
    elif what == "doubling":
        nodes += [{"children": [first + k + 1] * 2} for k in range(40)] + [{"mesh": 0}]
        roots.append(first)
    elif what == "instances":
        nodes += [{"mesh": k % meshes, "translation": [k, 0, 0]} for k in range(random.choice((100, 30_000)))]
        roots += range(first, len(nodes))
    elif what == "primitives":
        header["meshes"][0]["primitives"] *= random.choice((100, 20_000))
    elif what == "matrix":
        values = random.choice(([0] * 16, [1e308] * 16, [1] * 15, ["a"] * 16, [float("nan")] * 16, [1e-300] * 16, 1))
        nodes[-1]["matrix"] = values
    elif what == "scene":
        header["scene"] = random.choice((-1, 7, "0", [0], None, 10**30))
    else:
        for thing in (*nodes, *header["meshes"], *header["materials"]):
            thing["name"] = random.choice(("world", "x" * 5_000, "\x1b[31m", "", "../..", "\u202e"))
    return case(random, what, header, binary)


NAMES = (
    "KHR_materials_transmission",
    "KHR_materials_unlit",
    "KHR_materials_emissive_strength",
    "KHR_materials_pbrSpecularGlossiness",
    "KHR_lights_punctual",
    "EXT_texture_webp",
    "EXT_mesh_gpu_instancing",
    "KHR_texture_transform",
    "ACME_paint",
    "x" * 5_000,
    "\x1b[31m",
    "{name}",
    "\u202e",
    "",
)
HOSTILE = (0.0, -1.0, 1, 1e-30, 1e-3, 1e30, 1e11, 1e308, -1e308, 3.0, 0.5, float("nan"), "1", [1])


def extensions(random: Random) -> Case:
    """Extensions anywhere, with anything in them, listed or not, and required."""
    header, binary = parts(box_glb())
    what = random.choice(("inside", "listed", "required", "many", "lists of none"))
    names = random.sample(NAMES, 3)
    held: dict[str, Any] = {name: random.choice((*VALUES, {"attributes": {"TRANSLATION": 7}})) for name in names}
    if what == "inside":
        homes = [header, *(random.choice(header[kind]) for kind in ("nodes", "meshes", "materials", "textures"))]
        random.choice(homes)["extensions"] = held
    elif what == "many":
        header["extensionsUsed"] = [f"ACME_{k}" for k in range(random.choice((100, 200_000)))]
    elif what == "lists of none":
        header[random.choice(("extensionsUsed", "extensionsRequired"))] = random.choice(VALUES)
    else:
        header["extensionsUsed"] = names
        header["extensionsRequired"] = names if what == "required" else []
    return case(random, f"extensions {what}", header, binary)


def moving(random: Random) -> Case:
    """Skins, animations, morph targets, and scenes beside the one that is read."""
    header, binary = parts(box_glb())
    what = random.choice(("skins", "animations", "targets", "scenes", "skin of a node", "weights"))
    anything = random.choice((*VALUES, [{}] * random.choice((1, 100_000)), [{"joints": [10**9, -1]}]))
    primitive = header["meshes"][0]["primitives"][0]
    if what == "targets":
        primitive["targets"] = random.choice((anything, [{"POSITION": 10**9}], [{"POSITION": 0}] * 1_000))
        header["meshes"][0]["weights"] = random.choice(([1e308], [float("nan")], "x", []))
    elif what == "scenes":
        header["scenes"] += random.choice(([{}] * 10_000, [{"nodes": [10**9]}], [{"nodes": [0, 0, 0]}], [None]))
    elif what == "skin of a node":
        header["nodes"][-1]["skin"] = random.choice((0, 10**9, -1, "x"))
    elif what == "weights":
        primitive["attributes"] |= {
            "JOINTS_0": primitive["attributes"]["POSITION"],
            "WEIGHTS_0": random.choice((0, 999)),
        }
    else:
        header[what] = anything
    return case(random, what, header, binary)


def lights(random: Random) -> Case:
    """Lights, of them spots above all, and cameras, with hostile numbers, around a node."""
    header, binary = parts(box_glb())
    light: dict[str, Any] = {"type": random.choice(("spot", "spot", "spot", "point", "directional", "sun"))}
    light["spot"] = {"innerConeAngle": 0.2, "outerConeAngle": 0.6}
    place: dict[str, Any] = {"translation": [0.0, 3.0, 0.0], "rotation": [-0.7, 0.0, 0.0, 0.7]}
    camera: dict[str, Any] = {"type": "perspective", "perspective": {"yfov": 0.8, "aspectRatio": 1.5}}
    for _ in range(random.choice((1, 1, 1, 2))):
        what = random.choice(
            ("inner", "outer", "spot", "intensity", "color", "range", "place", "camera", "use", "name")
        )
        value = random.choice((*HOSTILE, math.pi / 2, math.pi / 4))
        if what in ("inner", "outer"):
            light["spot"] = {**light["spot"], f"{what}ConeAngle": value} if isinstance(light["spot"], dict) else {}
        elif what == "color":
            light["color"] = random.choice(([value] * 3, [1, 1, value], [1.0], value))
        elif what == "place":
            three = [value, 0.0, random.choice(HOSTILE)]
            place |= random.choice(({"translation": three}, {"scale": three}, {"rotation": [*three, value]}))
        elif what == "camera":
            camera["perspective"] = {"yfov": value, "aspectRatio": random.choice(HOSTILE)}
            camera["type"] = random.choice(("perspective", "orthographic"))
        elif what == "use":
            place["extensions"] = {"KHR_lights_punctual": random.choice(({"light": 7}, {}, {"light": "0"}, 0))}
        else:
            light[what] = random.choice(VALUES) if what == "spot" else value
    use = {"extensions": {"KHR_lights_punctual": {"light": 0}}, **place}
    header["extensions"] = {"KHR_lights_punctual": {"lights": [light] * random.choice((1, 1, 1, 5_000))}}
    header["cameras"] = [camera]
    first = len(header["nodes"])
    header["nodes"] += [use, {**place, "camera": 0}]
    header["scenes"][0]["nodes"] += [first, first + 1]
    return replace(case(random, f"lights {light['type']}", header, binary), loader="node")


def images(random: Random) -> Case:
    """Images that are hostile, or somewhere else."""
    header, binary = parts(box_glb())
    target = random.choice(
        (
            "../outside/secret.png",
            OUTSIDE.decode() + "/secret.png",
            "%2e%2e%2foutside%2fsecret.png",
            "link.png",
            "/dev/zero",
            "data:image/png;base64," + base64.b64encode(picture(random)[1]).decode()[:2_000_000],
            "data:image/png;base64,****",
            "data:image/png," + "x" * 5_000,
            "wood.png",
            "wood.png",
            "x" * 5_000,
            "http://127.0.0.1:9/wood.png",
        )
    )
    what, data = picture(random)
    if random.random() < 0.3:
        header["buffers"].append({"uri": target.replace(".png", ".bin"), "byteLength": 64})
        header["bufferViews"].append({"buffer": len(header["buffers"]) - 1, "byteLength": 64})
        what = "buffer elsewhere"
    else:
        header["images"] = [{"uri": target}] * random.choice((1, 1, 300))
        header["textures"] = [{"source": k} for k in range(len(header["images"]))]
        what = f"image {target[:30]!r} {what}" if target == "wood.png" else f"image {target[:30]!r}"
    found = case(random, what, header, binary, {"wood.png": data if data else sample("PNG")})
    return Case(
        found.what,
        found.loader,
        found.main,
        found.files,
        {"link.png": "../outside/secret.png", "link.bin": "../outside/secret.bin"},
    )


def looks(random: Random) -> Case:
    """Samplers, transforms of textures, colours of vertices, sparse accessors and strips, with hostile numbers."""
    header, binary = parts(box_glb())
    what = random.choice(("sampler", "transform", "colors", "sparse", "mode", "quantized", "alpha", "many"))
    primitive, material = header["meshes"][0]["primitives"][0], header["materials"][0]
    accessor = header["accessors"][primitive["attributes"][random.choice(("POSITION", "TEXCOORD_0"))]]
    numbers = (*HOSTILE, *INTEGERS)
    if what == "sampler":
        wraps = (10497, 33648, 33071, *INTEGERS, "x")
        header["samplers"] = [{"wrapS": random.choice(wraps), "wrapT": random.choice(wraps), "magFilter": 9728}]
        for texture in header["textures"]:
            texture["sampler"] = random.choice((0, 0, 0, 1))
    if what in ("sampler", "transform"):
        moved = {"offset": [random.choice(numbers)] * 2, "scale": [random.choice(numbers), 1.0]}
        further: tuple[dict[str, Any], ...] = (
            {}, {"rotation": random.choice(numbers)}, {"texCoord": random.choice(INTEGERS)},
        )  # fmt: skip
        moved |= random.choice(further)
        uses = (material["pbrMetallicRoughness"]["baseColorTexture"], material["normalTexture"])
        for use in random.sample(uses, random.choice((1, 2))):
            use["extensions"] = {"KHR_texture_transform": moved}
    elif what == "colors":
        primitive["attributes"]["COLOR_0"] = random.randrange(len(header["accessors"]))
    elif what == "sparse":
        given = {
            "bufferView": random.randrange(len(header["bufferViews"])),
            "byteOffset": random.choice((0, *INTEGERS)),
        }
        count = random.choice((0, 1, 4, 10**7, *INTEGERS))
        accessor["sparse"] = {"count": count, "values": given, "indices": {**given, "componentType": 5121}}
        accessor["count"] = random.choice((accessor["count"], 10**7, 8 * 10**7))
        if random.random() < 0.5:
            del accessor["bufferView"]
    elif what == "mode":
        primitive["mode"] = random.choice((0, 3, 5, 6, 6, 7))
        primitive.pop("indices" if random.random() < 0.5 else "material", None)
    elif what == "quantized":
        accessor |= {
            "componentType": random.choice((5120, 5121, 5122, 5123, 5125)),
            "normalized": random.random() < 0.5,
        }
        accessor["byteOffset"] = random.choice((0, 1, 3, 1000))
    elif what == "alpha":
        material |= {"alphaMode": random.choice(("MASK", "BLEND", "mask", 1)), "alphaCutoff": random.choice(numbers)}
        material["pbrMetallicRoughness"]["baseColorFactor"] = [random.choice(numbers)] * 4
    else:  # materials and primitives that share all they have
        header["samplers"] = [{"magFilter": 9728, "wrapS": 33648}]
        for texture in header["textures"]:
            texture["sampler"] = 0
        header["materials"] *= 1_000
        header["meshes"][0]["primitives"] = [{**primitive, "material": number} for number in range(1_000)]
    return case(random, f"looks: {what}", header, binary)


MAKERS: tuple[Maker, ...] = (
    bytes_damaged,
    looks,
    looks,
    types_confused,
    counts,
    trees,
    images,
    types_confused,
    text,
    extensions,
    moving,
    lights,
    lights,
)
