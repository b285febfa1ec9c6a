"""Nodes, skins, morph targets and clips of glTF files (glTF 2.0, sections 3.5 to
3.11).
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from advsearch.scene.assets import Float64Array, IntArray
from advsearch.scene.importing.files import UniqueNames, damaged, sanitize_name
from advsearch.scene.importing.gltf import GltfFile
from advsearch.scene.importing.gltf_entries import (
    FLOAT32,
    Accessor,
    Animation,
    Channel,
    Header,
    Node,
    Primitive,
    Skin,
)
from advsearch.scene.importing.parts import ImportedPart, replace_geometry
from advsearch.scene.skeleton import (
    Clip,
    MorphTarget,
    Skeleton,
    Track,
    compute_rotation_entries,
    with_ancestors,
)
from advsearch.trust.stored_files import check_most

MAX_JOINT_SETS = 8  # limit of the sets of four joints of a vertex
MAX_KEY_NUMBERS = 1 << 24
"""Limit of the numbers in the keys of all clips, before `scale_limit`. Many keys may
share one accessor, so that the size of the file does not limit them.
"""
MAX_MOVES = 1 << 25
"""Limit of the vertices that morph targets move, added up over all targets, plus the
joints of all primitives; before `scale_limit`.
"""
VALUE_WIDTHS = {"translation": 3, "rotation": 4, "scale": 3, "weights": 1}
"""Numbers in a value of each property that a channel may set. `weights` has one number
for each morph target.
"""
MIN_QUATERNION_LENGTH = 1e-6  # minimum length of a quaternion; the format requires 1


def iterate_node_poses(header: Header) -> Iterator[tuple[int, Float64Array]]:
    """Yield the index and the pose (4, 4) of each node of the file's scene.

    The pose maps the node's coordinates to the scene's. In a file without scenes, all
    nodes are in the scene. The order is that of a walk through the trees, not of
    indices.
    """
    if header.scenes:
        roots = list(header.scenes[header.scene or 0].nodes)
    else:
        children = {child for node in header.nodes for child in node.children}
        roots = [index for index in range(len(header.nodes)) if index not in children]
    pending = [(index, np.eye(4)) for index in roots]
    while pending:
        index, parent_pose = pending.pop()
        pose = parent_pose @ compute_matrix(header.nodes[index])
        yield index, pose
        pending.extend((child, pose) for child in header.nodes[index].children)


def compute_matrix(node: Node) -> Float64Array:
    """Return the matrix (4, 4) from a node to its parent.

    It is the node's own matrix, which the file stores by columns; or else its scale,
    then its rotation (normalised), then its translation.
    """
    if node.matrix is not None:
        return np.asarray(np.array(node.matrix, dtype=np.float64).reshape(4, 4).T)
    matrix = np.eye(4)
    quaternion = np.array(node.rotation or [0.0, 0.0, 0.0, 1.0])
    quaternion = quaternion / max(float(np.linalg.norm(quaternion)), 1e-12)
    rotation = np.reshape(compute_rotation_entries(*quaternion), (3, 3))
    matrix[:3, :3] = rotation * np.array(node.scale or [1.0, 1.0, 1.0])
    matrix[:3, 3] = node.translation or [0.0, 0.0, 0.0]
    return matrix


# ---- Skins (section 3.7.3) ----


class VertexJoints(NamedTuple):
    """The joints to which vertices are bound, and their weights."""

    joints: IntArray  # (V, 4 n) indices into the joints of the skin
    # (V, 4 n); weights of a vertex sum to 1, except in what `_read_joint_set` returns
    weights: Float64Array


def read_vertex_joints(
    file: GltfFile, primitive: Primitive, used: IntArray
) -> VertexJoints | None:
    """Return the joints of the used vertices of a primitive; None if it has none.

    Weights of a vertex are scaled to add up to 1.

    Args:
        file: the glTF file.
        primitive: entry of the primitive.
        used: (V,) the vertices that faces use.

    Raises:
        FileFormatError: the number of joints is not that of the vertices, or joints
            have no weights.
    """
    sets = _read_joint_sets(file, primitive, used)
    if not sets:
        return None
    joints = np.concatenate([joint_set.joints for joint_set in sets], axis=1)
    weights = np.concatenate([joint_set.weights for joint_set in sets], axis=1)
    return VertexJoints(joints, _normalize_weights(weights))


def _read_joint_sets(
    file: GltfFile, primitive: Primitive, used: IntArray
) -> list[VertexJoints]:
    """Return the sets of four joints and weights of used vertices: JOINTS_0, JOINTS_1, ...

    Raises:
        FileFormatError: there are too many sets, or a set is wrong.
    """
    sets = list[VertexJoints]()
    while f"JOINTS_{len(sets)}" in primitive.attributes:
        if len(sets) == MAX_JOINT_SETS:
            raise damaged(
                file.path, f"at most {4 * MAX_JOINT_SETS} joints of each vertex", "more"
            )
        sets.append(_read_joint_set(file, primitive, used, len(sets)))
    return sets


def _normalize_weights(weights: Float64Array) -> Float64Array:
    """Return weights (V, W) scaled so that those of a vertex add up to 1.

    A vertex without weights moves with its first joint: (1, 0, 0, ...).
    """
    total = weights.sum(axis=1, keepdims=True)
    has_weights = total > 0.0
    only_first = np.zeros(weights.shape[1])
    only_first[0] = 1.0
    fractions = weights / np.where(has_weights, total, 1.0)
    return np.where(has_weights, fractions, only_first)


def _read_joint_set(
    file: GltfFile, primitive: Primitive, used: IntArray, index: int
) -> VertexJoints:
    """Return four joints of each used vertex, with their weights as stored.

    They are those of the attributes ``JOINTS_<index>`` and ``WEIGHTS_<index>``.

    Args:
        file: the glTF file.
        primitive: entry of the primitive.
        used: (V,) the vertices that faces use.
        index: index of the set of four.

    Raises:
        FileFormatError: there are not four joints and four weights for each vertex.
    """
    attributes = primitive.attributes
    joints_index = attributes[f"JOINTS_{index}"]
    weights_index = attributes.get(f"WEIGHTS_{index}")
    n_vertices = file.header.accessors[attributes["POSITION"]].count
    if weights_index is None or not (
        _is_vec4(file.header.accessors[joints_index], n_vertices)
        and _is_vec4(file.header.accessors[weights_index], n_vertices)
    ):
        raise damaged(
            file.path, "four joints and four weights of each vertex", "others"
        )
    joints = file.read_stored_values(joints_index)[used].astype(np.int64)
    # Weights may be stored as integers, which `read_float_rows` converts to fractions.
    weights = file.read_float_rows(weights_index, used)
    return VertexJoints(joints, weights)


def _is_vec4(accessor: Accessor, count: int) -> bool:
    """Return whether an accessor has four numbers for each of `count` vertices."""
    return accessor.type == "VEC4" and accessor.count == count


def read_inverse_binds(file: GltfFile, skin: Skin) -> Float64Array:
    """Return the inverse bind matrices (J, 4, 4), from the mesh to each joint.

    Raises:
        FileFormatError: there are too few, or they are not 4 x 4.
    """
    count = len(skin.joints)
    if skin.inverseBindMatrices is None:
        return np.tile(np.eye(4), (count, 1, 1))
    values = file.read_stored_values(skin.inverseBindMatrices)
    if values.shape[1:] != (16,) or len(values) < count:
        got = f"{len(values)} of {values.shape[1]} numbers"
        raise damaged(file.path, f"{count} inverse bind matrices of 4 x 4", got)
    # The format stores columns.
    return np.asarray(
        values[:count].astype(np.float64).reshape(-1, 4, 4).transpose(0, 2, 1)
    )


def pose_part(
    path: Path, part: ImportedPart, vertex_joints: VertexJoints, matrices: Float64Array
) -> ImportedPart:
    """Return a part as its joints pose it in the scene, by linear blend skinning.

    As in glTF, the transform of the part's own node has no effect.

    Args:
        path: the file, for messages.
        part: a part in the coordinates of its mesh.
        vertex_joints: the joints of its vertices.
        matrices: (J, 4, 4) from the mesh to the scene, for each joint.

    Raises:
        FileFormatError: it is bound to joints that its skin does not have.
    """
    _check_joints(path, vertex_joints.joints, len(matrices))
    transforms = _blend_matrices(vertex_joints, matrices)
    linear = transforms[:, :, :3]
    normals = part.normals
    vertices = np.einsum("vij,vj->vi", linear, part.vertices) + transforms[:, :, 3]
    if normals is not None:
        normals = _transform_normals(normals, linear)
    # Then all faces are turned over. If only some vertices are mirrored, there is no
    # winding that fits all faces, and it stays as it is.
    are_all_mirrored = bool((np.linalg.det(linear) < 0.0).all())
    return replace_geometry(part, vertices, normals, is_mirrored=are_all_mirrored)


def _check_joints(path: Path, joints: IntArray, n_joints: int) -> None:
    """Raise FileFormatError if vertices are bound to joints beyond `n_joints`."""
    min_joint = int(joints.min(initial=0))
    max_joint = int(joints.max(initial=0))
    if max_joint >= n_joints or min_joint < 0:
        wrong_joint = min_joint if min_joint < 0 else max_joint
        raise damaged(
            path,
            f"joints under {n_joints}, as its skin has",
            f"number {wrong_joint}",
        )


def _blend_matrices(
    vertex_joints: VertexJoints, matrices: Float64Array
) -> Float64Array:
    """Return the weighted mean (V, 3, 4) of the matrices (J, 4, 4) of a vertex's joints."""
    joints = vertex_joints.joints
    transforms = np.zeros((len(joints), 3, 4))
    for joint, weight in zip(joints.T, vertex_joints.weights.T, strict=True):
        transforms += weight[:, None, None] * matrices[joint, :3]
    return transforms


