"""Skins of glTF: meshes that joints move, in the pose that the file's nodes have (glTF 2.0, section 3.7.3)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from advsearch.scene.assets import Doubles, Ints
from advsearch.scene.importing.files import damaged
from advsearch.scene.importing.gltf import Buffers
from advsearch.scene.importing.gltf_entries import Header, Primitive, Skin
from advsearch.scene.importing.parts import ImportedPart


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
    found = np.stack([poses[joint] for joint in skin.joints])
    if skin.inverseBindMatrices is None:
        return found
    values = buffers.values(skin.inverseBindMatrices)
    if values.shape[1:] != (16,) or len(values) < len(found):
        raise damaged(
            path, f"{len(found)} inverse bind matrices of 4 x 4", f"{len(values)} of {values.shape[1]} numbers"
        )
    return np.asarray(found @ values[: len(found)].astype(np.float64).reshape(-1, 4, 4).transpose(0, 2, 1))


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
