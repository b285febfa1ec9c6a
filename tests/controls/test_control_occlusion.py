"""The occlusion control: the share that was asked for is the share that is hidden, and nothing else happens at zero."""

import itertools
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from advsearch.controls import make_space
from advsearch.controls.camera import CameraControl
from advsearch.controls.occlusion import OcclusionControl, Placement, load_occluder, make_primitive
from advsearch.controls.occlusion.silhouettes import Passage, compute_center_axes, rasterise_silhouette
from advsearch.controls.pose import PoseControl
from advsearch.scene.camera_model import make_bundled_models, make_pinhole
from advsearch.scene.description import SceneDescription, load_description
from advsearch.scene.geometry import Frame, camera_to_world, compute_object_to_world
from advsearch.scene.mitsuba_backend.parts import translate_part
from advsearch.scene.mitsuba_backend.variant import import_mitsuba
from advsearch.scene.parts import MeshPart
from advsearch.scene.raster import rasterize_triangles

pytestmark = pytest.mark.island("advsearch.controls.occlusion")

ACCURACY = 0.02
"""Allowed error of a hidden share: silhouettes have 128 pixels along their longer side."""


def hidden(scene: SceneDescription, **settings: Any) -> Placement:
    """The placement at the upper end of the coverage's range."""
    control = OcclusionControl(**{"coverage": [0, 0.9], **settings})
    bound = control.bind(control.prepare(scene))
    return bound.find_placement(bound.compute_values(torch.ones_like(bound.start)), {})


def test_a_square_is_rasterised_without_gaps_or_excess() -> None:
    corners = np.array([[(-0.5, -0.5), (9.5, -0.5), (9.5, 9.5)], [(-0.5, -0.5), (9.5, 9.5), (-0.5, 9.5)]])
    _, row, column, weights = rasterize_triangles(corners, (12, 14))
    assert {(int(r), int(c)) for r, c in zip(row, column, strict=True)} == {
        (r, c) for r in range(10) for c in range(10)
    }
    np.testing.assert_allclose(weights.sum(axis=1), 1.0)


def test_a_silhouette_has_the_area_of_what_it_shows() -> None:
    ball = make_primitive("sphere").mesh
    points = ball.vertices.astype(np.float64) + np.array([0.1, -0.2, 3.0])
    found = rasterise_silhouette(points, ball.faces)
    assert found is not None
    share = math.pi / 4.0 * (2 * 0.5 / math.sqrt(3.0**2 - 0.5**2)) ** 2
    window = (found.window.right - found.window.left) * (found.window.high - found.window.low)
    assert found.mask.mean() * window == pytest.approx(share, rel=0.04)
    behind = rasterise_silhouette(points - np.array([0.0, 0.0, 6.0]), ball.faces)
    aside = rasterise_silhouette(points + np.array([9.0, 0.0, 0.0]), ball.faces, Frame.from_fov(35.0))
    assert behind is None and aside is None


def test_a_card_across_a_card_hides_what_geometry_says() -> None:
    card = make_primitive("card").mesh
    points = np.stack([card.vertices[:, 1], card.vertices[:, 2], card.vertices[:, 0]], axis=1).astype(np.float64)
    ahead = np.array([0.0, 0.0, 10.0])
    seen, cover = (
        rasterise_silhouette(points + ahead, card.faces),
        rasterise_silhouette(points * 2.0 + ahead, card.faces),
    )
    assert seen is not None and cover is not None
    directions = seen.list_directions()
    sweep = Passage(directions, cover, compute_center_axes(directions), direction=0.0)
    angles = np.arctan(np.array([2.0, 1.25, 1.0, 0.75, 0.0]) / 10.0)
    np.testing.assert_allclose(sweep.compute_coverage(angles), [0.0, 0.25, 0.5, 0.75, 1.0], atol=ACCURACY)
    assert sweep.find_angle(0.3, 0.5) == pytest.approx(math.atan(0.12), abs=0.002)
    assert sweep.find_angle(1.0, 0.5) < math.atan(0.06)


FOLDING = make_pinhole(60.0, 1.0).with_intrinsics(torch.tensor([0.7, 0.7, 0.5, 0.5, 0.0, -0.6, *[0.0] * 11]))
SEEN = {
    "pinhole": (make_pinhole(35.0, 1.0), {}),
    "wide picture": (make_pinhole(35.0, 2.0), {}),
    "fisheye": (make_bundled_models()["fisheye"], {"camera.distance": 0.8}),
    "panorama": (make_bundled_models()["equirectangular"], {"camera.distance": 0.8}),
    "barrel": (replace(FOLDING, name="test"), {"camera.distance": 1.0}),
}


