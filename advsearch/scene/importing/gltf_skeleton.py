"""What moves in a glTF file: its nodes, skins, morph targets and clips (glTF 2.0,
sections 3.5 to 3.11).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from advsearch.scene.assets import Doubles, Ints
from advsearch.scene.importing.files import Names, clean, damaged
from advsearch.scene.importing.gltf import GltfFile
from advsearch.scene.importing.gltf_entries import (
    Animation,
    Channel,
    Header,
    Node,
    Primitive,
    Skin,
)
from advsearch.scene.importing.parts import ImportedPart, put
from advsearch.scene.skeleton import (
    Clip,
    Skeleton,
    Target,
    Track,
    entries_of_turn,
    with_above,
)
from advsearch.trust.stored_files import check_most

MOST_SETS = 8  # sets of four joints of a vertex
MOST_KEYS = 1 << 24
"""Numbers in the keys of all clips together, before `scaled`; one accessor may stand
for many.
"""
MOST_MOVES = 1 << 25
"""Vertices that all morph targets move together, and inverse bind matrices, before
`scaled`.
"""
WIDTHS = {"translation": 3, "rotation": 4, "scale": 3, "weights": 1}
"""Numbers of a value of each property that a channel may set; of `weights`, of each
morph target.
"""
SHORTEST = 1e-6  # length of a quaternion, at least; the format says 1


def poses(header: Header) -> Iterator[tuple[int, Doubles]]:
    """Yield the nodes of the file's scene with their poses (4, 4) in it."""
    children = {child for node in header.nodes for child in node.children}
    roots = [index for index in range(len(header.nodes)) if index not in children]
    if header.scenes:
        roots = list(header.scenes[header.scene or 0].nodes)
    level = [(index, np.eye(4)) for index in roots]
    while level:
        index, above = level.pop()
        pose = above @ matrix_of(header.nodes[index])
        yield index, pose
        level.extend((child, pose) for child in header.nodes[index].children)


def matrix_of(node: Node) -> Doubles:
    if node.matrix is not None:
        return np.asarray(np.array(node.matrix, dtype=np.float64).reshape(4, 4).T)
    matrix = np.eye(4)
    turn = np.array(node.rotation or [0.0, 0.0, 0.0, 1.0]) / max(
        float(np.linalg.norm(node.rotation or 1.0)), 1e-12
    )
    matrix[:3, :3] = np.reshape(entries_of_turn(*turn), (3, 3)) * np.array(
        node.scale or [1.0, 1.0, 1.0]
    )
    matrix[:3, 3] = node.translation or [0.0, 0.0, 0.0]
    return matrix


# --- skins: meshes that joints move, in the pose that the file's nodes have (section
# 3.7.3) --------------------------


class Bound(NamedTuple):
    """To which joints vertices are bound: their numbers (V, 4 n) in the skin, and the
    weight of each, which add up to 1.
    """

    joints: Ints
    weights: Doubles


def bound(file: GltfFile, primitive: Primitive, used: Ints) -> Bound | None:
    """Return to which joints the used vertices of a primitive are bound; None where it
    says nothing of joints. Raises FileFormatError: it says it of other vertices, or
    without weights.
    """
    held = primitive.attributes
    joints = list[Ints]()
    weights = list[Doubles]()
    while f"JOINTS_{len(joints)}" in held:
        if len(joints) == MOST_SETS:
            raise damaged(
                file.path, f"at most {4 * MOST_SETS} joints of each vertex", "more"
            )
        pair = held[f"JOINTS_{len(joints)}"], held.get(f"WEIGHTS_{len(joints)}", -1)
        entries = [file.header.accessors[index] for index in pair if index >= 0]
        count = file.header.accessors[held["POSITION"]].count
        if len(entries) < 2 or any(
            entry.type != "VEC4" or entry.count != count for entry in entries
        ):
            raise damaged(
                file.path, "four joints and four weights of each vertex", "others"
            )
        joints.append(file.values(pair[0])[used].astype(np.int64))
        weights.append(file.numbers(pair[1], used))
    if not joints:
        return None
    shares = np.concatenate(weights, axis=1)
    total = shares.sum(axis=1, keepdims=True)
    shares = np.where(
        total > 0.0,
        shares / np.where(total > 0.0, total, 1.0),
        np.eye(1, shares.shape[1]),
    )
    return Bound(np.concatenate(joints, axis=1), shares)


def inverse_binds(file: GltfFile, skin: Skin) -> Doubles:
    """Return (J, 4, 4) from the mesh to each joint's own coordinates. Raises
    FileFormatError: there are too few, or numbers of another kind.
    """
    count = len(skin.joints)
    if skin.inverseBindMatrices is None:
        return np.tile(np.eye(4), (count, 1, 1))
    values = file.values(skin.inverseBindMatrices)
    if values.shape[1:] != (16,) or len(values) < count:
        got = f"{len(values)} of {values.shape[1]} numbers"
        raise damaged(file.path, f"{count} inverse bind matrices of 4 x 4", got)
    return np.asarray(
        values[:count].astype(np.float64).reshape(-1, 4, 4).transpose(0, 2, 1)
    )


