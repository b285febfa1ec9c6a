"""glTF: where cameras look, what skins move, how lights and surfaces that shine compare, and packed geometry."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_gltf import SQUARE, File

from advsearch.errors import InputError
from advsearch.scene.description import SceneDescription, load_description
from advsearch.scene.importing.objects import read_parts
from advsearch.scene.importing.scenes import LUMENS, import_scene
from advsearch.scene.parts import PointLamp

QUARTER = math.sqrt(0.5)


def square(**material: Any) -> File:
    file = File(**material)
    file.primitive()
    file.header["nodes"] = [{"mesh": 0, "name": "plate"}]
    return file


def add(file: File, **node: Any) -> int:
    file.header["nodes"].append(node)
    file.header["scenes"][0]["nodes"].append(len(file.header["nodes"]) - 1)
    return len(file.header["nodes"]) - 1


def with_camera(folder: Path, lens: dict[str, float], **node: Any) -> SceneDescription:
    file = square()
    file.header["cameras"] = [{"type": "perspective", "perspective": {"yfov": 0.8, **lens}, "name": "front"}]
    add(file, camera=0, translation=[0.5, 0.5, 2.0], **node)
    return load_description(f"{file.write(folder)}#plate").with_camera("front")


@pytest.mark.parametrize("aspect", [0.5, 1.0, 2.0])
def test_a_camera_without_aspect_has_its_angle_along_the_height(aspect: float, tmp_path: Path) -> None:
    """Section 3.10.3: without aspectRatio that of the viewport holds."""
    scene = with_camera(tmp_path, {})
    height = math.tan(math.radians(_at(scene, aspect).get_number("camera.fov")) / 2.0) / max(aspect, 1.0)
    assert height == pytest.approx(math.tan(0.4))


@pytest.mark.parametrize("aspect", [0.5, 1.0, 2.0])
def test_a_camera_with_aspect_sees_all_that_its_own_picture_has(aspect: float, tmp_path: Path) -> None:
    scene = with_camera(tmp_path, {"aspectRatio": 1.5})
    assert math.tan(math.radians(_at(scene, aspect).get_number("camera.fov")) / 2.0) == pytest.approx(
        math.tan(0.4) * 1.5
    )


def _at(scene: SceneDescription, aspect: float) -> SceneDescription:
    return replace(scene, aspect=aspect)


@pytest.mark.parametrize(
    ("scale", "above", "words"),
    [
        ([-1.0, 1.0, 1.0], {}, "mirrored"), ([1.0, 1.0, 1.0], {"scale": [1.0, 1.0, -1.0]}, "mirrored"),
        ([1.0, 1.0, 1.0], {"scale": [1.0, 3.0, 1.0]}, "sheared"), ([1.0, 1.0, 1.0], {"scale": [3.0, 3.0, 3.0]}, None),
    ],
)  # fmt: skip
def test_a_camera_under_a_mirror_or_a_shear_is_refused(
    scale: list[float], above: dict[str, Any], words: str | None, tmp_path: Path
) -> None:
    """Below a node that turns by 45 degrees, so that another scale above it is a shear."""
    file = square()
    file.header["cameras"] = [{"type": "perspective", "perspective": {"yfov": 0.8}, "name": "front"}]
    turned = {"rotation": [math.sin(math.pi / 8), 0.0, 0.0, math.cos(math.pi / 8)]}
    file.header["nodes"] += [{"camera": 0, "scale": scale, **turned}]
    add(file, children=[1], **above)
    path = file.write(tmp_path)
    if words is None:
        import_scene(path, "plate")
        return
    with pytest.raises(InputError, match=f"the camera front under nodes .* {words} axes"):
        import_scene(path, "plate")


@pytest.mark.parametrize(
    ("generator", "shines", "candela"),
    [("", True, 1.0), ("Khronos glTF Blender I/O v4.2.57", True, LUMENS), ("", False, LUMENS)],
)
def test_candela_and_nit_are_of_one_kind(generator: str, shines: bool, candela: float, tmp_path: Path) -> None:
    """A lamp of c candela at a distance of d lights a matt white plate so that it is as bright as c / (pi d^2) nit."""
    file = square(emissiveFactor=[1.0, 1.0, 1.0] if shines else [0.0] * 3)
    file.header["asset"]["generator"] = generator
    lights = [{"type": "point", "intensity": 39.27}]
    file.header["extensions"] = {"KHR_lights_punctual": {"lights": lights}}
    add(file, translation=[0.5, 0.5, 1.0], extensions={"KHR_lights_punctual": {"light": 0}})
    scene = load_description(f"{file.write(tmp_path)}#plate")
    (lamp,) = scene.lamps.values()
    assert isinstance(lamp, PointLamp)
    assert lamp.intensity[0] == pytest.approx(39.27 / candela)  # the plate's side is the unit
    glow = scene.object.emission
    assert (glow is not None) == shines and (glow is None or float(glow.max()) == 1.0)
    said = " ".join(scene.notes)
    assert ("candela and nit" in said) == (shines and not generator) and ("as Blender shows them" in said) == bool(
        generator
    )


def matrices(*given: np.ndarray) -> np.ndarray:
    return np.stack([one.T.reshape(16) for one in given])


def bound_square(weights: np.ndarray, inverse: list[np.ndarray] | None, **node: Any) -> File:
    """A square whose corners are bound to two joints, the second of which is moved by (0, 0, 2)."""
    file = File()
    joints = np.tile([0, 1, 0, 0], (4, 1))
    file.primitive(attributes={"JOINTS_0": file.values(joints, "u1"), "WEIGHTS_0": file.values(weights)})
    file.header["nodes"] = [{"mesh": 0, "skin": 0, **node}, {"translation": [1.0, 0.0, 0.0]}]
    file.header["nodes"].append({"translation": [1.0, 0.0, 2.0]})
    file.header["scenes"][0]["nodes"] += [1, 2]
    file.header["skins"] = [{"joints": [1, 2]}]
    if inverse is not None:
        index = file.values(matrices(*inverse))
        file.header["skins"][0]["inverseBindMatrices"] = index
    return file


def moved(x: float, y: float, z: float) -> np.ndarray:
    found = np.eye(4)
    found[:3, 3] = x, y, z
    return found


def vertices(file: File, folder: Path) -> np.ndarray:
    path = file.write(folder)
    (part,), _ = read_parts(path, path.read_bytes())
    return part.vertices


def test_only_joints_move_a_skin_and_not_its_own_node(tmp_path: Path) -> None:
    """Section 3.7.3: joint x inverse bind matrix; the transform of the skinned mesh's node is ignored."""
    first = np.tile([1.0, 0.0, 0.0, 0.0], (4, 1))
    turned = {"rotation": [QUARTER, 0.0, 0.0, QUARTER], "translation": [5.0, 5.0, 5.0], "scale": [3.0, 3.0, 3.0]}
    undone = bound_square(first, [moved(-1.0, 0.0, 0.0), moved(-1.0, 0.0, -2.0)], **turned)
    assert vertices(undone, tmp_path) == pytest.approx(SQUARE)
    assert vertices(bound_square(first, None, **turned), tmp_path) == pytest.approx(SQUARE + np.array([1.0, 0.0, 0.0]))