@pytest.mark.parametrize("which", ["sphere", "chair"])
@pytest.mark.parametrize("through", list(SEEN))
def test_primary_rays_find_the_same_share(through: str, which: str) -> None:
    model, settings = SEEN[through]
    scene = replace(
        load_description("mug", size=1.0, setting_values=settings), aspect=2.0 if through == "wide picture" else 1.0
    )
    scene = replace(scene, camera_model=model if model.name else None)
    control = OcclusionControl(which=which, coverage=[0, 0.3], direction=30.0, size=0.9, turn=50.0)
    bound = control.bind(control.prepare(scene))
    matrix = bound.inputs(torch.ones(1))["occlusion.to_world"].double().numpy()
    occluder = (make_primitive if which == "sphere" else load_occluder)(which)
    camera = camera_to_world(scene)
    along = (torch.arange(200).double() + 0.5) / 200.0
    directions, inside = model.compute_rays(
        torch.stack(torch.meshgrid(along, along, indexing="xy"), dim=-1).reshape(-1, 2)
    )
    rays = (directions[inside > 0.0].numpy() * (-1.0, -1.0, 1.0)) @ camera[:3, :3].T
    pose = compute_object_to_world(scene)
    object_hit = met(MeshPart("object", scene.object.mesh, scene.object.base_color, to_world=pose), camera[:3, 3], rays)
    cover_hit = met(MeshPart("cover", occluder.mesh, occluder.base_color, to_world=matrix), camera[:3, 3], rays)
    assert float((object_hit & cover_hit).sum()) / float(object_hit.sum()) == pytest.approx(0.3, abs=ACCURACY)


def met(part: MeshPart, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Which rays (N, 3) from a point meet a mesh, by Mitsuba."""
    mi = import_mitsuba()
    scene = mi.load_dict({"type": "scene", **translate_part(part).plugins})
    towards = mi.Vector3f(*(mi.Float(one.astype(np.float32)) for one in rays.T))
    return np.array(scene.ray_test(mi.Ray3f(mi.Point3f(*origin.tolist()), towards)))


@pytest.mark.medium
def test_it_comes_in_without_a_jump(scene: SceneDescription) -> None:
    control = OcclusionControl(coverage=[0, 0.4], direction=0.0)
    bound = control.bind(control.prepare(scene))
    places = [
        bound.inputs(torch.tensor([share]))["occlusion.to_world"][:3, 3] for share in torch.linspace(0.002, 0.2, 60)
    ]
    steps = torch.stack([(b - a).norm() for a, b in itertools.pairwise(places)])
    assert float(steps.max()) < 0.05


def test_it_follows_the_camera_and_the_pose_whatever_the_order(scene: SceneDescription) -> None:
    occlusion, camera, pose = (
        OcclusionControl(coverage=[0, 0.4], direction=180.0),
        CameraControl(azimuth=[0, 360]),
        PoseControl(x=[-0.3, 0.3]),
    )
    space = make_space([occlusion, camera, pose], scene)
    u = torch.tensor([1.0, 0.8, 0.9])
    inputs = space.inputs(u)
    seat = inputs["occlusion.to_world"][:3, 3] - inputs["camera.to_world"][:3, 3]
    forward = inputs["camera.to_world"][:3, 2]
    assert float(seat @ forward) / float(seat.norm()) > 0.9
    assert space.describe(u)["occlusion.hidden"]["value"] == pytest.approx(0.4, abs=ACCURACY)
    unmoved = space.controls[0].find_placement(space.controls[0].compute_values(u[:1]), {})  # type: ignore[attr-defined]
    assert abs(unmoved.distance - float(space.describe(u)["occlusion.true_distance"]["value"])) > 1e-3


@pytest.mark.parametrize("size", [0.05, 5.0])
@pytest.mark.parametrize("distance", [0.1, 0.9])
def test_it_swallows_neither_camera_nor_object(scene: SceneDescription, size: float, distance: float) -> None:
    control = OcclusionControl(which="sphere", coverage=[0, 0.5], size=size, distance=distance)
    bound = control.bind(control.prepare(scene))
    matrix = bound.inputs(torch.ones(1))["occlusion.to_world"]
    assert bool(torch.isfinite(matrix).all())
    camera = camera_to_world(scene)[:3, 3]
    radius = 0.5 * float(matrix[:3, 0].norm())
    gap = float(np.linalg.norm(matrix[:3, 3].numpy() - camera))
    nearest = float(np.linalg.norm(scene.base_vertices - camera, axis=1).min())
    assert radius > 0.02 and gap - radius >= 0.05 - 1e-4 and gap + radius <= nearest + 1e-4