def _transform_normals(normals: Float64Array, linear: Float64Array) -> Float64Array:
    """Return normals (V, 3), of any length, under the linear maps (V, 3, 3) of vertices.

    The matrix of cofactors is the inverse transpose times the determinant, and exists
    also for matrices without an inverse. Its row i is the cross product of the rows
    i + 1 and i + 2.
    """
    cofactors = np.cross(linear[:, [1, 2, 0]], linear[:, [2, 0, 1]])
    transformed: Float64Array = np.einsum("vij,vj->vi", cofactors, normals)
    return transformed


def read_morph_targets(
    file: GltfFile, primitive: Primitive, used: IntArray, extras: object
) -> tuple[tuple[MorphTarget, ...], tuple[Float64Array | None, ...]]:
    """Read the morph targets of a primitive.

    Args:
        file: the glTF file.
        primitive: its entry in the header.
        used: the vertices (V,) that are used.
        extras: extras of its mesh; exporters write names of targets to `targetNames`.

    Returns:
        The targets; and the offsets that each adds to the normals, (V, 3) or None.

    Raises:
        FileFormatError: a target has another number of vertices, or numbers that are
            NaN or infinite.
    """
    names = _name_targets(len(primitive.targets), extras)
    targets = list[MorphTarget]()
    normal_offsets = list[Float64Array | None]()
    for name, attributes in zip(names, primitive.targets, strict=True):
        offsets = _read_offsets(file, primitive, attributes, "POSITION", used)
        targets.append(_make_morph_target(name, offsets, len(used)))
        normal_offsets.append(
            _read_offsets(file, primitive, attributes, "NORMAL", used)
        )
    return tuple(targets), tuple(normal_offsets)


