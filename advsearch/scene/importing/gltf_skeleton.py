"""What moves in a glTF file: its nodes, skins, morph targets and clips (glTF 2.0, sections 3.5 to 3.11)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from advsearch import files
from advsearch.scene.assets import Doubles, Ints
from advsearch.scene.importing.files import Names, clean, damaged
from advsearch.scene.importing.gltf import Buffers
from advsearch.scene.importing.gltf_entries import Animation, Channel, Header, Node, Primitive, Skin
from advsearch.scene.importing.parts import ImportedPart
from advsearch.scene.skeleton import Clip, Movable, Skeleton, Target, Track, entries_of_turn

MOST_SETS = 8
"""Sets of four joints of a vertex."""
MOST_KEYS = 1 << 24
"""Numbers in the keys of all clips together, before `advsearch.files.scaled`; one accessor may stand for many."""
MOST_MOVES = 1 << 25
"""Vertices that all morph targets move together, and inverse bind matrices, before `advsearch.files.scaled`."""
WIDTHS = {"translation": 3, "rotation": 4, "scale": 3, "weights": 1}
"""Numbers of a value of each property that a channel may set; of `weights`, of each morph target."""


# --- nodes ------------------------------------------------------------------------------------------------------------


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
    """The transform (4, 4) of one node."""
    if node.matrix is not None:
        return np.asarray(np.array(node.matrix, dtype=np.float64).reshape(4, 4).T)
    matrix = np.eye(4)
    x, y, z, w = np.array(node.rotation or [0.0, 0.0, 0.0, 1.0]) / max(
        float(np.linalg.norm(node.rotation or 1.0)), 1e-12
    )
    matrix[:3, :3] = np.reshape(entries_of_turn(x, y, z, w), (3, 3)) * np.array(node.scale or [1.0, 1.0, 1.0])
    matrix[:3, 3] = node.translation or [0.0, 0.0, 0.0]
    return matrix


# --- skins: meshes that joints move, in the pose that the file's nodes have (section 3.7.3) --------------------------


@dataclass(frozen=True, eq=False)
class Bound:
    """To which joints vertices are bound.

    Attributes:
        joints: (V, 4 n) their numbers in the skin.
        weights: (V, 4 n) of each; they add up to 1.
    """

    joints: Ints
    weights: Doubles


def bound(path: Path, header: Header, buffers: Buffers, primitive: Primitive, used: Ints) -> Bound | None:
    """Return to which joints the used vertices of a primitive are bound; None where it says nothing of joints.

    Raises:
        FileFormatError: it says it of other vertices, or without weights.
    """
    held = primitive.attributes
    joints: list[Ints] = []
    weights: list[Doubles] = []
    while f"JOINTS_{len(joints)}" in held:
        if len(joints) == MOST_SETS:
            raise damaged(path, f"at most {4 * MOST_SETS} joints of each vertex", "more")
        pair = [held.get(f"{kind}_{len(joints)}") for kind in ("JOINTS", "WEIGHTS")]
        for one in pair:
            given = None if one is None else header.accessors[one]
            if given is None or given.type != "VEC4" or given.count != header.accessors[held["POSITION"]].count:
                raise damaged(path, "four joints and four weights of each vertex", "others")
        first, second = (index for index in pair if index is not None)
        joints.append(buffers.values(first)[used].astype(np.int64))
        weights.append(buffers.numbers(second, used))
    if not joints:
        return None
    shares = np.concatenate(weights, axis=1)
    total = shares.sum(axis=1, keepdims=True)
    shares = np.where(total > 0.0, shares / np.where(total > 0.0, total, 1.0), np.eye(1, shares.shape[1]))
    return Bound(np.concatenate(joints, axis=1), shares)


def joint_matrices(path: Path, skin: Skin, buffers: Buffers, poses: Mapping[int, Doubles]) -> Doubles:
    """Return (J, 4, 4) from the mesh to the scene, one of each joint; `poses` are those of all nodes.

    Raises:
        FileFormatError: it has too few inverse bind matrices, or numbers of another kind.
    """
    return np.asarray(np.stack([poses[joint] for joint in skin.joints]) @ inverse_binds(path, skin, buffers))


def inverse_binds(path: Path, skin: Skin, buffers: Buffers) -> Doubles:
    """Return (J, 4, 4) from the mesh to each joint's own coordinates; those of `joint_matrices`, without the joint."""
    count = len(skin.joints)
    if skin.inverseBindMatrices is None:
        return np.tile(np.eye(4), (count, 1, 1))
    values = buffers.values(skin.inverseBindMatrices)
    if values.shape[1:] != (16,) or len(values) < count:
        raise damaged(path, f"{count} inverse bind matrices of 4 x 4", f"{len(values)} of {values.shape[1]} numbers")
    return np.asarray(values[:count].astype(np.float64).reshape(-1, 4, 4).transpose(0, 2, 1))


