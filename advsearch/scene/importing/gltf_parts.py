"""glTF files as a list of parts: the primitives that its nodes draw, in their places."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from advsearch.errors import FileFormatError
from advsearch.scene.importing import gltf_notes
from advsearch.scene.importing.files import References, check_faces, damaged
from advsearch.scene.importing.gltf import Buffers, binary_chunk, read_header
from advsearch.scene.importing.gltf_entries import CUT_OUTS, Header, MaterialEntry, Node, Primitive, TextureUse
from advsearch.scene.importing.gltf_surfaces import GltfSurfaces
from advsearch.scene.importing.imported_part import ImportedPart, placed
from advsearch.scene.importing.surfaces import ImportedSurface

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

TRIANGLES, STRIP, FAN = 4, 5, 6
"""Modes of primitives; those below are points and lines."""

SEE_THROUGH = "mesh{es} with an opacity in vertex colours, which is left out"
DEFAULT = "mesh{es} without material: of white metal with roughness 1, the default of glTF"


@np.errstate(all="ignore")
def read_gltf(path: Path, data: bytes) -> tuple[list[ImportedPart], list[str]]:
    """Parse a glTF file; arguments, results and errors as for `advsearch.scene.importing.objects.read_parts`."""
    header, references = read_header(path, data), References(path)
    chunk = None if path.suffix.lower() == ".gltf" else binary_chunk(data)
    buffers = Buffers(path, header, chunk, references)
    drawn = [(node, pose) for node, pose in poses(header) if header.nodes[node].mesh is not None]
    drawn.sort(key=lambda item: item[0])
    meshes = {mesh: header.meshes[mesh] for node, _ in drawn if (mesh := header.nodes[node].mesh) is not None}
    pieces = {
        (mesh, number): _piece(path, header, buffers, primitive)
        for mesh, entry in meshes.items()
        for number, primitive in enumerate(entry.primitives)
    }
    found = {key: piece for key, piece in pieces.items() if piece is not None and len(piece.part.faces)}
    if not found:
        got = "points or lines only" if pieces else "none"
        raise FileFormatError(f"{path}: expected a mesh with faces, got {got}; export triangles")
    notes = [path.name + what for what in gltf_notes.left_out(header)]
    if len(found) < len(pieces):
        notes.append(f"{path.name}: {len(pieces) - len(found)} parts without faces (points, lines) are left out")
    for words, keys in (
        (SEE_THROUGH, [mesh for (mesh, _), piece in found.items() if piece.see_through]),
        (DEFAULT, [mesh for (mesh, _), piece in found.items() if piece.material is None]),
    ):
        if keys:
            notes.append(f"{path.name}: {gltf_notes.counted(len(set(keys)), words)}")
    surfaces = GltfSurfaces(path.name, header, buffers, references)
    groups: dict[int | None, dict[tuple[int, int], ImportedPart]] = {}
    for key, piece in found.items():
        groups.setdefault(piece.material, {})[key] = piece.part
    finished = {}
    for material, group in groups.items():
        surface, fit = surfaces.surface(material, [part.uvs for part in group.values() if part.uvs is not None])
        for key, part in group.items():
            finished[key] = replace(part, surface=surface, uvs=None if part.uvs is None else _upwards(fit(part.uvs)))
    parts = [
        replace(placed(finished[mesh, number], pose), node=node)
        for node, pose in drawn
        if (mesh := header.nodes[node].mesh) is not None
        for number in range(len(header.meshes[mesh].primitives))
        if (mesh, number) in finished
    ]
    check_faces(path, sum(len(part.faces) for part in parts))
    return parts, [*notes, *surfaces.notes]


@dataclass(frozen=True, eq=False)
class _Piece:
    """A primitive as it is stored, without surface; its texture coordinates are the format's, v = 0 at the top.

    Attributes:
        part: its geometry.
        material: its number.
        see_through: it has vertex colours whose alpha would count.
    """

    part: ImportedPart
    material: int | None
    see_through: bool


def _piece(path: Path, header: Header, buffers: Buffers, primitive: Primitive) -> _Piece | None:
    """Return a primitive; None for points, lines and what has no places."""
    held = primitive.attributes
    if primitive.mode < TRIANGLES or "POSITION" not in held:
        return None
    count = header.accessors[held["POSITION"]].count
    if primitive.indices is None:
        order = np.arange(count)
    else:
        order = buffers.values(primitive.indices)[:, 0].astype(np.int64)
    if len(order) and order.max() >= count:
        raise damaged(path, "faces of its own vertices", "a face that refers to a vertex that is not there")
    used, corners = np.unique(_triangles(order, primitive.mode), return_inverse=True)  # others may share the vertices
    faces, vertices = corners.reshape(-1, 3).astype(np.int64), buffers.numbers(held["POSITION"], used)
    material = MaterialEntry() if primitive.material is None else header.materials[primitive.material]
    uvs = colors = None
    see_through = False
    if material.attribute in held:
        uvs = _moved(buffers.numbers(held[material.attribute], used), material.layout)
    if "COLOR_0" in held:
        given = np.clip(np.nan_to_num(buffers.numbers(held["COLOR_0"], used)), 0.0, 1.0)
        colors = given[:, :3][faces]
        see_through = material.alphaMode in CUT_OUTS and given.shape[1] == 4 and bool((given[:, 3] < 1.0).any())
    normals = buffers.numbers(held["NORMAL"], used) if "NORMAL" in held else None
    part = ImportedPart(vertices, faces, normals, uvs, colors, ImportedSurface(), flat=True)
    return _Piece(part, primitive.material, see_through)


def _triangles(order: Ints, mode: int) -> Ints:
    """Return the faces (F, 3) of a primitive (section 3.7.2.1) with vertices in that order."""
    if mode == TRIANGLES:
        return order[: len(order) // 3 * 3].reshape(-1, 3)
    number = np.arange(max(0, len(order) - 2))
    if mode == STRIP:
        corners = np.stack([number, number + 1 + number % 2, number + 2 - number % 2], axis=1)
    else:
        corners = np.stack([number + 1, number + 2, np.zeros_like(number)], axis=1)
    faces = order[corners]
    joints = (faces == np.roll(faces, 1, axis=1)).any(axis=1)  # with which strips go on elsewhere
    return np.asarray(faces[~joints], np.int64)


def _moved(uvs: Array, use: TextureUse | None) -> Array:
    """Return texture coordinates (V, 2) as the transform of a texture moves them."""
    if use is None:
        return uvs
    given = use.transform
    sine, cosine = np.sin(given.rotation), np.cos(given.rotation)
    u, v = (uvs * given.scale).T
    return np.stack([cosine * u + sine * v, cosine * v - sine * u], axis=1) + given.offset


def _upwards(uvs: Array) -> Array:
    """Return texture coordinates with v = 0 at the bottom."""
    return uvs * [1.0, -1.0] + [0.0, 1.0]


def poses(header: Header) -> Iterator[tuple[int, Array]]:
    """Yield the nodes of the file's scene with their poses (4, 4) in it."""
    children = {child for node in header.nodes for child in node.children}
    roots = [index for index in range(len(header.nodes)) if index not in children]
    if header.scenes:
        roots = list(header.scenes[header.scene or 0].nodes)
    level = [(index, np.eye(4)) for index in roots]
    while level:
        index, above = level.pop()
        pose = above @ _matrix(header.nodes[index])
        yield index, pose
        level.extend((child, pose) for child in header.nodes[index].children)


def _matrix(node: Node) -> Array:
    """The transform (4, 4) of one node."""
    if node.matrix is not None:
        return np.asarray(np.array(node.matrix, dtype=np.float64).reshape(4, 4).T)
    matrix = np.eye(4)
    x, y, z, w = np.array(node.rotation or [0.0, 0.0, 0.0, 1.0]) / max(
        float(np.linalg.norm(node.rotation or 1.0)), 1e-12
    )
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    matrix[:3, :3] = turn * np.array(node.scale or [1.0, 1.0, 1.0])
    matrix[:3, 3] = node.translation or [0.0, 0.0, 0.0]
    return matrix