def posed(path: Path, part: ImportedPart, by: Bound, matrices: Doubles) -> ImportedPart:
    """Return a part as its joints place it in the scene; the transform of its own node
    does not count. Raises FileFormatError: it is bound to joints that its skin does not
    have.
    """
    if by.joints.max(initial=0) >= len(matrices) or by.joints.min(initial=0) < 0:
        raise damaged(
            path,
            f"joints under {len(matrices)}, as its skin has",
            f"number {int(by.joints.max())}",
        )
    moves = np.zeros((len(part.vertices), 3, 4))
    for joint, weight in zip(by.joints.T, by.weights.T, strict=True):
        moves += weight[:, None, None] * matrices[joint, :3]
    turns = moves[:, :, :3]
    normals = part.normals
    vertices = np.einsum("vij,vj->vi", turns, part.vertices) + moves[:, :, 3]
    if normals is not None:  # which turn with the cofactors
        normals = np.einsum(
            "vij,vj->vi", np.cross(turns[:, [1, 2, 0]], turns[:, [2, 0, 1]]), normals
        )
    return put(
        part, vertices, normals, mirrored=bool((np.linalg.det(turns) < 0.0).all())
    )


def targets_of(
    file: GltfFile, primitive: Primitive, used: Ints, extras: object
) -> tuple[tuple[Target, ...], tuple[Doubles | None, ...]]:
    """Return the morph targets of a primitive, and how far each turns its normals (V,
    3), None for not at all, for the vertices that are used; `targetNames` in the extras
    of the mesh are what exporters call them. Raises FileFormatError: a target is of
    other vertices, or has numbers that are none.
    """
    names = extras.get("targetNames") if isinstance(extras, dict) else None
    called = dict(enumerate(names if isinstance(names, list) else []))
    targets = list[Target]()
    turns = list[Doubles | None]()
    accessors = file.header.accessors
    for number, attributes in enumerate(primitive.targets):
        read: dict[str, Doubles] = {}
        for kind in [kind for kind in ("POSITION", "NORMAL") if kind in attributes]:
            entry = accessors[attributes[kind]]
            count = accessors[primitive.attributes["POSITION"]].count
            if entry.type != "VEC3" or entry.count != count:
                raise damaged(
                    file.path,
                    f"a {kind} of type VEC3 for each vertex in a morph target",
                    "others",
                )
            read[kind] = _finite(
                file.path, "morph targets", file.numbers(attributes[kind], used)
            )
        moves = read.get("POSITION", np.zeros((len(used), 3)))
        rows = np.flatnonzero(moves.any(axis=1))
        name = called.get(number)
        targets.append(
            Target(
                clean(name if isinstance(name, str) else f"target-{number}"),
                rows,
                moves[rows],
            )
        )
        turns.append(read.get("NORMAL"))
    return tuple(targets), tuple(turns)


def morphed(
    part: ImportedPart,
    targets: Sequence[Target],
    turns: Sequence[Doubles | None],
    weights: Doubles,
) -> ImportedPart:
    """Return a part, in its mesh's coordinates, with morph targets added by their
    weights (T,).
    """
    vertices = part.vertices
    normals = part.normals
    for target, turn, weight in zip(targets, turns, weights, strict=True):
        if weight:
            vertices = np.array(vertices)
            vertices[target.rows] += weight * target.moves
            normals = (
                normals if normals is None or turn is None else normals + weight * turn
            )
    return replace(part, vertices=vertices, normals=normals)


def weights_of(file: GltfFile, node: int, count: int) -> Doubles:
    """Return the weights (T,) at rest of a node's morph targets. Raises
    FileFormatError: there are others than it has targets.
    """
    entry = file.header.nodes[node]
    weights = (
        entry.weights
        or ([] if entry.mesh is None else file.header.meshes[entry.mesh].weights)
        or [0.0] * count
    )
    if len(weights) != count:
        raise damaged(
            file.path, f"{count} weights, one of each morph target", f"{len(weights)}"
        )
    return np.array(weights, np.float64)


def check_moving(file: GltfFile, drawn: Sequence[int]) -> dict[int, int]:
    """Return how many morph targets each node has that draws something. Raises
    FileFormatError: the primitives of a mesh have different numbers of them, or there
    is too much that moves.
    """
    header = file.header
    many = dict[int, int]()
    size = 0
    for node in drawn:
        entry = header.nodes[node]
        skin = header.nodes[node].skin
        primitives = [] if entry.mesh is None else header.meshes[entry.mesh].primitives
        counts = {len(primitive.targets) for primitive in primitives}
        if len(counts) > 1:
            raise damaged(
                file.path,
                "as many morph targets in all primitives of a mesh",
                "different numbers",
            )
        many[node] = max(counts, default=0)
        size += 0 if skin is None else len(primitives) * len(header.skins[skin].joints)
        places = [
            primitive.attributes["POSITION"]
            for primitive in primitives
            if "POSITION" in primitive.attributes
        ]
        size += many[node] * sum(header.accessors[place].count for place in places)
    check_most(
        file.path, size, MOST_MOVES, "morph targets and joints for at most {} vertices"
    )
    return many