def _make_morph_target(
    name: str, offsets: Float64Array | None, n_vertices: int
) -> MorphTarget:
    """Return a morph target with only the vertices that it moves.

    `offsets` (V, 3) are those of all vertices; None for a target that moves only
    normals.
    """
    if offsets is None:
        offsets = np.zeros((n_vertices, 3))
    moved_vertices = np.flatnonzero(offsets.any(axis=1))
    return MorphTarget(name, moved_vertices, offsets[moved_vertices])


def _name_targets(count: int, extras: object) -> list[str]:
    """Return names of morph targets: those in a mesh's extras, or else "target-0", ..."""
    stated_names = extras.get("targetNames") if isinstance(extras, dict) else None
    if not isinstance(stated_names, list):
        stated_names = []
    names = [f"target-{index}" for index in range(count)]
    for index, stated_name in enumerate(stated_names[:count]):
        if isinstance(stated_name, str):
            names[index] = stated_name
    return [sanitize_name(name) for name in names]


def _read_offsets(
    file: GltfFile,
    primitive: Primitive,
    attributes: Mapping[str, int],
    name: str,
    used: IntArray,
) -> Float64Array | None:
    """Return the offsets (V, 3) that a morph target adds to an attribute.

    The result is None if the target does not change the attribute.

    Args:
        file: the glTF file.
        primitive: entry of the primitive.
        attributes: accessors of the target, by name.
        name: the attribute, "POSITION" or "NORMAL".
        used: (V,) the vertices that faces use.

    Raises:
        FileFormatError: the type or the number of the offsets is wrong, or an offset is
            not finite.
    """
    if name not in attributes:
        return None
    _check_offsets(file, primitive, name, attributes[name])
    offsets = file.read_float_rows(attributes[name], used)
    return _require_finite(file.path, "morph targets", offsets)