def posed(path: Path, part: ImportedPart, by: Bound, matrices: Doubles) -> ImportedPart:
    """Return a part as its joints place it in the scene; the transform of its own node does not count.

    Raises:
        FileFormatError: it is bound to joints that its skin does not have.
    """
    if by.joints.max(initial=0) >= len(matrices) or by.joints.min(initial=0) < 0:
        raise damaged(path, f"joints under {len(matrices)}, as its skin has", f"number {int(by.joints.max())}")
    moves = np.zeros((len(part.vertices), 3, 4))
    for joint, weight in zip(by.joints.T, by.weights.T, strict=True):
        moves += weight[:, None, None] * matrices[joint, :3]
    turns, normals = moves[:, :, :3], part.normals
    vertices = np.einsum("vij,vj->vi", turns, part.vertices) + moves[:, :, 3]
    if normals is not None:  # which turn with the cofactors
        normals = np.einsum("vij,vj->vi", np.cross(turns[:, [1, 2, 0]], turns[:, [2, 0, 1]]), normals)
    if not (np.linalg.det(turns) < 0.0).all():
        return replace(part, vertices=vertices, normals=normals)
    colors = None if part.colors is None else part.colors[:, ::-1]
    mirrored = None if normals is None else -normals
    return replace(part, vertices=vertices, faces=part.faces[:, ::-1], normals=mirrored, colors=colors)


# --- morph targets ----------------------------------------------------------------------------------------------------


def targets_of(
    path: Path, header: Header, buffers: Buffers, primitive: Primitive, used: Ints, extras: object
) -> tuple[tuple[Target, ...], tuple[Doubles | None, ...]]:
    """Return the morph targets of a primitive, and how far each turns its normals (V, 3), None for not at all.

    Args:
        path, header, buffers: of the file.
        primitive: of a mesh.
        used: the vertices that are read.
        extras: of the mesh; `targetNames` are what exporters call its targets.

    Raises:
        FileFormatError: a target is of other vertices, or has numbers that are none.
    """
    said = extras.get("targetNames") if isinstance(extras, dict) else None
    called = said if isinstance(said, list) else []
    targets, turns = list[Target](), list[Doubles | None]()
    for number, attributes in enumerate(primitive.targets):
        read: dict[str, Doubles] = {}
        for kind in ("POSITION", "NORMAL"):
            if kind in attributes:
                entry = header.accessors[attributes[kind]]
                if entry.type != "VEC3" or entry.count != header.accessors[primitive.attributes["POSITION"]].count:
                    raise damaged(path, f"a {kind} of type VEC3 for each vertex in a morph target", "others")
                read[kind] = _finite(path, "morph targets", buffers.numbers(attributes[kind], used))
        moves = read.get("POSITION", np.zeros((len(used), 3)))
        rows = np.flatnonzero(moves.any(axis=1))
        name = called[number] if number < len(called) and isinstance(called[number], str) else f"target-{number}"
        targets.append(Target(clean(name), rows, moves[rows]))
        turns.append(read.get("NORMAL"))
    return tuple(targets), tuple(turns)