def skeleton_of(file: GltfFile, drawn: Mapping[int, int]) -> Skeleton | None:
    """Return the nodes and clips of a file; None where nothing moves its geometry,
    which nodes draw that have so many morph targets. Raises FileFormatError: a clip is
    not what the format says, or there is too much of them.
    """
    header = file.header
    parents = header.parents
    skins = {skin for node in drawn if (skin := header.nodes[node].skin) is not None}
    moved = with_above(
        parents,
        {*drawn, *(joint for skin in skins for joint in header.skins[skin].joints)},
    )

    # it moves something of the geometry; without a node an extension's
    def counts(channel: Channel) -> bool:
        node = channel.target.node
        path = channel.target.path
        moves = node is not None and (
            drawn.get(node, 0) > 0 if path == "weights" else node in moved
        )
        return moves and path in WIDTHS

    wanted = [
        (animation, list(filter(counts, animation.channels)))
        for animation in header.animations
    ]
    keys = [
        header.accessors[animation.samplers[channel.curve].output]
        for animation, channels in wanted
        for channel in channels
    ]
    check_most(
        file.path,
        sum(key.count * key.width for key in keys),
        MOST_KEYS,
        "clips of at most {} numbers",
    )
    names = Names()
    clips = list[Clip]()
    for number, (animation, channels) in enumerate(wanted):
        if channels:
            tracks = [_track(file, animation, channel, drawn) for channel in channels]
            clips.append(
                Clip(names.free(animation.name or f"clip-{number}"), tuple(tracks))
            )
    if not (skins or clips or any(drawn.values())):
        return None
    bones = {bone.node: bone.bone for bone in header.vrm_0} | {
        bone.node: name for name, bone in header.vrm.items()
    }
    called = Names()
    turns = np.array([node.rotation or [0.0, 0.0, 0.0, 1.0] for node in header.nodes])
    return Skeleton(
        file.path.name,
        tuple(
            called.free(bones.get(k) or node.name or f"node-{k}")
            for k, node in enumerate(header.nodes)
        ),
        np.array(parents),
        np.stack([matrix_of(node) for node in header.nodes]),
        np.array([node.translation or [0.0] * 3 for node in header.nodes]),
        np.asarray(
            turns / np.maximum(np.linalg.norm(turns, axis=1, keepdims=True), 1e-12)
        ),
        np.array([node.scale or [1.0] * 3 for node in header.nodes]),
        np.array([node.matrix is not None for node in header.nodes]),
        tuple(clips),
    )


def _track(
    file: GltfFile, animation: Animation, channel: Channel, drawn: Mapping[int, int]
) -> Track:
    path = file.path
    accessors = file.header.accessors
    sampler = animation.samplers[channel.curve]
    node = channel.target.node or 0
    what = channel.target.path
    entry = accessors[sampler.input]
    output = accessors[sampler.output]
    if entry.type != "SCALAR" or entry.componentType != 5126 or not entry.count:
        raise damaged(
            path,
            "keys of a clip at times in seconds, of type SCALAR and 32-bit floats",
            "others",
        )
    times = _finite(
        path, "the times of a clip", file.numbers(sampler.input, np.arange(entry.count))
    )[:, 0]
    if times[0] < 0.0 or (np.diff(times) <= 0.0).any():
        raise damaged(
            path, "times of a clip from 0 that rise from key to key", "others"
        )
    if file.header.nodes[node].matrix is not None and what != "weights":
        raise damaged(
            path, f"a node {node} without matrix, because a clip moves it", "one"
        )
    each = 3 if sampler.interpolation == "CUBICSPLINE" else 1
    many = drawn[node] if what == "weights" else 1
    width = WIDTHS[what]
    count = len(times) * each * many
    if output.count != count or output.width != width:
        wanted = (
            f"{count:,} values of {width} number{'s' * (width > 1)} for "
            f"{len(times):,} keys of a {what}"
        )
        raise damaged(path, wanted, f"{output.count:,} of {output.width}")
    values = _finite(
        path, "the keys of a clip", file.numbers(sampler.output, np.arange(count))
    )
    keys = values.reshape(len(times), each, many * width)
    if (
        what == "rotation"
        and not (np.linalg.norm(keys[:, each // 2], axis=1) > SHORTEST).all()
    ):
        raise damaged(
            path, "rotations of a clip that are unit quaternions", "one of length 0"
        )
    return Track(node, what, sampler.interpolation, times, keys)


def _finite(path: Path, what: str, values: Doubles) -> Doubles:
    if not np.isfinite(values).all():
        raise damaged(path, f"finite numbers in {what}", "NaN or infinite ones")
    return values