def _check_offsets(file: GltfFile, primitive: Primitive, name: str, index: int) -> None:
    """Raise FileFormatError unless a morph target has an offset for each vertex.

    Args:
        file: the glTF file.
        primitive: entry of the primitive.
        name: the attribute that the target changes.
        index: accessor of the offsets.
    """
    accessors = file.header.accessors
    accessor = accessors[index]
    count = accessors[primitive.attributes["POSITION"]].count
    if accessor.type != "VEC3" or accessor.count != count:
        raise damaged(
            file.path,
            f"a {name} of type VEC3 for each vertex in a morph target",
            "others",
        )


def apply_morph_targets(
    part: ImportedPart,
    targets: Sequence[MorphTarget],
    normal_offsets: Sequence[Float64Array | None],
    weights: Float64Array,
) -> ImportedPart:
    """Return a part, in its mesh's coordinates, with morph targets applied.

    Each target adds its offsets times its weight to the vertices and normals.

    Args:
        part: a part as the file stores it, which is not changed.
        targets: its T morph targets.
        normal_offsets: offsets that each target adds to the normals, (V, 3) or None.
        weights: (T,) weights of the targets.
    """
    vertices = part.vertices
    normals = part.normals
    for target, normal_offset, weight in zip(
        targets, normal_offsets, weights, strict=True
    ):
        if not weight:
            continue
        vertices = np.array(vertices)  # a copy, as the part itself stays
        vertices[target.rows] += weight * target.offsets
        if normals is not None and normal_offset is not None:
            normals = normals + weight * normal_offset
    return replace(part, vertices=vertices, normals=normals)


def read_rest_weights(file: GltfFile, node: int, count: int) -> Float64Array:
    """Return the weights (T,) at rest of a node's morph targets.

    The node's own weights are used, or else those of its mesh, or else 0.

    Raises:
        FileFormatError: there are not `count` weights, one for each target.
    """
    entry = file.header.nodes[node]
    weights = entry.weights
    if not weights and entry.mesh is not None:
        weights = file.header.meshes[entry.mesh].weights
    if not weights:
        weights = [0.0] * count
    if len(weights) != count:
        raise damaged(
            file.path, f"{count} weights, one of each morph target", f"{len(weights)}"
        )
    return np.array(weights, np.float64)


def _count_vertices(header: Header, primitives: Sequence[Primitive]) -> int:
    """Return the number of vertices of primitives; those without positions have none."""
    return sum(
        header.accessors[primitive.attributes["POSITION"]].count
        for primitive in primitives
        if "POSITION" in primitive.attributes
    )


def count_targets(file: GltfFile, mesh_nodes: Sequence[int]) -> dict[int, int]:
    """Return the number of morph targets of each node with a mesh.

    Args:
        file: the glTF file.
        mesh_nodes: indices of the nodes with a mesh.

    Raises:
        FileFormatError: the primitives of a mesh have different numbers of targets, or
            the limit `MAX_MOVES` is exceeded.
    """
    n_targets = dict[int, int]()
    n_moves = 0
    for node in mesh_nodes:
        n_targets[node] = _count_node_targets(file, node)
        n_moves += _count_moves(file.header, node, n_targets[node])
    check_most(
        file.path,
        n_moves,
        MAX_MOVES,
        "at most {} vertices of morph targets and joints of primitives",
    )
    return n_targets


