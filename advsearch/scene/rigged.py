"""The rig of a glTF file: skins, morph targets and clips, differentiable in torch.

As glTF 2.0 (Khronos) defines nodes (section 3.5), skins and morph targets (sections
3.7.3 and 3.7.2.2):

    world_n = world_parent T R S
    moved   = sum_j w_j world_j inverse_bind_j (p + sum_t m_t d_t)

A clip sets T, R, S or m at a time by steps, by linear interpolation (of rotations on
the sphere) or by cubic Hermite splines (section 3.11 and appendix C). Rotations of
joints that the user sets are applied in addition: about the axes of the object at rest
(z up), first x, then y, then z. Ancestors of a joint rotate these axes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from advsearch.errors import InputError
from advsearch.options import Value
from advsearch.scene.assets import Float64Array, IntArray
from advsearch.scene.people import PARAMETERS, make_axis_rotation
from advsearch.scene.settings import Parameter
from advsearch.scene.skeleton import (
    Clip,
    Movable,
    Track,
    compute_rotation_entries,
    with_ancestors,
)

AXES = ("x", "y", "z")
PERSON_PARAMETERS = PARAMETERS  # all parameters of a person
WEIGHT = "weight"
_make_rig_parameter = partial(Parameter.moving, Parameter.GEOMETRIC)
TIME = _make_rig_parameter(
    "time",
    unit="1",
    low=0.0,
    high=1.0,
    default=0.0,
    text="Time in the clip of a rigged file: 0 is its beginning, 1 its end.",
    search=(0.0, 1.0),
)
# Cosine of the angle between two rotations above which the chord replaces the arc.
MAX_ARC_COSINE = 1.0 - 1e-9


def find_rig_parameter(name: str) -> Parameter | None:
    """Return the parameter of a name such as "Head.x" or "Smile.weight".

    It is the turn of a joint about x, y or z, or the weight of a morph target. The
    result is None for other names. It is not checked whether an object has such a joint
    or target.
    """
    owner, dot, component = name.rpartition(".")
    if not (owner and dot and component in (*AXES, WEIGHT)):
        return None
    if component == WEIGHT:
        text = f"Weight of the morph target {owner}."
        return _make_rig_parameter(
            name, unit="1", low=0.0, high=1.0, default=0.0, text=text
        )
    text = f"Turn of the joint {owner} about {component}."
    return _make_rig_parameter(
        name, unit="degrees", low=-360.0, high=360.0, default=0.0, text=text
    )


def _compose_matrices(translation: Tensor, rotation: Tensor, scale: Tensor) -> Tensor:
    """Return matrices (N, 4, 4) that scale, rotate and then translate.

    Args:
        translation: (N, 3).
        rotation: (N, 4) quaternions.
        scale: (N, 3).
    """
    scaled_turns = quaternions_to_matrices(rotation) * scale[:, None]
    last_row = torch.tensor(
        [0.0, 0.0, 0.0, 1.0], dtype=torch.float64, device=scaled_turns.device
    ).expand(len(scaled_turns), 1, 4)
    upper_rows = torch.cat([scaled_turns, translation[:, :, None]], dim=2)
    return torch.cat([upper_rows, last_row], dim=1)


class _MeshTarget(NamedTuple):
    """A morph target of one node, for those vertices of the mesh that it moves."""

    name: str
    node: int  # index of its node
    index_in_node: int  # index among the targets of the node
    rest_weight: float  # weight at rest
    rows: Tensor  # (K,) indices of the mesh's vertices that it moves
    offsets: Tensor  # (K, 3) offsets of these at weight 1

    def get_weight(self, clip_weights: Mapping[int, Tensor]) -> Tensor:
        """Return its weight () in a clip, or at rest if the clip does not set it.

        Args:
            clip_weights: for each node whose weights the clip sets, the weights (T,) of
                its targets.
        """
        if self.node in clip_weights:
            return clip_weights[self.node][self.index_in_node]
        return torch.tensor(self.rest_weight, dtype=torch.float64)


def _make_mesh_target(
    part: Movable, index: int, mesh_vertices: IntArray, part_vertices: IntArray
) -> _MeshTarget:
    """Return a morph target of a part, for the vertices of the mesh.

    Args:
        part: the part.
        index: index of the target in the part.
        mesh_vertices: (P,) indices of the mesh's vertices that are of this part.
        part_vertices: (P,) indices of the same vertices in the part.
    """
    target = part.targets[index]
    # for each vertex of the part the row of its offset; -1 if it has none
    offset_row_in_part = np.full(len(part.vertices), -1)
    offset_row_in_part[target.rows] = np.arange(len(target.rows))
    # the same for each of the mesh's vertices
    offset_row = offset_row_in_part[part_vertices]
    is_moved = offset_row >= 0
    return _MeshTarget(
        name=target.name,
        node=part.node,
        index_in_node=index,
        rest_weight=float(part.rest_weights[index]),
        rows=torch.from_numpy(mesh_vertices[is_moved]),
        offsets=torch.from_numpy(target.offsets[offset_row[is_moved]]),
    )


class _JointArrays(NamedTuple):
    """Arrays of all parts of a file, for the vertices of a mesh.

    Attributes:
        points: positions at rest (V, 3).
        joints: joints (V, n), as indices of `nodes`.
        weights: their weights (V, n).
        nodes: (J,) index of each joint's node in the file.
        inverse_binds: inverse bind matrices (J, 4, 4) of the joints.
    """

    points: Tensor
    joints: Tensor
    weights: Tensor
    nodes: Tensor
    inverse_binds: Tensor

    @classmethod
    def join(cls, parts: Sequence[Movable], vertices: IntArray) -> _JointArrays:
        """Concatenate the arrays of all parts, and select rows for the mesh.

        Args:
            parts: parts of the file.
            vertices: (V,) for each vertex of the mesh its index in the concatenated
                vertices of all parts.
        """
        points = np.concatenate([part.vertices for part in parts])
        joints = _concatenate_joints(parts)
        weights = np.concatenate(
            [_pad_columns(part.weights, joints.shape[1]) for part in parts]
        )
        nodes = np.concatenate([part.joint_nodes for part in parts])
        inverse_binds = np.concatenate([part.inverse_binds for part in parts])
        return cls(
            points=torch.from_numpy(points[vertices]),
            joints=torch.from_numpy(joints[vertices]),
            weights=torch.from_numpy(weights[vertices]),
            nodes=torch.from_numpy(nodes),
            inverse_binds=torch.from_numpy(inverse_binds),
        )


def _concatenate_joints(parts: Sequence[Movable]) -> IntArray:
    """Return the joints (vertices, n) of all parts, as indices of their joined nodes.

    A joint of a part is an index into the part's list of nodes. The lists of all parts
    are concatenated. n is the largest number of joints that a vertex has.
    """
    max_joints = max(part.joints.shape[1] for part in parts)
    # index of the first node of each part among those of all parts
    node_counts = [len(part.joint_nodes) for part in parts]
    node_starts = np.cumsum(node_counts) - node_counts
    return np.concatenate(
        [
            _pad_columns(part.joints + start, max_joints)
            for part, start in zip(parts, node_starts, strict=True)
        ]
    )


def _pad_columns(values: np.ndarray, count: int) -> np.ndarray:
    """Pad an array (V, n) of joints or weights with zeros to (V, count)."""
    return np.pad(values, ((0, 0), (0, count - values.shape[1])))


class SkeletonRig:
    """Moves the mesh of a glTF file.

    Attributes:
        skeleton: the nodes and clips of the file.
    """

    def __init__(
        self, parts: Sequence[Movable], vertices: IntArray, to_mesh: Float64Array
    ) -> None:
        """Bring the arrays of all parts into the order of the mesh's vertices.

        Args:
            parts: parts of the file that move with the skeleton; all share it.
            vertices: (V,) for each vertex of the mesh its index in the concatenated
                vertices of all parts.
            to_mesh: (3, 3) from the file's axes and unit to the mesh's.
        """
        self.skeleton = parts[0].skeleton
        self._to_mesh = torch.from_numpy(to_mesh)
        # Rotations that the user sets are about the mesh's axes. To convert them to the
        # file's, `to_mesh` is needed without its scale, the cube root of its
        # determinant.
        unit_to_mesh = to_mesh / np.cbrt(np.linalg.det(to_mesh))
        self._rotation_to_mesh = torch.from_numpy(unit_to_mesh)
        arrays = _JointArrays.join(parts, vertices)
        self._points = arrays.points
        self._joints = arrays.joints  # rows of `_nodes`
        self._weights = arrays.weights
        self._nodes = arrays.nodes
        self._inverse_binds = arrays.inverse_binds
        self._targets: list[_MeshTarget] = []
        self._add_targets(parts, vertices)
        self._nodes_by_depth = _group_by_depth(self.skeleton.parents)
        # for each node its row among the nodes that are ordered by depth
        nodes_from_roots = torch.cat([nodes for nodes, _ in self._nodes_by_depth])
        self._node_order = torch.argsort(nodes_from_roots)
        self._local_matrices = torch.from_numpy(self.skeleton.local_matrices)
        self._axes = self._compute_rest_axes()
        self._rest = self.pose({})

    def _compute_rest_axes(self) -> Tensor:
        """Return the axes (N, 3, 3) of each node at rest, in the file's axes.

        They are the orthogonal matrix nearest to the node's matrix, without its scale
        and shear (polar decomposition). They mirror if the node's matrix does.
        """
        linear = self._compute_world(self._local_matrices)[:, :3, :3].numpy()
        left, _, right = np.linalg.svd(linear)
        return torch.from_numpy(left @ right)

    def _add_targets(self, parts: Sequence[Movable], vertices: IntArray) -> None:
        """Store the morph targets of parts, for the vertices (V,) of the mesh.

        A morph target moves some vertices of its part by offsets. The mesh has the
        part's vertices in another order, some several times and some not at all: the
        offsets are put into the order of the mesh.

        Args:
            parts: parts of the file.
            vertices: (V,) for each vertex of the mesh its index in the concatenated
                vertices of all parts.
        """
        start = 0  # index of the part's first vertex among those of all parts
        for part in parts:
            n_vertices = len(part.vertices)
            # the mesh's vertices that are of this part, and their indices in the part
            is_of_part = (vertices >= start) & (vertices < start + n_vertices)
            mesh_vertices = np.flatnonzero(is_of_part)
            part_vertices = vertices[mesh_vertices] - start
            self._targets += [
                _make_mesh_target(part, index, mesh_vertices, part_vertices)
                for index in range(len(part.targets))
            ]
            start += n_vertices

    # ---- Parameters ----

    @property
    def clips(self) -> tuple[str, ...]:
        """Names of the animations."""
        return tuple(clip.name for clip in self.skeleton.clips)

    @cached_property
    def node_of_joint(self) -> dict[str, int]:
        """The nodes that move something, by name."""
        moving = with_ancestors(
            self.skeleton.parents, [int(node) for node in self._nodes]
        )
        return {self.skeleton.names[node]: node for node in sorted(moving)}

    @property
    def targets(self) -> tuple[str, ...]:
        """Names of the morph targets, each once."""
        return tuple(dict.fromkeys(target.name for target in self._targets))

    @property
    def defaults(self) -> Mapping[str, float]:
        """Values of all parameters at rest, by name."""
        time = {TIME.name: 0.0} if self.clips else {}
        angles = {f"{name}.{axis}": 0.0 for name in self.node_of_joint for axis in AXES}
        # If targets have the same name, the weight of the first is used. In the
        # reversed order it comes last, and replaces the others.
        weights = {
            f"{target.name}.{WEIGHT}": target.rest_weight
            for target in reversed(self._targets)
        }
        return time | angles | weights

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The time of a clip, turns of joints and weights of morph targets."""
        parameters = (
            TIME if name == TIME.name else find_rig_parameter(name)
            for name in self.defaults
        )
        # All of these names have a parameter; the condition is for the type.
        return tuple(parameter for parameter in parameters if parameter is not None)

    def get_measurements(
        self, values: Mapping[str, Tensor], clip: str | None = None
    ) -> Mapping[str, Value]:
        """Return the time in a clip, in seconds."""
        if clip is None:
            return {}
        _, seconds = self._find_clip_time(clip, values)
        return {"seconds": {"value": float(seconds), "unit": "s"}}

    # ---- Vertices ----

    def offsets(self, values: Mapping[str, Tensor], clip: str | None = None) -> Tensor:
        """Return how far the vertices of the mesh move from rest, (V, 3) float32.

        The result is in the unit of the mesh, and differentiable.

        Args:
            values: scalar tensors by the names of `parameters`, such as "Head.z".
                Missing ones have the values of the clip, or those at rest.
            clip: name of an animation of the file; None for the pose at rest.

        Raises:
            InputError: the file's numbers are so large that vertices are not finite.
        """
        posed = self.pose(values, clip)
        device = posed.device
        # `_to_mesh` is the linear map from the file's coordinates to the mesh's
        offsets = (posed - self._rest.to(device)) @ self._to_mesh.to(device).T
        if not bool(torch.isfinite(offsets.detach()).all()):
            cause = f"the clip {clip}" if clip else "such angles"
            raise InputError(
                f"{self.skeleton.source}: {cause} would move vertices infinitely far "
                "away; choose others"
            )
        return offsets.float()

    def pose(self, values: Mapping[str, Tensor], clip: str | None = None) -> Tensor:
        """Return the vertices (V, 3) float64 in the file's axes and unit.

        First the clip poses the nodes, then the joints are rotated. The vertices are
        morphed, and then moved with their joints (linear blend skinning).

        Args:
            values: numbers by parameter, such as "Head.z": rotations of joints in
                degrees, weights of morph targets, and the time in the clip.
            clip: name of the clip of the animation; None for the pose at rest.
        """
        device = next(iter(values.values()), torch.zeros(())).device
        number_by_name = {name: value.double() for name, value in values.items()}
        local_matrices = self._local_matrices.to(device)
        clip_weights = dict[int, Tensor]()
        if clip is not None:
            playing_clip, seconds = self._find_clip_time(clip, number_by_name)
            local_matrices, clip_weights = self._play_clip(
                playing_clip, seconds.to(device)
            )
        local_matrices = self._turn_joints(local_matrices, number_by_name)
        joint_matrices = self._compute_joint_matrices(local_matrices)
        points = self._compute_morphed_vertices(number_by_name, clip_weights, device)
        matrices = self._blend_joint_matrices(joint_matrices)
        return (
            torch.einsum("vij,vj->vi", matrices[:, :, :3], points) + matrices[:, :, 3]
        )

    def _compute_joint_matrices(self, local_matrices: Tensor) -> Tensor:
        """Return the matrices (joints, 3, 4) from the rest pose to the scene.

        They are without the last row, which is 0 0 0 1.

        Args:
            local_matrices: (N, 4, 4) from each node to its parent.
        """
        device = local_matrices.device
        world = self._compute_world(local_matrices)
        world_of_joint = world[self._nodes.to(device)]
        return (world_of_joint @ self._inverse_binds.to(device))[:, :3]

    def _blend_joint_matrices(self, joint_matrices: Tensor) -> Tensor:
        """Return the weighted mean (V, 3, 4) of the matrices of each vertex's joints.

        Args:
            joint_matrices: (joints, 3, 4).
        """
        weights = self._weights.to(joint_matrices.device)
        joints = self._joints.to(joint_matrices.device)
        matrices = sum(
            weights[:, k, None, None] * joint_matrices[joints[:, k]]
            for k in range(joints.shape[1])
        )
        assert isinstance(matrices, Tensor)
        return matrices

    def _compute_morphed_vertices(
        self,
        number_by_name: Mapping[str, Tensor],
        clip_weights: Mapping[int, Tensor],
        device: torch.device,
    ) -> Tensor:
        """Return the vertices (V, 3) of the meshes with morph targets applied.

        Args:
            number_by_name: values of parameters such as "Smile.weight", which replace
                those of a clip.
            clip_weights: for each node whose weights the clip sets, the weights (T,) of
                its targets.
            device: device of the result.
        """
        points = self._points.to(device)
        for target in self._targets:
            # the parameter's value, or else the clip's, or else that at rest
            weight = number_by_name.get(f"{target.name}.{WEIGHT}")
            if weight is None:
                weight = target.get_weight(clip_weights)
            # A weight of 0 changes nothing, and is left out to save time, unless its
            # derivative is required.
            if weight.requires_grad or float(weight) != 0.0:
                offsets = weight.to(device) * target.offsets.to(device)
                points = points.index_add(0, target.rows.to(device), offsets)
        return points

    def _find_clip_time(
        self, name: str, values: Mapping[str, Tensor]
    ) -> tuple[Clip, Tensor]:
        """Return the clip of a name, and the time in it in seconds."""
        clip = next(clip for clip in self.skeleton.clips if clip.name == name)
        time = values.get(TIME.name, torch.zeros(())).double()
        return clip, clip.begin + (clip.end - clip.begin) * time

    def _play_clip(
        self, clip: Clip, seconds: Tensor
    ) -> tuple[Tensor, dict[int, Tensor]]:
        """Return the poses of nodes and the weights of morph targets in a clip.

        Args:
            clip: the clip.
            seconds: () time since the clip's start.

        Returns:
            The matrices (N, 4, 4) of all nodes to their parents; and for each node
            whose weights the clip sets, the weights (T,) of its morph targets.
        """
        local_matrices = self._sample_local_matrices(clip, seconds)
        weights = {
            track.node: sample_track(track, seconds)
            for track in clip.tracks
            if track.path == "weights"
        }
        return local_matrices, weights

    def _sample_local_matrices(self, clip: Clip, seconds: Tensor) -> Tensor:
        """Return the matrices (N, 4, 4) of all nodes to their parents in a clip.

        Properties that the clip does not set have their values at rest. A node whose
        pose is a matrix in the file cannot be animated.

        Args:
            clip: the clip.
            seconds: () time since the clip's start.
        """
        skeleton = self.skeleton
        device = seconds.device
        rest_values = {
            "translation": skeleton.translations,
            "rotation": skeleton.rotations,
            "scale": skeleton.scales,
        }
        properties = {
            path: _replace_animated(
                torch.from_numpy(rest).to(device), clip, path, seconds
            )
            for path, rest in rest_values.items()
        }
        composed = _compose_matrices(**properties)
        is_fixed = torch.from_numpy(skeleton.has_matrix).to(device)
        return torch.where(
            is_fixed[:, None, None], self._local_matrices.to(device), composed
        )

    def _turn_joints(
        self, local_matrices: Tensor, number_by_name: Mapping[str, Tensor]
    ) -> Tensor:
        """Return local matrices (N, 4, 4) with the user's rotations of joints applied.

        Rotations are about the axes of the object at rest: first x, then y, then z.

        Args:
            local_matrices: (N, 4, 4) from each node to its parent.
            number_by_name: degrees by names such as "Head.z"; other names are ignored.
        """
        device = local_matrices.device
        for joint in _list_turned_joints(number_by_name):
            node = self.node_of_joint[joint]
            rotation = _compose_axis_rotations(joint, number_by_name, device)
            rotation = self._convert_to_parent(rotation, node)
            turned_matrix = _rotate_linear_part(local_matrices[node], rotation)
            local_matrices = local_matrices.index_copy(
                0, torch.tensor([node], device=device), turned_matrix[None]
            )
        return local_matrices

    def _convert_to_parent(self, rotation: Tensor, node: int) -> Tensor:
        """Return a rotation (3, 3) about the mesh's axes in those of a node's parent.

        Local matrices are in the axes of the parent. The parent's axes are those at rest,
        also if a clip has moved the parent: so the axis of the rotation moves with the
        parent.
        """
        # The rotation is in the axes of the mesh, and is converted to those of the
        # file, and then to those of the parent node. If A maps vectors from the new axes to
        # the old ones, a rotation R becomes A^T R A.
        rotation_to_mesh = self._rotation_to_mesh.to(rotation.device)
        rotation = rotation_to_mesh.T @ rotation @ rotation_to_mesh
        parent = int(self.skeleton.parents[node])
        if parent >= 0:
            parent_axes = self._axes[parent].to(rotation.device)
            rotation = parent_axes.T @ rotation @ parent_axes
        return rotation

    def _compute_world(self, local_matrices: Tensor) -> Tensor:
        """Return the matrices (N, 4, 4) from nodes to the scene.

        They are computed depth by depth, from the roots on, and put back into the order
        of nodes.
        """
        device = local_matrices.device
        world_by_level = list[Tensor]()
        # `parent_rows` are the positions of the parents among the nodes of the previous
        # level.
        for nodes, parent_rows in self._nodes_by_depth:
            matrices = local_matrices[nodes.to(device)]
            if world_by_level:
                matrices = world_by_level[-1][parent_rows.to(device)] @ matrices
            world_by_level.append(matrices)
        return torch.cat(world_by_level)[self._node_order.to(device)]


