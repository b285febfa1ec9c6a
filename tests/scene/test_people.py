"""People: heights and limits are kept, feet stand on the ground, joints turn what they say, gradients are right."""

import numpy as np
import pytest
import torch
from torch import Tensor

from advsearch.scene.people import PARAMETERS, Person, load_body

PERSON = Person(load_body())


def numbers(**given: float) -> dict[str, Tensor]:
    return {name: torch.tensor(float(value)) for name, value in given.items()}


def of_tag(vertices: Tensor, *tags: str) -> np.ndarray:
    whose = np.repeat(PERSON.data["tags"], PERSON.data["points"])
    return vertices.numpy()[np.isin(whose, tags)]


@pytest.mark.parametrize("height", [1.2, 1.5, 1.7, 2.0])
@pytest.mark.parametrize("more", [{}, {"gender": 0.0, "age": 70.0}, {"age": 12.0, "weight": 0.9}])
def test_someone_is_as_tall_as_asked_for(height: float, more: dict[str, float]) -> None:
    vertices = PERSON.pose(numbers(height=height, **more))
    tall = float(vertices[:, 2].max())  # with soles of 14 mm and hair of 14 mm, which grow along
    assert tall == pytest.approx(height, abs=0.05)
    assert float(vertices[:, 2].min()) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("walk", range(0, 360, 30))
def test_a_walker_stays_on_the_ground_and_upright(walk: int) -> None:
    vertices = PERSON.pose(numbers(walk=walk, stride=1.0))
    assert float(vertices[:, 2].min()) == pytest.approx(0.0, abs=1e-6)
    assert 1.55 < float(vertices[:, 2].max()) < 1.78
    shoes = of_tag(vertices, "shoes")
    assert shoes[:, 2].min() < 1e-6, "something else than a shoe touches the ground"


SOMEBODY: tuple[dict[str, float], ...] = (
    {}, {"gender": 0.0}, {"weight": 1.0, "age": 80.0}, {"age": 12.0, "height": 1.3}, {"height": 2.0, "gender": 0.3}
)  # fmt: skip


@pytest.mark.parametrize("stride", [0.1, 0.6, 1.0, 1.3])
@pytest.mark.parametrize("more", SOMEBODY)
def test_each_foot_in_stance_is_on_the_ground(more: dict[str, float], stride: float) -> None:
    """From the strike of its heel until its toes leave the ground, at 60 % of its cycle; the other goes through no
    ground, and swings free in the middle of an ordinary step."""
    for walk in range(0, 360, 18):
        vertices = PERSON.pose(numbers(walk=walk, stride=stride, **more))
        for begin, ahead in ((0.0, vertices[:, 1] > 0), (180.0, vertices[:, 1] < 0)):
            of_shoe = np.repeat(PERSON.data["tags"], PERSON.data["points"]) == "shoes"
            height = float(vertices[torch.from_numpy(of_shoe) & ahead, 2].min())
            own_phase = (walk + begin) % 360
            assert height >= -1e-6
            assert own_phase > 216 or height < 1e-3, (walk, begin)
            assert stride < 1.0 or own_phase != 270 or height > 0.02


def test_legs_of_a_walker_stay_as_long_as_they_are() -> None:
    """What puts the feet onto the ground is a small part of a leg; without a stride nothing is moved."""
    for stride, most in ((0.0, 0.0), (0.6, 0.04), (1.0, 0.04), (1.3, 0.1)):
        raised = list[float]()
        for walk in range(0, 216, 18):
            values = PERSON._complete_values(numbers(walk=walk, stride=stride))
            points = PERSON._tensors["mean"] + torch.einsum(
                "r,rpc->pc",
                torch.einsum("gawh,gawhr->r", PERSON._mix_phenotype(values)[0], PERSON._tensors["shares"]),
                PERSON._tensors["basis"],
            )
            bones = len(PERSON._bones)
            rise = PERSON._compute_leg_corrections(points[:-bones], points[-bones:], values)
            raised.append(abs(float(rise["l"])))
        assert max(raised) <= most, (stride, max(raised))


@pytest.mark.parametrize(
    ("angle", "tag", "axis", "sign"),
    [
        ({"left_shoulder": 90}, "skin", 0, 1), ({"left_shoulder_out": 90}, "skin", 1, 1),
        ({"right_shoulder_out": 90}, "skin", 1, -1), ({"left_hip": 60}, "shoes", 0, 1),
        ({"right_hip_out": 30}, "shoes", 1, -1), ({"left_knee": 90}, "shoes", 0, -1), ({"spine": 40}, "hair", 0, 1),
        ({"spine_side": 20}, "hair", 1, 1), ({"neck": 30}, "hair", 0, 1),
    ],
)  # fmt: skip
def test_a_joint_moves_what_its_name_says_where_it_says(
    angle: dict[str, float], tag: str, axis: int, sign: int
) -> None:
    before, after = of_tag(PERSON.standing_points, tag), of_tag(PERSON.pose(numbers(**angle)), tag)
    moved = sign * (after - before)[:, axis]
    assert moved.max() > 0.03 and moved.max() > -1.5 * moved.min()


def test_a_rigid_part_keeps_its_shape_and_turns_by_the_angle() -> None:
    whose = np.repeat(PERSON.data["tags"], PERSON.data["points"])
    weights = PERSON.data["weights"][PERSON.data["index"]]
    head = (whose == "hair") & (weights[:, list(PERSON.data["bones"]).index("head")] == weights.sum(axis=1))
    assert head.sum() > 100
    before, after = PERSON.standing_points.numpy()[head], PERSON.pose(numbers(neck=20, neck_turn=40)).numpy()[head]
    a, b = before - before.mean(axis=0), after - after.mean(axis=0)
    u, _, v = np.linalg.svd(a.T @ b)
    turn = (u @ v).T
    np.testing.assert_allclose(a @ turn.T, b, atol=1e-5)
    half_turn, half_nod = np.radians(20), np.radians(10)
    z = np.array([[np.cos(half_turn), -np.sin(half_turn), 0], [np.sin(half_turn), np.cos(half_turn), 0], [0, 0, 1]])
    y = np.array([[np.cos(half_nod), 0, np.sin(half_nod)], [0, 1, 0], [-np.sin(half_nod), 0, np.cos(half_nod)]])
    np.testing.assert_allclose(turn, z @ y @ z @ y, atol=1e-5)


def test_gradients_of_every_number_are_those_of_differences() -> None:
    person = Person(load_body())
    for name, held in person._tensors.items():
        person._tensors[name] = held.double() if held.is_floating_point() else held
    middle = {
        one.name: torch.tensor(0.61 * float(person.defaults[one.name]) + 0.2 * (max(one.low, -90) + min(one.high, 90)))
        for one in PARAMETERS
    }
    values = {name: value.double().requires_grad_() for name, value in middle.items()}
    weight = torch.randn(
        len(person.standing_points), 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    found = torch.autograd.grad((weight * person.pose(values)).sum(), list(values.values()))
    for (name, value), slope in zip(values.items(), found, strict=True):
        step = 1e-4
        up, down = ({**values, name: value.detach() + sign * step} for sign in (1, -1))
        with torch.no_grad():
            rise = float((weight * (person.pose(up) - person.pose(down))).sum()) / (2 * step)
        assert float(slope) == pytest.approx(rise, rel=1e-3, abs=1e-3), name