def _list_primitives(header: Header, node: int) -> Sequence[Primitive]:
    """Return the primitives of a node's mesh; none if it has no mesh."""
    mesh = header.nodes[node].mesh
    return () if mesh is None else header.meshes[mesh].primitives


def _count_node_targets(file: GltfFile, node: int) -> int:
    """Return the number of morph targets of a node, which all its primitives have.

    Raises:
        FileFormatError: primitives have different numbers of targets.
    """
    primitives = _list_primitives(file.header, node)
    counts = {len(primitive.targets) for primitive in primitives}
    if len(counts) > 1:
        raise damaged(
            file.path,
            "as many morph targets in all primitives of a mesh",
            "different numbers",
        )
    return max(counts, default=0)


def _count_moves(header: Header, node: int, n_targets: int) -> int:
    """Return how many joints and offsets a node's primitives store, for `MAX_MOVES`.

    Each primitive stores a matrix for each joint of its skin, and an offset of each
    vertex for each of its `n_targets` morph targets.
    """
    primitives = _list_primitives(header, node)
    skin = header.nodes[node].skin
    n_joints = 0 if skin is None else len(header.skins[skin].joints)
    n_vertices = _count_vertices(header, primitives)
    return len(primitives) * n_joints + n_targets * n_vertices


def _name_nodes(header: Header) -> tuple[str, ...]:
    """Return a unique name for each node: that of its bone, or else its own.

    Bones have names in files of avatars: the extension VRM, version 0 or 1.
    """
    bone_names = {bone.node: bone.bone for bone in header.vrm_0} | {
        bone.node: name for name, bone in header.vrm.items()
    }
    unique_names = UniqueNames()
    return tuple(
        unique_names.make_unique(bone_names.get(index) or node.name or f"node-{index}")
        for index, node in enumerate(header.nodes)
    )


def read_skeleton(file: GltfFile, target_counts: Mapping[int, int]) -> Skeleton | None:
    """Return the nodes and clips of a file; None if nothing moves its geometry.

    Nodes have the names of bones that the VRM extension gives them, or else their own.

    Args:
        file: the glTF file.
        target_counts: the nodes with a mesh, and their number of morph targets.

    Raises:
        FileFormatError: a clip violates the format, or clips are too large.
    """
    node_skins = {file.header.nodes[node].skin for node in target_counts}
    skins = {skin for skin in node_skins if skin is not None}
    clips = _read_clips(file, target_counts, skins)
    if not (skins or clips or any(target_counts.values())):
        return None
    return _make_skeleton(file, clips)


def _make_skeleton(file: GltfFile, clips: tuple[Clip, ...]) -> Skeleton:
    """Return all nodes of a file as a skeleton with these clips."""
    header = file.header
    nodes = header.nodes
    return Skeleton(
        source=file.path.name,
        names=_name_nodes(header),
        parents=np.array(header.parent_of_node),
        local_matrices=np.stack([compute_matrix(node) for node in nodes]),
        translations=np.array([node.translation or [0.0] * 3 for node in nodes]),
        rotations=_compute_quaternions(nodes),
        scales=np.array([node.scale or [1.0] * 3 for node in nodes]),
        has_matrix=np.array([node.matrix is not None for node in nodes]),
        clips=clips,
    )


def _compute_quaternions(nodes: Sequence[Node]) -> Float64Array:
    """Return the unit quaternions (N, 4), x y z w, of nodes; the identity by default."""
    quaternions = np.array([node.rotation or [0.0, 0.0, 0.0, 1.0] for node in nodes])
    lengths = np.linalg.norm(quaternions, axis=1, keepdims=True)
    unit_quaternions: Float64Array = quaternions / np.maximum(lengths, 1e-12)
    return unit_quaternions


def _count_key_numbers(
    header: Header, used_channels: Sequence[Sequence[Channel]]
) -> int:
    """Return the number of numbers in the keys of channels, in all animations."""
    n_numbers = 0
    for animation, channels in zip(header.animations, used_channels, strict=True):
        for channel in channels:
            sampler = animation.samplers[channel.sampler_index]
            keys = header.accessors[sampler.output]
            n_numbers += keys.count * keys.width
    return n_numbers