def _list_turned_joints(names: Iterable[str]) -> list[str]:
    """Return the joints that have a rotation about any axis, each once and in order.

    Args:
        names: names of parameters; those of rotations are such as "Head.z".
    """
    split_names = [name.rpartition(".") for name in names]
    return list(dict.fromkeys(joint for joint, _, axis in split_names if axis in AXES))


def _replace_animated(
    rest_values: Tensor, clip: Clip, path: str, seconds: Tensor
) -> Tensor:
    """Return a property of all nodes (N, W), with the values of a clip where it has them.

    Args:
        rest_values: (N, W) values at rest.
        clip: the clip.
        path: name of the property in its tracks, such as "rotation".
        seconds: () time since the clip's start.
    """
    tracks = [track for track in clip.tracks if track.path == path]
    if not tracks:
        return rest_values
    nodes = torch.tensor([track.node for track in tracks], device=seconds.device)
    values = torch.stack([sample_track(track, seconds) for track in tracks])
    return rest_values.index_copy(0, nodes, values)


def _rotate_linear_part(matrix: Tensor, rotation: Tensor) -> Tensor:
    """Return a matrix (4, 4) whose linear part is rotated, and whose shift is the same.

    Args:
        matrix: (4, 4) from a node to its parent.
        rotation: (3, 3).
    """
    upper_rows = torch.cat([rotation @ matrix[:3, :3], matrix[:3, 3:]], dim=1)
    return torch.cat([upper_rows, matrix[3:]])


