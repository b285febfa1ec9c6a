"""The `things` control: what it moves, that nothing stands in anything else, and that what is away is not there."""

from itertools import combinations
from typing import Any

import numpy as np
import pytest
import torch

import advsearch
from advsearch.controls import Space, make_control, make_space
from advsearch.errors import InputError
from advsearch.scene.assembly import InputAssembler
from advsearch.scene.description import SceneDescription, load_description
from advsearch.scene.geometry import compute_footprint, is_overlapping

pytestmark = [pytest.mark.usefixtures("two_threads"), pytest.mark.island("advsearch.controls.things")]

THINGS = "chair@4,0,size=1; stop-sign@4.5,2; car@-6,0.5,heading=30"
CLOSE = 2e-4
"""Of float32 vertices some 5 object sizes away, in metres."""


@pytest.fixture(scope="module")
def scene() -> SceneDescription:
    return load_description("car", things=THINGS, setting_values={"camera.distance": 9.0})


def test_a_thing_that_moves_stays_out_of_houses_and_posts() -> None:
    street = load_description("car", "avenue", things="person@-15,-6", setting_values={"camera.distance": 9.0})
    space = space_of(street, {"x": [-0.1, 0.1], "y": [-12.0, 3.0], "heading": [0, 1]})
    solids = [solid for part in street.surrounding_meshes.values() for solid in part.solids]
    for u in torch.rand(40, len(space.start), generator=torch.Generator().manual_seed(1)):
        inputs = space.inputs(u)
        assert space.scene is not None
        mesh = space.scene.meshes["person"].mesh.vertices
        pose = inputs["person.to_world"].double().numpy()
        taken = compute_footprint(mesh @ pose[:3, :3].T + pose[:3, 3])
        assert not any(is_overlapping(solid.footprint, taken) for solid in solids)
    post = load_description("car", "avenue", things="person@-15,-3.05")
    with pytest.raises(InputError, match="person overlaps with"):
        space_of(post, {"x": [-1.0, 1.0]})


def space_of(scene: SceneDescription, settings: dict[str, Any] | None = None, **others: Any) -> Space:
    controls = [make_control("things", settings), *(make_control(name, given) for name, given in others.items())]
    return make_space(controls, scene)


def vertices(space: Space, u: torch.Tensor, name: str) -> np.ndarray:
    """Where a mesh is, metres."""
    assert space.scene is not None
    assembly = InputAssembler(space.scene)
    placed = assembly(space.inputs(u)).get(f"{name}.vertices")
    placed = assembly.meshes[name].transform_mesh(None, None)[0] if placed is None else placed
    return np.asarray(placed.double().numpy()) * space.scene.size_in_metres


def at(space: Space, **values: float) -> torch.Tensor:
    """The configuration with some values (x of the chair is `chair_x`), and others at the start."""
    u = space.start.clone()
    for group in space.groups:
        _, thing, parameter = group.name.split(".")
        if (value := values.get(f"{thing.replace('-', '_')}_{parameter}")) is not None:
            span = 360.0 if parameter == "heading" else 4.0
            u[group.begin] = 0.5 + value / span
    return u


def test_at_its_start_all_stands_where_it_was_put(scene: SceneDescription) -> None:
    space = space_of(scene)
    assert [group.name.partition(".")[2] for group in space.groups] == [
        f"{thing}.{parameter}" for thing in ("chair", "stop-sign", "car") for parameter in ("x", "y", "heading")
    ]
    for name in scene.things:
        before = (
            InputAssembler(scene).meshes[name].transform_mesh(None, None)[0].double().numpy() * scene.size_in_metres
        )
        np.testing.assert_allclose(vertices(space, space.start, name), before, atol=CLOSE)


def test_a_thing_is_moved_in_metres_and_turned_about_the_place_where_it_was_put(scene: SceneDescription) -> None:
    space = space_of(scene)
    put = vertices(space, space.start, "stop-sign")
    moved = vertices(space, at(space, stop_sign_x=1.5, stop_sign_y=-0.5), "stop-sign")
    np.testing.assert_allclose(moved - put, np.tile([1.5, -0.5, 0.0], (len(put), 1)), atol=CLOSE)
    turned = vertices(space, at(space, stop_sign_heading=90.0), "stop-sign")
    foot = np.array([*(put.min(axis=0) + put.max(axis=0))[:2] / 2.0, 0.0])
    np.testing.assert_allclose(turned - foot, (put - foot) @ [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], atol=CLOSE)


@pytest.mark.medium
def test_nothing_stands_in_anything_else(scene: SceneDescription) -> None:
    space = space_of(scene, {"x": [-7.0, 7.0], "y": [-3.0, 3.0], "heading": [-180.0, 180.0]})
    pushed = 0
    for seed in range(60):
        u = torch.rand(len(space.start), generator=torch.Generator().manual_seed(seed))
        prints = {name: compute_footprint(vertices(space, u, name)) for name in ("object", *scene.things)}
        assert not any(is_overlapping(prints[one], prints[other]) for one, other in combinations(prints, 2)), seed
        assert torch.equal(space.inputs(u)["car.to_world"], space.inputs(u.clone())["car.to_world"])
        said = {name: float(one["value"]) for name, one in space.describe(u).items()}
        put = {"chair": 4.0, "stop-sign": 4.5, "car": -6.0}
        pushed += any(abs(said[f"things.{one}.at_x"] - said[f"things.{one}.x"] - x) > 1e-3 for one, x in put.items())
    assert 10 < pushed < 50


def test_nothing_stands_where_the_camera_is() -> None:
    scene = load_description(
        "car",
        things="car@11,5",
        setting_values={"camera.distance": 11.0, "camera.azimuth": 0.0, "camera.elevation": 3.0},
    )
    space = space_of(scene, {"y": [-5.0, 0.0]})
    placed = compute_footprint(vertices(space, torch.tensor([0.0]), "car"))
    assert placed.outline[:, 0].min() > 11.0 and np.abs(placed.outline[:, 1].mean()) < 0.2


@pytest.mark.medium
def test_what_is_away_is_neither_seen_nor_in_the_way_and_throws_no_shadow() -> None:
    settings = {"camera.distance": 6.0, "camera.azimuth": 20.0, "camera.elevation": 25.0}
    pictures = []
    for things, control in (("chair@2.6,1.2,size=1.4", {"presence": ["there", "away"]}), (None, None)):
        loaded = advsearch.load_scene("car", "noon", things=things, settings=settings)
        chosen = {"things": control} if control else {"camera": {"roll": [-1.0, 1.0]}}
        render = loaded.renderer(chosen, resolution=48, denoise="none")
        with torch.no_grad():
            pictures += [render(torch.tensor([share]), 0, 64) for share in ((0.25, 0.75) if control else (0.5,))]
            seen = [set(render.find_surfaces(torch.tensor([share])).shape_names) for share in (0.25, 0.75)]
    there, away, without = pictures
    assert 8.0 * float((away - without).abs().mean()) < float((there - without).abs().mean())  # the rest is noise
    assert "chair" not in seen[0]
    scene = load_description("car", things="chair@4,0,size=1; stop-sign@4,2")
    space = make_space(
        [make_control("things", {"chair.presence": ["there", "away"], "stop-sign.y": [-2, -1.99]})], scene
    )
    x = [float(space.describe(torch.tensor([share, 0.0]))["things.stop-sign.at_x"]["value"]) for share in (0.2, 0.8)]
    assert x[0] > 4.2 and x[1] == 4.0