def _read_clips(
    file: GltfFile, target_counts: Mapping[int, int], skins: Collection[int]
) -> tuple[Clip, ...]:
    """Return the clips of a file, with only those channels that move geometry.

    A channel moves geometry if it sets the weights of morph targets, or the transform
    of a node with a mesh, of a joint, or of an ancestor of one. A clip without any such
    channel is left out.

    Args:
        file: the glTF file.
        target_counts: the nodes with a mesh, and their number of morph targets.
        skins: indices of the skins of these nodes.
    """
    header = file.header
    used_channels = _find_moving_channels(header, target_counts, skins)
    n_numbers = _count_key_numbers(header, used_channels)
    check_most(file.path, n_numbers, MAX_KEY_NUMBERS, "clips of at most {} numbers")
    unique_names = UniqueNames()
    clips = list[Clip]()
    for index, channels in enumerate(used_channels):
        if channels:
            animation = header.animations[index]
            tracks = _read_tracks(file, animation, channels, target_counts)
            name = unique_names.make_unique(animation.name or f"clip-{index}")
            clips.append(Clip(name, tracks))
    return tuple(clips)


def _read_tracks(
    file: GltfFile,
    animation: Animation,
    channels: Sequence[Channel],
    target_counts: Mapping[int, int],
) -> tuple[Track, ...]:
    """Read some channels of a clip; see `_read_track`."""
    return tuple(
        _read_track(file, animation, channel, target_counts) for channel in channels
    )


def _find_moving_channels(
    header: Header, target_counts: Mapping[int, int], skins: Collection[int]
) -> list[list[Channel]]:
    """Return the channels of each animation that move geometry; see `_read_clips`.

    Args:
        header: the parsed JSON of the file.
        target_counts: the nodes with a mesh, and their number of morph targets.
        skins: indices of the skins of these nodes.
    """
    joints = (joint for skin in skins for joint in header.skins[skin].joints)
    moving_nodes = with_ancestors(header.parent_of_node, {*target_counts, *joints})
    return [
        _select_moving_channels(animation.channels, target_counts, moving_nodes)
        for animation in header.animations
    ]


def _select_moving_channels(
    channels: Sequence[Channel],
    target_counts: Mapping[int, int],
    moving_nodes: Collection[int],
) -> list[Channel]:
    """Return the channels of one animation that move geometry; see `_is_moving`."""
    return [
        channel
        for channel in channels
        if _is_moving(channel, target_counts, moving_nodes)
    ]


def _is_moving(
    channel: Channel, target_counts: Mapping[int, int], moving_nodes: Collection[int]
) -> bool:
    """Return whether a channel sets weights of morph targets, or moves such a node.

    Args:
        channel: a channel of a clip.
        target_counts: number of morph targets, by node.
        moving_nodes: nodes whose transform moves geometry.
    """
    node = channel.target.node
    property_name = channel.target.path
    if node is None or property_name not in VALUE_WIDTHS:
        return False  # the channel sets a property of an extension
    if property_name == "weights":
        return target_counts.get(node, 0) > 0
    return node in moving_nodes


def _read_track(
    file: GltfFile,
    animation: Animation,
    channel: Channel,
    target_counts: Mapping[int, int],
) -> Track:
    """Read one channel of a clip: the keys of one property of a node.

    The file has a flat list of values. For each key it has one value, or for a cubic
    spline three: the tangent before the key, the value, and the tangent after it. The
    weights of morph targets have one number per target in each value.

    Args:
        file: the glTF file.
        animation: the clip.
        channel: one of its channels.
        target_counts: number of morph targets, by node.

    Raises:
        FileFormatError: its keys violate the format.
    """
    sampler = animation.samplers[channel.sampler_index]
    node = channel.target.node
    assert node is not None  # for mypy: `_read_clips` leaves others out
    property_name = channel.target.path
    times = _read_times(file, sampler.input)
    _check_movable_node(file, node, property_name)
    values_per_key = 3 if sampler.interpolation == "CUBICSPLINE" else 1
    n_targets = target_counts[node] if property_name == "weights" else 1
    shape = (len(times), values_per_key, n_targets)
    keys = _read_keys(file, sampler.output, property_name, shape)
    if property_name == "rotation":
        _check_clip_rotations(file.path, keys)
    return Track(node, property_name, sampler.interpolation, times, keys)


