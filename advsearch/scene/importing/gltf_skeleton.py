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
    # A file has sets of four joints and weights a vertex: JOINTS_0, JOINTS_1, ...
    sets = list[VertexJoints]()
    while f"JOINTS_{len(sets)}" in primitive.attributes:
        if len(sets) == MAX_JOINT_SETS:
            raise damaged(
                file.path, f"at most {4 * MAX_JOINT_SETS} joints of each vertex", "more"
            )
        sets.append(_read_joint_set(file, primitive, used, len(sets)))
    if not sets:
        return None
    joints = np.concatenate([joint_set.joints for joint_set in sets], axis=1)
    weights = np.concatenate([joint_set.weights for joint_set in sets], axis=1)
    total = weights.sum(axis=1, keepdims=True)
    has_weights = total > 0.0
    # A vertex without weights moves with its first joint: (1, 0, 0, ...).
    only_first = np.zeros(weights.shape[1])
    only_first[0] = 1.0
    normalized = np.where(
        has_weights, weights / np.where(has_weights, total, 1.0), only_first
    )
    return VertexJoints(joints, normalized)


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
    accessors = file.header.accessors
    joints_index = attributes[f"JOINTS_{index}"]
    weights_index = attributes.get(f"WEIGHTS_{index}")
    n_vertices = accessors[attributes["POSITION"]].count
    if (
        weights_index is None
        or not _is_vec4(accessors[joints_index], n_vertices)
        or not _is_vec4(accessors[weights_index], n_vertices)
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
    min_joint = int(vertex_joints.joints.min(initial=0))
    max_joint = int(vertex_joints.joints.max(initial=0))
    if max_joint >= len(matrices) or min_joint < 0:
        wrong_joint = min_joint if min_joint < 0 else max_joint
        raise damaged(
            path,
            f"joints under {len(matrices)}, as its skin has",
            f"number {wrong_joint}",
        )
    # (V, 3, 4): the weighted mean of the matrices of a vertex's joints
    transforms = np.zeros((len(part.vertices), 3, 4))
    for joint, weight in zip(
        vertex_joints.joints.T, vertex_joints.weights.T, strict=True
    ):
        transforms += weight[:, None, None] * matrices[joint, :3]
    linear = transforms[:, :, :3]
    normals = part.normals
    vertices = np.einsum("vij,vj->vi", linear, part.vertices) + transforms[:, :, 3]
    if normals is not None:
        # The matrix of cofactors is the inverse transpose times the determinant, and
        # exists also for matrices without an inverse. Its row i is the cross product of
        # the rows i + 1 and i + 2.
        cofactors = np.cross(linear[:, [1, 2, 0]], linear[:, [2, 0, 1]])
        normals = np.einsum("vij,vj->vi", cofactors, normals)
    # Then all faces are turned over. If only some vertices are mirrored, there is no
    # winding that fits all faces, and it stays as it is.
    are_all_mirrored = bool((np.linalg.det(linear) < 0.0).all())
    return replace_geometry(part, vertices, normals, is_mirrored=are_all_mirrored)


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
    names = extras.get("targetNames") if isinstance(extras, dict) else None
    if not isinstance(names, list):
        names = []
    targets = list[MorphTarget]()
    normal_offsets = list[Float64Array | None]()
    for index, attributes in enumerate(primitive.targets):
        offsets = _read_offsets(file, primitive, attributes, "POSITION", used)
        if offsets is None:  # the target moves normals alone
            offsets = np.zeros((len(used), 3))
        moved_vertices = np.flatnonzero(offsets.any(axis=1))
        name = f"target-{index}"
        if index < len(names) and isinstance(names[index], str):
            name = names[index]
        targets.append(
            MorphTarget(sanitize_name(name), moved_vertices, offsets[moved_vertices])
        )
        normal_offsets.append(
            _read_offsets(file, primitive, attributes, "NORMAL", used)
        )
    return tuple(targets), tuple(normal_offsets)


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
    accessors = file.header.accessors
    accessor = accessors[attributes[name]]
    count = accessors[primitive.attributes["POSITION"]].count
    if accessor.type != "VEC3" or accessor.count != count:
        raise damaged(
            file.path,
            f"a {name} of type VEC3 for each vertex in a morph target",
            "others",
        )
    offsets = file.read_float_rows(attributes[name], used)
    return _require_finite(file.path, "morph targets", offsets)


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
    header = file.header
    n_targets = dict[int, int]()
    n_moves = 0
    for node in mesh_nodes:
        entry = header.nodes[node]
        primitives: Sequence[Primitive] = ()
        if entry.mesh is not None:
            primitives = header.meshes[entry.mesh].primitives
        counts = {len(primitive.targets) for primitive in primitives}
        if len(counts) > 1:
            raise damaged(
                file.path,
                "as many morph targets in all primitives of a mesh",
                "different numbers",
            )
        n_targets[node] = max(counts, default=0)
        # The limit is for memory: each primitive stores a matrix for each joint of its
        # skin, and an offset of each vertex for each target.
        if entry.skin is not None:
            n_moves += len(primitives) * len(header.skins[entry.skin].joints)
        n_moves += n_targets[node] * _count_vertices(header, primitives)
    check_most(
        file.path,
        n_moves,
        MAX_MOVES,
        "at most {} vertices of morph targets and joints of primitives",
    )
    return n_targets


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
    header = file.header
    node_skins = {header.nodes[node].skin for node in target_counts}
    skins = {skin for skin in node_skins if skin is not None}
    clips = _read_clips(file, target_counts, skins)
    if not (skins or clips or any(target_counts.values())):
        return None
    # quaternions (x, y, z, w); the identity for nodes without a rotation
    rotations = np.array(
        [node.rotation or [0.0, 0.0, 0.0, 1.0] for node in header.nodes]
    )
    lengths = np.linalg.norm(rotations, axis=1, keepdims=True)
    return Skeleton(
        source=file.path.name,
        names=_name_nodes(header),
        parents=np.array(header.parent_of_node),
        local_matrices=np.stack([compute_matrix(node) for node in header.nodes]),
        translations=np.array([node.translation or [0.0] * 3 for node in header.nodes]),
        rotations=np.asarray(rotations / np.maximum(lengths, 1e-12)),
        scales=np.array([node.scale or [1.0] * 3 for node in header.nodes]),
        has_matrix=np.array([node.matrix is not None for node in header.nodes]),
        clips=clips,
    )


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
    check_most(
        file.path,
        _count_key_numbers(header, used_channels),
        MAX_KEY_NUMBERS,
        "clips of at most {} numbers",
    )
    unique_names = UniqueNames()
    clips = list[Clip]()
    for index, (animation, channels) in enumerate(
        zip(header.animations, used_channels, strict=True)
    ):
        if channels:
            tracks = [
                _read_track(file, animation, channel, target_counts)
                for channel in channels
            ]
            name = unique_names.make_unique(animation.name or f"clip-{index}")
            clips.append(Clip(name, tuple(tracks)))
    return tuple(clips)


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

    def moves_geometry(channel: Channel) -> bool:
        """Return whether a channel sets something that moves geometry."""
        node = channel.target.node
        property_name = channel.target.path
        if node is None or property_name not in VALUE_WIDTHS:
            return False  # the channel sets a property of an extension
        if property_name == "weights":
            return target_counts.get(node, 0) > 0
        return node in moving_nodes

    return [
        list(filter(moves_geometry, animation.channels))
        for animation in header.animations
    ]


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
    # Weights move vertices, and not the node itself.
    if file.header.nodes[node].matrix is not None and property_name != "weights":
        raise damaged(
            file.path, f"a node {node} without matrix, because a clip moves it", "one"
        )
    values_per_key = 3 if sampler.interpolation == "CUBICSPLINE" else 1
    n_targets = target_counts[node] if property_name == "weights" else 1
    shape = (len(times), values_per_key, n_targets)
    keys = _read_keys(file, sampler.output, property_name, shape)
    if property_name == "rotation":
        # The three values of a cubic spline are tangent, value and tangent.
        value_index = 1 if values_per_key == 3 else 0
        quaternions = keys[:, value_index]  # (K, 4)
        lengths = np.linalg.norm(quaternions, axis=1)
        if not (lengths > MIN_QUATERNION_LENGTH).all():  # also for NaN
            raise damaged(
                file.path,
                "rotations of a clip that are unit quaternions",
                "one of length 0",
            )
    return Track(node, property_name, sampler.interpolation, times, keys)


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
    output = file.header.accessors[index]
    count = n_keys * values_per_key * n_targets
    if output.count != count or output.width != width:
        expected = (
            f"{count:,} values of {_count_numbers(width)} for "
            f"{n_keys:,} keys of a {property_name}"
        )
        raise damaged(file.path, expected, f"{output.count:,} of {output.width}")
    values = file.read_float_rows(index, np.arange(count))
    return _require_finite(file.path, "the keys of a clip", values).reshape(
        n_keys, values_per_key, n_targets * width
    )


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
    is_float32 = accessor.componentType == FLOAT32
    if accessor.type != "SCALAR" or not is_float32 or not accessor.count:
        raise damaged(
            path,
            "keys of a clip at times in seconds, of type SCALAR and 32-bit floats",
            "others",
        )
    values = file.read_float_rows(index, np.arange(accessor.count))
    times = _require_finite(path, "the times of a clip", values)[:, 0]
    if times[0] < 0.0 or (np.diff(times) <= 0.0).any():
        raise damaged(
            path, "times of a clip from 0 that rise from key to key", "others"
        )
    return times


def _require_finite(path: Path, what: str, values: Float64Array) -> Float64Array:
    """Return values, or raise FileFormatError if some are NaN or infinite."""
    if not np.isfinite(values).all():
        raise damaged(path, f"finite numbers in {what}", "NaN or infinite ones")
    return values