def _compose_axis_rotations(
    joint: str, number_by_name: Mapping[str, Tensor], device: torch.device
) -> Tensor:
    """Return the rotation (3, 3) of a joint: first about x, then y, then z.

    Args:
        joint: name of the joint.
        number_by_name: degrees by names such as "Head.z".
        device: device of the result.
    """
    rotation = torch.eye(3, dtype=torch.float64, device=device)
    for axis in AXES:
        degrees = number_by_name.get(f"{joint}.{axis}")
        if degrees is not None:
            rotation = make_axis_rotation(axis, degrees) @ rotation
    return rotation


def _group_by_depth(parents: IntArray) -> list[tuple[Tensor, Tensor]]:
    """Group nodes by depth, so that those of one depth are computed at once.

    Args:
        parents: (N,) the parent of each node, -1 for a root.

    Returns:
        For each depth, roots first: the nodes (n,), and for each the position of its
        parent among the nodes of the depth above (n,); without meaning for roots.
    """
    levels = list[tuple[Tensor, Tensor]]()
    nodes = np.flatnonzero(parents < 0)
    # position of each node among those of its depth; 0 until its depth is reached
    row_in_level = np.zeros(len(parents), np.int64)
    while len(nodes):
        parent_rows = row_in_level[parents[nodes]]
        levels.append((torch.from_numpy(nodes), torch.from_numpy(parent_rows)))
        row_in_level[nodes] = np.arange(len(nodes))
        nodes = np.flatnonzero(np.isin(parents, nodes))  # their children
    return levels