def test_weights_blend_and_add_up_to_one(tmp_path: Path) -> None:
    weights = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.25, 0.25, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]])
    height = np.array([0.0, 2.0, 1.0, 0.0])
    found = vertices(bound_square(weights, None), tmp_path)
    assert found[:, 2] == pytest.approx(height) and found[:, 0] == pytest.approx(SQUARE[:, 0] + 1.0)


def test_a_mesh_is_posed_as_a_rigid_one_that_its_joint_carries(tmp_path: Path) -> None:
    """With normals, and where the joint is mirrored: as if the mesh hung on the joint's node."""
    for scale in ([1.0, 2.0, 3.0], [1.0, -2.0, 1.0]):
        joint = {"rotation": [0.1, 0.2, 0.3, 0.927], "scale": scale, "translation": [1.0, 2.0, 3.0]}
        skinned, rigid = File(), File()
        for file in (skinned, rigid):
            given = {"NORMAL": file.values(np.tile([0.6, 0.0, 0.8], (4, 1)))}
            if file is skinned:
                given["JOINTS_0"] = file.values(np.zeros((4, 4)), "u1")
                given["WEIGHTS_0"] = file.values(np.tile([1.0, 0.0, 0.0, 0.0], (4, 1)))
            file.primitive(attributes=given)
        rigid.header["nodes"] = [{"mesh": 0, **joint}]
        skinned.header["nodes"] = [{"mesh": 0, "skin": 0, "translation": [9.0, 0.0, 0.0]}, joint]
        skinned.header["skins"] = [{"joints": [1]}]
        (ours,), (theirs,) = (read_parts(p, p.read_bytes())[0] for p in (f.write(tmp_path) for f in (skinned, rigid)))
        assert ours.vertices == pytest.approx(theirs.vertices)
        assert np.array_equal(ours.faces, theirs.faces)
        assert ours.normals is not None and theirs.normals is not None
        lengths = (np.linalg.norm(one, axis=1, keepdims=True) for one in (ours.normals, theirs.normals))
        assert ours.normals / next(lengths) == pytest.approx(theirs.normals / next(lengths))
