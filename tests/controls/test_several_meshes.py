"""Controls of other meshes than the object: `pose:post` moves the post as `pose` moves the object."""

import numpy as np
import pytest

from advsearch.controls import CONTROLS, Space, make_control, make_space
from advsearch.engine.loading import Scene
from advsearch.errors import InputError
from advsearch.scene.assembly import InputAssembler
from advsearch.scene.assets import Material, Mesh
from advsearch.scene.description import SceneDescription, load_description
from advsearch.scene.parts import MeshPart

HEIGHT = 0.5
"""The post stands on something of this height."""


@pytest.fixture(scope="module")
def scene() -> SceneDescription:
    """The mug with a post of 0.2 x 0.4 x 0.6 beside it, its middle at (2, -1)."""
    x, y, z = np.meshgrid([0.0, 0.2], [0.0, 0.4], [0.0, 0.6], indexing="ij")
    corners = np.stack([x, y, z], axis=-1).reshape(-1, 3).astype(np.float32)
    faces = np.array([[0, 1, 2], [1, 2, 3], [4, 5, 6], [5, 6, 7]], dtype=np.uint32)
    upwards = np.tile(np.array([0.0, 0.0, 1.0], dtype=np.float32), (8, 1))
    mesh = Mesh(corners, faces, upwards, np.zeros((8, 2), dtype=np.float32))
    place = np.eye(4)
    place[:3, 3] = 1.9, -1.2, HEIGHT
    color = np.full((4, 4, 3), 0.25, dtype=np.float32)
    return load_description("mug").with_part(MeshPart("post", mesh, color, Material(roughness=0.7), to_world=place))


def places(scene: SceneDescription, space: Space | None = None) -> np.ndarray:
    """Where the post's vertices are: in the clean scene, or at the start of a space."""
    if space is not None:
        vertices = InputAssembler(space.scene or scene)(space.inputs(space.start))["post.vertices"]
        return np.asarray(vertices.double().numpy())
    part = scene.meshes["post"]
    return np.asarray(part.mesh.vertices @ part.to_world[:3, :3].T + part.to_world[:3, 3])


def test_at_its_start_the_mesh_stands_where_it_stood(scene: SceneDescription) -> None:
    space = make_space([make_control("pose:post")], scene)
    np.testing.assert_allclose(places(scene, space), places(scene), atol=1e-6)
    assert set(space.inputs(space.start)) == {"post.to_world"}


def test_it_turns_about_its_own_middle_and_stays_on_what_it_stands_on(scene: SceneDescription) -> None:
    turned = places(scene, make_space([make_control("pose:post", {"yaw": [90.0, 91.0]})], scene))
    np.testing.assert_allclose(turned.min(axis=0), [1.8, -1.1, HEIGHT], atol=1e-5)
    np.testing.assert_allclose(turned.max(axis=0), [2.2, -0.9, HEIGHT + 0.6], atol=1e-5)
    lying = places(scene, make_space([make_control("pose:post", {"roll": [90.0, 91.0]})], scene))
    np.testing.assert_allclose(lying.min(axis=0)[2], HEIGHT, atol=1e-5)
    assert np.ptp(lying, axis=0) == pytest.approx([0.2, 0.6, 0.4], abs=1e-5)
    held = places(scene, make_space([make_control("pose:post", {"roll": [90.0, 91.0], "on_ground": "no"})], scene))
    assert (held.min(axis=0)[2] + held.max(axis=0)[2]) / 2.0 == pytest.approx(HEIGHT + 0.3, abs=1e-5)


def test_a_setting_and_a_control_mean_the_same(scene: SceneDescription) -> None:
    given = {"pose:post.yaw": 30.0, "pose:post.pitch": -10.0, "pose:post.x": 0.5, "pose:post.z": 0.1}
    fixed = Scene(scene).with_settings({**given, "pose:post.scale": 2.0}).description
    control = make_control("pose:post", {"yaw": 30.0, "pitch": -10.0, "x": 0.5, "z": 0.1, "scale": [2.0, 3.0]})
    np.testing.assert_allclose(places(scene, make_space([control], scene)), places(fixed), atol=1e-5)
    again = make_space([make_control("pose:post", {"yaw": [0.0, 90.0]})], fixed)
    np.testing.assert_allclose(places(fixed, again), places(fixed), atol=1e-5)
    with pytest.raises(InputError, match="`set` pose"):
        make_space([make_control("pose:post", {"yaw": [90, 100]})], fixed)


def test_every_such_control_reaches_its_mesh_alone(scene: SceneDescription) -> None:
    able = [kind for kind in CONTROLS if CONTROLS[kind].targets_mesh]
    assert set(able) == {"pose", "texture", "material", "geometry", "body"} & set(CONTROLS)
    for kind in ("pose", "texture", "material"):
        space = make_space([make_control(f"{kind}:post")], scene)
        assert {name.partition(".")[0] for name in space.inputs(space.start)} == {"post"}, kind
        assert space.controls[0].name == f"{kind}:post"
    mug = load_description("mug")
    twin = mug.with_part(MeshPart("twin", mug.object.mesh, mug.object.base_color))
    space = make_space([make_control("geometry:twin", {"modes": 4})], twin)
    assert set(space.inputs(space.start)) == {"twin.offsets"}
    assert list(space.get_artifact_files(space.start)) == ["geometry@twin.obj"]  # a name that every file system takes