def sample_track(track: Track, seconds: Tensor) -> Tensor:
    """Return the value (W,) of a track at a time (glTF 2.0, appendix C).

    Between two keys the value is that of the first key (STEP), or it is interpolated:
    linearly, on the sphere if it is a rotation, or by a cubic Hermite spline
    (CUBICSPLINE). Before the first key and after the last it is constant. Rotations are
    quaternions of length 1. The value is differentiable in the time, except for STEP.

    Args:
        track: its `values` are (K, 1, W), or (K, 3, W) for a spline: the tangent before
            the key, the value, and the tangent after it.
        seconds: () time since the track's start.
    """
    times = torch.from_numpy(track.times).to(seconds.device)
    keys = torch.from_numpy(track.values).to(seconds.device)
    # The second axis has 1 entry, or 3 for a spline: tangent, value, tangent. Half of
    # its length, rounded down, is the index of the value.
    value_index = keys.shape[1] // 2
    is_rotation = track.path == "rotation"
    # the first key after the time; 0 or the number of keys outside of the track
    end_key = int(torch.searchsorted(times, seconds.detach(), right=True))
    is_between_keys = 0 < end_key < len(times)
    if track.interpolation == "STEP" or not is_between_keys:
        value = keys[max(0, end_key - 1), value_index]
        return value / value.norm() if is_rotation else value
    start_key = end_key - 1
    span = times[end_key] - times[start_key]
    fraction = (seconds - times[start_key]) / span
    if track.interpolation == "CUBICSPLINE":
        spline = _interpolate_spline(keys[start_key], keys[end_key], fraction, span)
        # 1e-12: never divide by 0
        return spline / spline.norm().clamp_min(1e-12) if is_rotation else spline
    # slerp interpolates on the sphere, lerp along a line
    interpolate = slerp if is_rotation else lerp
    return interpolate(
        keys[start_key, value_index], keys[end_key, value_index], fraction
    )


