"""Objectives that see more than pictures: u, the texture, the scene's inputs and numbers, with a graph."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor, nn

import advsearch
from advsearch.attacks import Query, get_objective
from advsearch.engine.problem import Problem
from advsearch.questions.attack.carry_out import make_problem_on
from advsearch.questions.attack.settings import AttackConfig

SMALL: dict[str, Any] = {
    "resolution": 16, "spp": 2, "trials": 6, "verify_spp": 4, "denoise": "none", "baseline": False, "measure": "no",
}  # fmt: skip
TEXTURE = {"texture": {"resolution": 8, "epsilon": 0.1}}
PINK = torch.tensor([0.9, 0.1, 0.6])


class Sure(nn.Module):
    """A mug, whatever it sees."""

    def forward(self, images: Tensor) -> Tensor:
        return images.mean(dim=(1, 2, 3))[:, None] * images.new_tensor([1.0, 0.5, 0.2]) + images.new_tensor([5.0, 0, 0])


def sure() -> advsearch.Model:
    return advsearch.load_model(Sure(), labels=["mug", "vase", "bowl"], input_size=16)


@pytest.fixture(scope="module")
def scene() -> advsearch.Scene:
    return advsearch.load_scene("mug")


def problem(scene: advsearch.Scene, objective: Callable[..., Tensor], **settings: Any) -> Problem:
    config = AttackConfig(object="mug", resolution="16", spp=2, denoise="none", **settings)
    made = make_problem_on(config, scene, sure())
    made.objective = get_objective(objective, made.task)
    return made


def pinker(logits: Tensor, images: Tensor, labels: Tensor, texture: Tensor) -> Tensor:
    """It looks at no picture."""
    return -(texture - PINK).abs().mean(dim=(1, 2, 3))


@pytest.mark.medium
def test_a_search_follows_a_loss_of_the_texture(scene: advsearch.Scene) -> None:
    """Nearly every texel ends where its budget lets it be next to the colour that is sought."""
    settings: dict[str, Any] = {**SMALL, "steps": 16, "denoise": "oidn", "policy": "pgd"}
    result = advsearch.attack(scene, sure(), controls=TEXTURE, objective=pinker, **settings)
    assert result.summary.transport is not None and result.summary.transport.used
    before, found = result.artifacts["texture-original"], result.artifacts["texture"]
    wanted = before + (PINK - before).clamp(-0.1, 0.1)
    assert float((found - wanted).abs().mean()) < 0.25 * float((before - wanted).abs().mean())
    tried = result.summary.tried_objective
    assert tried is not None and tried.adversarial is not None
    assert tried.adversarial.mean == pytest.approx(float(pinker(PINK, PINK, PINK, found[None])), abs=1e-5)


def test_the_derivative_is_that_of_the_picture_and_that_of_what_was_asked_for(scene: advsearch.Scene) -> None:
    """Of the texture by its adjoint, of the yaw by a secant, with one term of everything that can be asked for."""

    def seen(logits: Tensor, images: Tensor, labels: Tensor) -> Tensor:
        return images.mean(dim=(1, 2, 3))

    def asks(logits: Any, images: Any, labels: Any, u: Any, texture: Any, inputs: Any, configuration: Any) -> Any:
        own = u.square().sum(dim=1) + 3.0 * texture.mean(dim=(1, 2, 3)) + inputs["object.base_color"].sum(dim=(1, 2, 3))
        return seen(logits, images, labels) * (1.0 + 0.1 * configuration["pose.yaw"]) + own

    made = problem(scene, seen, controls={"texture": {"resolution": 8}, "pose": {"yaw": [-20, 30]}})
    u = made.domain.initial_point
    picture = made.evaluate(Query(u, 3, phase="search", gradient=True))
    made.objective = get_objective(asks, made.task)
    found = made.evaluate(Query(u, 3, phase="search", gradient=True))
    assert found.gradient is not None and picture.gradient is not None
    at = u.clone().requires_grad_()
    space = made.searched_space
    yaw = space.get_numeric_values(at)["pose.yaw"]
    own = (
        at.square().sum()
        + 3.0 * space.get_printable_colors(at)["texture"].mean()
        + space.inputs(at)["object.base_color"].sum()
    )
    value = picture.objective * (1.0 + 0.1 * yaw) + own
    value.backward()
    assert at.grad is not None
    expected = at.grad + (1.0 + 0.1 * float(yaw.detach())) * picture.gradient
    assert found.objective == pytest.approx(float(value.detach()), rel=1e-5)
    assert torch.allclose(found.gradient, expected, rtol=1e-3, atol=1e-5)
    assert made.gradient_plan.select_groups("secant") and made.gradient_plan.select_groups("adjoint"), "both ways"
