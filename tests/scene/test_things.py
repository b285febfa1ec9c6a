"""Things beside the object: how they are asked for, where they stand, and what is true of each."""

import math

import numpy as np
import pytest
import torch

import advsearch
from advsearch.scene import library
from advsearch.scene.description import load_description
from advsearch.scene.geometry import compute_base_vertices, compute_footprint, find_overlap_interval, is_overlapping
from advsearch.scene.outlines import find_visible_meshes

pytestmark = pytest.mark.usefixtures("two_threads")

VIEW = {"camera.distance": 16.0, "camera.azimuth": 20.0, "camera.elevation": 20.0, "camera.fov": 50.0}
THREE = "car@-7,3.5,heading=160; stop-sign@3,-3,heading=-30; chair@3,2.5,size=1.1,heading=75"
SIDE = 200


SQUARE = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
TURNED = SQUARE @ np.array([[0.7, 0.7, 0.0], [-0.7, 0.7, 0.0], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize("kind", ["avenue", "crossing", "car-park"])
def test_solids_of_a_place_are_where_its_meshes_are(kind: str) -> None:
    """Each post, trunk and house has some of its mesh's vertices at its outline, and the object stands free."""
    scene = load_description("car", "overcast", setting_values={"ground.kind": kind})
    assert not scene.remarks
    meshes = {"a house": "houses", "the trunk of a tree": "trees", "a lamp post": "posts"}
    meshes["the post of a sign"] = "sign-post"
    solids = [solid for part in scene.surrounding_meshes.values() for solid in part.solids]
    assert {"a house", "the trunk of a tree", "a lamp post"} <= {name for name, _ in solids}
    for name, solid in solids:
        vertices = compute_base_vertices(scene.surrounding_meshes[meshes[name]])
        low = solid.outline.min(axis=0) - 0.05
        high = solid.outline.max(axis=0) + 0.05
        near = ((vertices[:, :2] >= low) & (vertices[:, :2] <= high)).all(axis=1)
        assert near.any() and vertices[near, 2].max() >= solid.upper - 0.1, name


def test_outlines_overlap_where_squares_do() -> None:
    def overlap(one: np.ndarray, other: np.ndarray, shift: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> bool:
        return is_overlapping(compute_footprint(one), compute_footprint(other + np.array(shift)))

    assert overlap(SQUARE, TURNED) and overlap(SQUARE, SQUARE, (0.9, 0.9, 0.0))
    assert not overlap(SQUARE, SQUARE, (1.1, 0.0, 0.0))
    assert not overlap(SQUARE, SQUARE, (0.0, 0.0, 1.1))
    # boxes along the axes overlap, and these do not: a square on its corner beside the corner of another
    assert not overlap(SQUARE, TURNED, (1.55, 0.9, 0.0))


def test_a_square_that_passes_another_overlaps_with_it_over_one_stretch_of_its_way() -> None:
    square, way = compute_footprint(SQUARE), np.array([1.0, 0.0])
    assert find_overlap_interval(square, compute_footprint(SQUARE + np.array([3.0, 0.4, 0.0])), way) == pytest.approx(
        (2.0, 4.0)
    )
    assert find_overlap_interval(square, compute_footprint(SQUARE + np.array([3.0, 1.4, 0.0])), way) == (
        math.inf,
        -math.inf,
    )
    corner = compute_footprint(
        TURNED + np.array([3.0, 0.0, 0.0])
    )  # from -0.7 to 0.7 in x at y = 0.7, and 0 to 1.4 in y
    begin, end = find_overlap_interval(square, corner, way)
    for shift in np.linspace(0.003, 5.003, 501):
        moved = compute_footprint(SQUARE + np.array([shift, 0.0, 0.0]))
        assert is_overlapping(moved, corner) == (begin < shift < end)


def projected_box(thing: str, x: float, y: float, heading: float, size: float) -> tuple[float, ...]:
    """Where a pinhole at `VIEW` sees a bundled thing, worked out in metres: x0, y0, x1, y1 in pixels."""
    car = library.load_object("car")
    metres = float(car.size_in_metres or 0.0)
    vertices = library.load_object(thing).mesh.vertices.astype(np.float64)
    vertices = vertices - [*(vertices[:, :2].min(axis=0) + vertices[:, :2].max(axis=0)) / 2, vertices[:, 2].min()]
    vertices *= size / np.ptp(vertices, axis=0).max()
    a = math.radians(heading)
    points = np.stack([
        x + math.cos(a) * vertices[:, 0] - math.sin(a) * vertices[:, 1],
        y + math.sin(a) * vertices[:, 0] + math.cos(a) * vertices[:, 1],
        vertices[:, 2],
    ], axis=1)  # fmt: skip
    azimuth, elevation = math.radians(VIEW["camera.azimuth"]), math.radians(VIEW["camera.elevation"])
    back = np.array([
        math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation)
    ])  # fmt: skip
    target = np.array([0.0, 0.0, np.ptp(car.mesh.vertices[:, 2]) * metres / 2.0])
    right = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
    up = np.cross(back, right)
    relative = points - (target + VIEW["camera.distance"] * back)
    focal = SIDE / 2.0 / math.tan(math.radians(VIEW["camera.fov"]) / 2.0)
    depth = -relative @ back
    column, row = SIDE / 2.0 + focal * (relative @ right) / depth, SIDE / 2.0 - focal * (relative @ up) / depth
    return column.min(), row.min(), column.max(), row.max()


@pytest.mark.medium
def test_boxes_are_those_of_an_independent_projection() -> None:
    scene = advsearch.load_scene("car", "street", settings=VIEW, things=THREE)
    renderer = scene.renderer({"pose": {}}, resolution=SIDE, denoise="none")
    found = {one.name: one for one in find_visible_meshes(renderer, renderer.start)}
    metres = {name: float(library.load_object(name).size_in_metres or 0.0) for name in ("car", "stop-sign")}
    for name, what, *place in (
        ("object", "car", 0.0, 0.0, 0.0, metres["car"]),
        ("car", "car", -7.0, 3.5, 160.0, metres["car"]),
        ("stop-sign", "stop-sign", 3.0, -3.0, -30.0, metres["stop-sign"]),
        ("chair", "chair", 3.0, 2.5, 75.0, 1.1),
    ):
        wanted = projected_box(what, *place)
        assert np.abs(np.array(found[name].box) - wanted).max() <= 1.0, (name, found[name].box, wanted)
        assert (found[name].visible_fraction or 0.0) > 0.97 and found[name].is_truncated is False


@pytest.mark.medium
def test_a_thing_hides_is_hidden_and_casts_a_shadow() -> None:
    behind = {**VIEW, "camera.azimuth": 0.0, "camera.elevation": 14.0}
    pictures, seen = [], []
    for things in (None, "car@-7,0; stop-sign@5,0.3,size=1.5"):
        scene = advsearch.load_scene("car", "noon", settings=behind, things=things)
        renderer = scene.renderer({"pose": {}}, resolution=96, denoise="none")
        pictures.append(renderer(renderer.start, seed=1, spp=16))
        seen.append({one.name: one for one in find_visible_meshes(renderer, renderer.start)})
    hidden, hiding = seen[1]["object"], seen[1]["stop-sign"]
    assert seen[1]["car"].visible_fraction is not None and seen[1]["car"].visible_fraction < 0.8  # behind the object
    assert (
        hidden.visible_fraction is not None
        and hiding.visible_fraction is not None
        and hidden.visible_fraction < 0.95 < hiding.visible_fraction
    )
    assert hiding.distance < hidden.distance < seen[1]["car"].distance
    covered = torch.zeros(96, 96, dtype=torch.bool)
    for one in (*seen[0].values(), *seen[1].values()):
        covered |= torch.from_numpy(one.mask)
    darker = (pictures[0] - pictures[1]).mean(dim=2)[~covered]
    assert (darker > 0.05).sum() > 10  # shadows on the ground


@pytest.mark.medium
def test_a_thing_on_the_pavement_stands_on_it() -> None:
    description = advsearch.load_scene("car", "avenue", things="chair@0,-4,size=1; stop-sign@9,0.5").description
    low = {
        name: compute_base_vertices(part)[:, 2].min() * description.size_in_metres
        for name, part in description.things.items()
    }
    assert low == {"chair": pytest.approx(0.12, abs=1e-4), "stop-sign": pytest.approx(0.0, abs=1e-4)}
