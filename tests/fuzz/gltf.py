"""glTF in JSON and binary: other types, hostile counts, planted references, odd trees of nodes."""

import base64
import json
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
from fuzz.mutations import INTEGERS, as_json, confused, damaged
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


@cache
def everything() -> tuple[dict[str, Any], bytes]:
    """Return a header and its binary data with something of all that glTF has."""
    header, binary = parts(box_glb())

    def accessor(values: np.ndarray, kind: str, component: int) -> int:
        nonlocal binary
        binary += bytes(-len(binary) % 4)
        header["bufferViews"].append({"buffer": 0, "byteOffset": len(binary), "byteLength": values.nbytes})
        view = {"bufferView": len(header["bufferViews"]) - 1, "componentType": component}
        header["accessors"].append({**view, "count": len(values), "type": kind})
        binary += values.tobytes()
        return len(header["accessors"]) - 1

    primitive = header["meshes"][0]["primitives"][0]
    material = header["materials"][0]
    positions = header["accessors"][primitive["attributes"]["POSITION"]]
    count = positions["count"]
    primitive["attributes"] |= {
        "COLOR_0": accessor(np.full((count, 3), 0.5, "<f4"), "VEC3", 5126),
        "JOINTS_0": accessor(np.zeros((count, 4), np.uint8), "VEC4", 5121),
        "WEIGHTS_0": accessor(np.tile(np.array([1, 0, 0, 0], "<f4"), (count, 1)), "VEC4", 5126),
    }
    primitive["targets"] = [{"POSITION": accessor(np.zeros((count, 3), "<f4"), "VEC3", 5126)}]
    indices, values = accessor(np.zeros(1, np.uint8), "SCALAR", 5121), accessor(np.zeros((1, 3), "<f4"), "VEC3", 5126)
    positions["sparse"] = {
        "count": 1,
        "indices": {"bufferView": header["accessors"][indices]["bufferView"], "componentType": 5121},
        "values": {"bufferView": header["accessors"][values]["bufferView"]},
    }
    times, places = (
        accessor(np.arange(2, dtype="<f4"), "SCALAR", 5126),
        accessor(np.eye(2, 3, dtype="<f4"), "VEC3", 5126),
    )
    first = len(header["nodes"])
    target = {"node": first, "path": "translation"}
    header |= {
        "samplers": [{"wrapS": 33648, "wrapT": 33071, "magFilter": 9728}],
        "skins": [{"joints": [first]}],
        "animations": [
            {"channels": [{"sampler": 0, "target": target}], "samplers": [{"input": times, "output": places}]}
        ],
        "cameras": [{"type": "perspective", "perspective": {"yfov": 0.8, "aspectRatio": 1.5}}],
        "extensionsUsed": ["KHR_lights_punctual", "KHR_texture_transform", "ACME_paint"],
        "extensions": {
            "KHR_lights_punctual": {
                "lights": [
                    {
                        "type": kind,
                        "intensity": 3.0,
                        "color": [1, 0.5, 0.2],
                        "range": 9.0,
                        "spot": {"innerConeAngle": 0.2, "outerConeAngle": 0.6},
                    }
                    for kind in ("spot", "point", "directional")
                ]
            }
        },
    }
    header["meshes"][0]["weights"] = [0.5]
    for texture in header["textures"]:
        texture["sampler"] = 0
    for use in (material["pbrMetallicRoughness"]["baseColorTexture"], material["normalTexture"]):
        moved = {"offset": [0.1, 0.2], "scale": [2, 1], "rotation": 0.3, "texCoord": 0}
        use["extensions"] = {"KHR_texture_transform": moved, "ACME_paint": {"strength": 1}}
    place = {"translation": [0.0, 3.0, 0.0], "rotation": [-0.7, 0.0, 0.0, 0.7]}
    header["nodes"] += [{**place, "extensions": {"KHR_lights_punctual": {"light": k}}} for k in range(3)]
    header["nodes"].append({**place, "camera": 0})
    header["scenes"][0]["nodes"] += range(first, first + 4)
    return header, binary


def types_confused(random: Random) -> Case:
    """A header with other types and numbers in it, read as an object or as a scene."""
    header, binary = everything()
    found = case(random, "types", confused(random, header), binary)
    return replace(found, loader=random.choice(("object", "node")))


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


def bombs(random: Random) -> Case:
    """A small file that says that it has very much of something, or something inside of itself."""
    header, binary = parts(box_glb())
    nodes, roots, primitives = header["nodes"], header["scenes"][0]["nodes"], header["meshes"][0]["primitives"]
    first, many = len(nodes), random.choice((100, 5_000, 50_000))
    whole_view = {"buffer": 0, "byteLength": 1_000_000}

    def chain(of: list[list[int]]) -> None:
        nodes.extend({"children": children} for children in of)
        nodes.append({"mesh": 0})
        roots.append(first)

    kinds: dict[str, Callable[[], object]] = {
        "a cycle": lambda: chain([[first + 1], [first]]),
        "a deep tree": lambda: chain([[first + k + 1] for k in range(many)]),
        "a tree that doubles": lambda: chain([[first + k + 1] * 2 for k in range(40)]),
        "instances": lambda: (
            nodes.extend({"mesh": 0, "translation": [k, 0, 0]} for k in range(many)),
            roots.extend(range(first, len(nodes))),
        ),
        "primitives": lambda: primitives.extend(primitives * many),
        "materials": lambda: (
            header.update(materials=header["materials"] * 1_000),
            primitives.extend({**primitives[0], "material": k} for k in range(1_000)),
        ),
        "views": lambda: header["bufferViews"].extend([whole_view] * many),
        "a count": lambda: header["accessors"][0].update(count=random.choice((*INTEGERS, -1, 10**12))),
        "a count without a view": lambda: (
            header["accessors"][0].pop("bufferView"),
            header["accessors"][0].update(count=random.choice((10**7, 10**9))),
        ),
        "extensions": lambda: header.update(extensionsUsed=[f"ACME_{k}" for k in range(many)]),
        "skins": lambda: header.update(skins=[{"joints": [10**9, -1]}] * many),
        "lights": lambda: header.update(extensions={"KHR_lights_punctual": {"lights": [{"type": "spot"}] * many}}),
    }
    what = random.choice(sorted(kinds))
    kinds[what]()
    return case(random, what, header, binary + bytes(1_000_000 if what == "views" else 0))


def images(random: Random) -> Case:
    """Images that are hostile, or somewhere else."""
    header, binary = parts(box_glb())
    targets = "../outside/secret.png %2e%2e%2foutside%2fsecret.png link.png /dev/zero wood.png".split()
    targets += [OUTSIDE.decode() + "/secret.png", "x" * 5_000, "http://127.0.0.1:9/wood.png"]
    targets += ["data:image/png;base64,****", "data:image/png," + "x" * 5_000]
    targets.append("data:image/png;base64," + base64.b64encode(picture(random)[1]).decode()[:2_000_000])
    target = random.choice(targets)
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
    return replace(found, links={"link.png": "../outside/secret.png", "link.bin": "../outside/secret.bin"})


MAKERS: tuple[Maker, ...] = (
    bytes_damaged,
    *([types_confused] * 4),
    bombs,
    images,
    text,
)