def lerp(start: Tensor, end: Tensor, fraction: Tensor) -> Tensor:
    """Interpolate linearly between two values (W,); the fraction () is 0 at the start."""
    return start + fraction * (end - start)


def _interpolate_spline(
    start_key: Tensor, end_key: Tensor, fraction: Tensor, span: Tensor
) -> Tensor:
    """Return the value (W,) of a cubic Hermite spline between two keys.

    Args:
        start_key: (3, W) of the first key the tangent before it, its value, and the
            tangent after it. Tangents are per second.
        end_key: (3, W) the same of the second key.
        fraction: () 0 at the first key and 1 at the second.
        span: () seconds between the keys.
    """
    _, start_value, tangent_after_start = start_key.unbind()
    tangent_before_end, end_value, _ = end_key.unbind()
    square = fraction**2
    cube = fraction**3
    return (
        (2.0 * cube - 3.0 * square + 1.0) * start_value
        + span * (cube - 2.0 * square + fraction) * tangent_after_start
        + (3.0 * square - 2.0 * cube) * end_value
        + span * (cube - square) * tangent_before_end
    )


def slerp(start: Tensor, end: Tensor, fraction: Tensor) -> Tensor:
    """Interpolate between two rotations along the shorter arc (Shoemake 1985).

    Rotations that are almost the same are interpolated along the chord, since the
    formula of the arc divides by the sine of their angle, which is almost 0.

    Args:
        start: (4,) quaternion.
        end: (4,) quaternion.
        fraction: () 0 at the start and 1 at the end.
    """
    start = start / start.norm()
    end = end / end.norm()
    cosine = start @ end
    # a quaternion and its negative are one rotation: take the one nearer to the start
    end = torch.where(cosine < 0.0, -end, end)
    cosine = cosine.abs()
    if float(cosine) > MAX_ARC_COSINE:
        chord: Tensor = start + fraction * (end - start)
        return chord.div(chord.norm())
    angle = torch.arccos(cosine)
    arc: Tensor = (
        torch.sin((1.0 - fraction) * angle) * start + torch.sin(fraction * angle) * end
    )
    return arc / torch.sin(angle)


def quaternions_to_matrices(quaternions: Tensor) -> Tensor:
    """Return the rotations (N, 3, 3) of unit quaternions (N, 4), x, y, z, w."""
    entries = compute_rotation_entries(*quaternions.unbind(dim=1))
    return torch.stack(entries, dim=1).reshape(-1, 3, 3)