def morphed(
    part: ImportedPart, targets: Sequence[Target], turns: Sequence[Doubles | None], weights: Doubles
) -> ImportedPart:
    """Return a part, in its mesh's coordinates, with morph targets added by their weights (T,)."""
    vertices, normals = part.vertices, part.normals
    for target, turn, weight in zip(targets, turns, weights, strict=True):
        if weight:
            vertices = np.array(vertices)
            vertices[target.rows] += weight * target.moves
            normals = normals if normals is None or turn is None else normals + weight * turn
    return replace(part, vertices=vertices, normals=normals)


def weights_of(path: Path, header: Header, node: int, count: int) -> Doubles:
    """Return the weights (T,) at rest of a node's morph targets.

    Raises:
        FileFormatError: there are others than it has targets.
    """
    mesh = header.nodes[node].mesh
    found = header.nodes[node].weights or ([] if mesh is None else header.meshes[mesh].weights) or [0.0] * count
    if len(found) != count:
        raise damaged(path, f"{count} weights, one of each morph target", f"{len(found)}")
    return np.array(found, np.float64)


def check_moving(path: Path, header: Header, drawn: Sequence[int]) -> dict[int, int]:
    """Return how many morph targets each node has that draws something.

    Raises:
        FileFormatError: the primitives of a mesh have different numbers of them, or there is too much that moves.
    """
    found, size = dict[int, int](), 0
    for node in drawn:
        entry, skin = header.nodes[node], header.nodes[node].skin
        primitives = [] if entry.mesh is None else header.meshes[entry.mesh].primitives
        counts = {len(primitive.targets) for primitive in primitives}
        if len(counts) > 1:
            raise damaged(path, "as many morph targets in all primitives of a mesh", "different numbers")
        found[node] = max(counts, default=0)
        size += 0 if skin is None else len(primitives) * len(header.skins[skin].joints)
        for primitive in primitives:
            place = primitive.attributes.get("POSITION")
            size += 0 if place is None else found[node] * header.accessors[place].count
    if size > files.scaled(MOST_MOVES):
        most = f"morph targets and joints for at most {files.scaled(MOST_MOVES):,} vertices"
        raise files.too_large(path, most, f"{size:,}")
    return found


# --- clips ------------------------------------------------------------------------------------------------------------


def skeleton_of(path: Path, header: Header, buffers: Buffers, drawn: Mapping[int, int]) -> Skeleton | None:
    """Return the nodes and clips of a file; None where nothing moves its geometry.

    Args:
        path, header, buffers: of the file.
        drawn: numbers of the nodes that draw something, with how many morph targets each has.

    Raises:
        FileFormatError: a clip is not what the format says, or there is too much of them.
    """
    parents = np.full(len(header.nodes), -1)
    for number, node in enumerate(header.nodes):
        parents[node.children] = number
    skins = {skin for node in drawn if (skin := header.nodes[node].skin) is not None}
    moved, level = set[int](), {*drawn, *(joint for skin in skins for joint in header.skins[skin].joints)}
    while level:
        moved |= level
        level = {int(parents[node]) for node in level} - {-1} - moved
    wanted = [_wanted(one, moved, drawn) for one in header.animations]
    sizes = sum(
        one.count * one.width
        for animation, channels in zip(header.animations, wanted, strict=True)
        for channel in channels
        for one in (header.accessors[animation.samplers[channel.sampler].output],)
    )
    if sizes > files.scaled(MOST_KEYS):
        raise files.too_large(path, f"clips of at most {files.scaled(MOST_KEYS):,} numbers", f"{sizes:,}")
    names, clips = Names(), list[Clip]()
    for number, (animation, channels) in enumerate(zip(header.animations, wanted, strict=True)):
        if channels:
            tracks = [_track(path, header, buffers, animation, channel, drawn) for channel in channels]
            clips.append(Clip(names.free(animation.name or f"clip-{number}"), tuple(tracks)))
    if not (skins or clips or any(drawn.values())):
        return None
    bones, called = header.bones, Names()
    return Skeleton(
        path.name,
        tuple(called.free(bones.get(k) or node.name or f"node-{k}") for k, node in enumerate(header.nodes)),
        parents,
        np.stack([matrix_of(node) for node in header.nodes]),
        np.array([node.translation or [0.0] * 3 for node in header.nodes]),
        _unit(np.array([node.rotation or [0.0, 0.0, 0.0, 1.0] for node in header.nodes])),
        np.array([node.scale or [1.0] * 3 for node in header.nodes]),
        np.array([node.matrix is not None for node in header.nodes]),
        tuple(clips),
    )