def _check_movable_node(file: GltfFile, node: int, property_name: str) -> None:
    """Raise FileFormatError if a clip sets the transform of a node that has a matrix."""
    # Weights move vertices, and not the node itself.
    if file.header.nodes[node].matrix is not None and property_name != "weights":
        raise damaged(
            file.path, f"a node {node} without matrix, because a clip moves it", "one"
        )


def _check_clip_rotations(path: Path, keys: Float64Array) -> None:
    """Raise FileFormatError if a rotation of a clip has a length of about 0.

    Args:
        path: path of the file.
        keys: (K, 1 or 3, 4) a quaternion for each key, or for a cubic spline tangent,
            quaternion and tangent.
    """
    value_index = 1 if keys.shape[1] == 3 else 0
    quaternions = keys[:, value_index]  # (K, 4)
    lengths = np.linalg.norm(quaternions, axis=1)
    if not (lengths > MIN_QUATERNION_LENGTH).all():  # also for NaN
        raise damaged(
            path,
            "rotations of a clip that are unit quaternions",
            "one of length 0",
        )


def _read_keys(
    file: GltfFile, index: int, property_name: str, shape: tuple[int, int, int]
) -> Float64Array:
    """Return the values of the keys of a clip, (keys, values per key, numbers).

    Args:
        file: the glTF file.
        index: accessor of the values.
        property_name: the property that they set, a key of `VALUE_WIDTHS`.
        shape: number of keys, of values for each key, and of morph targets (1 for a
            property other than weights).

    Raises:
        FileFormatError: the number of values, or of numbers in a value, is wrong; or a
            number is NaN or infinite.
    """
    n_keys, values_per_key, n_targets = shape
    width = VALUE_WIDTHS[property_name]
    count = n_keys * values_per_key * n_targets
    output = file.header.accessors[index]
    if output.count != count or output.width != width:
        values_text = f"{count:,} values of {_count_numbers(width)}"
        expected = f"{values_text} for {n_keys:,} keys of a {property_name}"
        raise damaged(file.path, expected, f"{output.count:,} of {output.width}")
    values = file.read_float_rows(index, np.arange(count))
    finite_values = _require_finite(file.path, "the keys of a clip", values)
    return finite_values.reshape(n_keys, values_per_key, n_targets * width)


def _count_numbers(count: int) -> str:
    """Return a count of numbers in words, such as "1 number"."""
    return f"{count} numbers" if count > 1 else f"{count} number"


def _read_times(file: GltfFile, index: int) -> Float64Array:
    """Return the times (K,) in seconds of the keys of a clip, which must rise.

    Args:
        file: the glTF file.
        index: accessor of the times.

    Raises:
        FileFormatError: the accessor is of another type, or the times do not rise from
            0 or later.
    """
    path = file.path
    accessor = file.header.accessors[index]
    _check_times_accessor(path, accessor)
    values = file.read_float_rows(index, np.arange(accessor.count))
    times = _require_finite(path, "the times of a clip", values)[:, 0]
    if times[0] < 0.0 or (np.diff(times) <= 0.0).any():
        raise damaged(
            path, "times of a clip from 0 that rise from key to key", "others"
        )
    return times


def _check_times_accessor(path: Path, accessor: Accessor) -> None:
    """Raise FileFormatError unless an accessor has 32-bit floats, one for each key."""
    is_float32 = accessor.componentType == FLOAT32
    if accessor.type != "SCALAR" or not is_float32 or not accessor.count:
        raise damaged(
            path,
            "keys of a clip at times in seconds, of type SCALAR and 32-bit floats",
            "others",
        )


def _require_finite(path: Path, what: str, values: Float64Array) -> Float64Array:
    """Return values, or raise FileFormatError if some are NaN or infinite."""
    if not np.isfinite(values).all():
        raise damaged(path, f"finite numbers in {what}", "NaN or infinite ones")
    return values
