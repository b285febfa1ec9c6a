"""The spot control, and what it shares with a projector that is out of focus or flashes."""

import math

import pytest
import torch
from torch import Tensor

import advsearch
from advsearch.controls import make_control
from advsearch.controls.projector import ProjectorControl, SpotControl
from advsearch.controls.projector.projector import blur_light
from advsearch.controls.space import Space
from advsearch.scene.renderer import Renderer

pytestmark = pytest.mark.island("advsearch.controls.projector")

SIDE = 24
NUMBERS = ("x", "y", "width", "red", "green", "blue", "lumens")
THERE = torch.tensor([0.55, 0.45, 0.7, 0.9, 0.6, 0.4, 0.5])


def renderer_of(kind: str = "spot", **settings: object) -> Renderer:
    return advsearch.load_scene("mug").renderer([make_control(kind, settings)], resolution=SIDE)


def spot_of(renderer: Renderer) -> SpotControl:
    assert isinstance(renderer.space, Space)
    (control,) = renderer.space.controls
    assert isinstance(control, SpotControl)
    return control


def raw(renderer: Renderer, u: Tensor) -> Tensor:
    """Radiance (H, W, 3) without the denoiser, at one seed."""
    return renderer.scene.render_radiance(renderer.scene.input_assembler(renderer.space.inputs(u)), 1, 16)


@pytest.mark.medium
def test_it_has_all_its_lumens_and_half_of_them_within_its_width() -> None:
    control = spot_of(renderer_of(width=0.3, x=0.1, lumens=[0, 10]))
    thrown = control.compute_projected_image(control.compute_values(torch.ones(1)))
    assert float(thrown.mean()) == pytest.approx(1.0, rel=1e-3)  # white of as many lumens has 1 everywhere
    half = float(thrown.max()) / 2.0
    far = float(control.compute_values(torch.ones(1))["distance"]) / control.scene.size_in_metres
    wide = float((thrown[..., 0] > half).float().mean()) * control.projector_part.area * far**2
    assert wide == pytest.approx(math.pi * 0.15**2, rel=0.1)  # where it has half of its brightness, too
    assert float(thrown.detach().sum(dim=(0, 2)).argmax()) > control.projector_part.sides[1] / 2  # to the right


@pytest.mark.medium
def test_the_adjoint_is_the_difference() -> None:
    renderer = renderer_of()
    assert {group.estimator for group in renderer.plan.groups} == {"adjoint"}
    weight = torch.randn(SIDE, SIDE, 3, generator=torch.Generator().manual_seed(2))
    u = THERE.clone().requires_grad_()
    inputs = renderer.scene.input_assembler(renderer.space.inputs(u))
    (gradient,) = renderer.scene.render_adjoint(
        {name: one.detach() for name, one in inputs.items()}, weight, 1, 16, wrt=["spot.pattern"]
    ).values()
    (slopes,) = torch.autograd.grad(inputs["spot.pattern"], u, gradient)
    for number, name in enumerate(NUMBERS):
        step = torch.zeros(len(NUMBERS))
        step[number] = 0.01
        ends = [float((raw(renderer, THERE + sign * step) * weight).sum()) for sign in (-1.0, 1.0)]
        wanted = (ends[1] - ends[0]) / 0.02
        assert float(slopes[number]) == pytest.approx(wanted, rel=0.02, abs=0.02 * float(slopes.abs().max())), name


def test_out_of_focus_the_light_is_as_much_and_spreads() -> None:
    light = torch.zeros(32, 32, 3)
    light[16, 16] = 1.0
    blur = torch.tensor(2.0, requires_grad=True)
    spread = blur_light(light, blur)
    assert float(spread.detach().sum()) == pytest.approx(3.0, rel=1e-4)
    away = (torch.arange(32) - 16.0) ** 2
    assert float((spread[..., 0].detach().sum(dim=0) * away).sum()) == pytest.approx(4.0, rel=0.02)
    (spread**2).sum().backward()
    assert blur.grad is not None and float(blur.grad) < 0.0
    assert blur_light(light, torch.tensor(0.0)) is light


@pytest.mark.medium
@pytest.mark.parametrize("kind", ["projector", "spot"])
def test_a_flashing_light_is_on_in_half_of_each_period(kind: str) -> None:
    settings = {"lumens": 500} if kind == "spot" else {"resolution": 4, "start": "grey"}
    renderer = renderer_of(kind, flicker=100, phase=45, **settings)
    assert isinstance(renderer.space, Space)
    (control,) = renderer.space.controls
    assert isinstance(control, ProjectorControl)
    lit = [
        float(control.advance_time(seconds).inputs(control.start)[f"{kind}.pattern"].sum()) > 0.0
        for seconds in (0.0, 0.003, 0.005, 0.008, 0.0095, 0.012)
    ]
    assert lit == [True, True, False, False, True, True]