def _wanted(animation: Animation, moved: set[int], drawn: Mapping[int, int]) -> list[Channel]:
    """The channels that move something of the geometry; those without a node belong to extensions."""
    found = []
    for channel in animation.channels:
        node, path = channel.target.node, channel.target.path
        if node is not None and path in WIDTHS and (drawn.get(node, 0) > 0 if path == "weights" else node in moved):
            found.append(channel)
    return found


def _track(
    path: Path, header: Header, buffers: Buffers, animation: Animation, channel: Channel, drawn: Mapping[int, int]
) -> Track:
    sampler, node, what = animation.samplers[channel.sampler], channel.target.node or 0, channel.target.path
    entry, output = header.accessors[sampler.input], header.accessors[sampler.output]
    if entry.type != "SCALAR" or entry.componentType != 5126 or not entry.count:
        raise damaged(path, "keys of a clip at times in seconds, of type SCALAR and 32-bit floats", "others")
    times = _finite(path, "the times of a clip", buffers.numbers(sampler.input, np.arange(entry.count)))[:, 0]
    if times[0] < 0.0 or (np.diff(times) <= 0.0).any():
        raise damaged(path, "times of a clip from 0 that rise from key to key", "others")
    if header.nodes[node].matrix is not None and what != "weights":
        raise damaged(path, f"a node {node} without matrix, because a clip moves it", "one")
    each = 3 if sampler.interpolation == "CUBICSPLINE" else 1
    many, width = (drawn[node] if what == "weights" else 1), WIDTHS[what]
    count = len(times) * each * many
    if output.count != count or output.width != width:
        wanted = f"{count:,} values of {width} number{'s' * (width > 1)} for {len(times):,} keys of a {what}"
        raise damaged(path, wanted, f"{output.count:,} of {output.width}")
    values = _finite(path, "the keys of a clip", buffers.numbers(sampler.output, np.arange(count)))
    keys = values.reshape(len(times), each, many * width)
    if what == "rotation" and not (np.linalg.norm(keys[:, each // 2], axis=1) > SHORTEST).all():
        raise damaged(path, "rotations of a clip that are unit quaternions", "one of length 0")
    return Track(node, what, sampler.interpolation, times, keys)


SHORTEST = 1e-6
"""Length of a quaternion, at least; the format says 1."""


def _unit(quaternions: Doubles) -> Doubles:
    return np.asarray(quaternions / np.maximum(np.linalg.norm(quaternions, axis=1, keepdims=True), 1e-12))


def _finite(path: Path, what: str, values: Doubles) -> Doubles:
    if not np.isfinite(values).all():
        raise damaged(path, f"finite numbers in {what}", "NaN or infinite ones")
    return values


def movable(
    path: Path,
    header: Header,
    buffers: Buffers,
    skeleton: Skeleton,
    node: int,
    vertices: Doubles,
    by: Bound | None,
    targets: tuple[Target, ...],
    rest: Doubles,
) -> Movable:
    """Return a part as it is stored, with what moves it: see `Movable`."""
    number = header.nodes[node].skin
    if number is None or by is None:
        alone = np.zeros((len(vertices), 1), np.int64)
        return Movable(
            skeleton, node, vertices, np.array([node]), np.eye(4)[None], alone, np.ones(alone.shape), targets, rest
        )
    skin = header.skins[number]
    inverse = inverse_binds(path, skin, buffers)
    return Movable(skeleton, node, vertices, np.array(skin.joints), inverse, by.joints, by.weights, targets, rest)
