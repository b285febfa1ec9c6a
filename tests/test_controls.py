"""Every registered control passes one battery; the texture control's own rules follow."""

from __future__ import annotations

import math

import pytest
import torch

from advsearch.controls import CONTROLS, TextureControl, make_control, make_space
from advsearch.errors import InputError, UnknownNameError
from advsearch.scene.description import describe
from advsearch.scene.formation import srgb_to_linear

every_control = pytest.mark.parametrize("kind", CONTROLS)


@every_control
def test_a_control_declares_itself(kind: str) -> None:
    control = CONTROLS[kind]
    assert control.kind == kind and control.summary.endswith(".") and control.parameters
    for parameter in control.parameters:
        assert parameter.low < parameter.high and parameter.unit and parameter.description.endswith(".")
    for choice in control.choices:
        assert hasattr(control(), choice.name), choice.name


@every_control
def test_a_bound_control_starts_inside_and_maps_differentiably(kind: str) -> None:
    bound = CONTROLS[kind]().bind(describe("mug"))
    start = bound.start
    assert start.ndim == 1 and start.dtype == torch.float32
    assert float(start.min()) >= 0.0 and float(start.max()) <= 1.0
    u = (start * 0.5 + 0.25).requires_grad_()
    total = sum(tensor.sum() for tensor in bound.inputs(u).values())
    total.backward()
    assert u.grad is not None and bool(torch.isfinite(u.grad).all()) and float(u.grad.abs().sum()) > 0.0


@every_control
def test_a_bound_control_says_its_configuration_in_values_with_units(kind: str) -> None:
    bound = CONTROLS[kind]().bind(describe("mug"))
    for name, value in bound.describe(bound.start).items():
        assert name.startswith(bound.name + ".") and value["unit"] and isinstance(value["value"], (float, str))


def test_names_and_settings_that_do_not_exist_are_explained() -> None:
    with pytest.raises(UnknownNameError, match=r"unknown control 'textur'. Did you mean 'texture'"):
        make_control("textur")
    with pytest.raises(
        UnknownNameError, match=r"unknown setting of control texture 'epsilonn'. Did you mean 'epsilon'"
    ):
        make_control("texture", {"epsilonn": 0.1})
    with pytest.raises(InputError, match="--control: every instance needs a name of its own"):
        make_space([TextureControl(), TextureControl()], describe("mug"))
    with pytest.raises(InputError, match=r"--control: two controls set object.base_color"):
        space = make_space([TextureControl(), TextureControl(name="second")], describe("mug"))
        space.inputs(space.start)
    with pytest.raises(InputError, match="--control: expected at least one"):
        make_space([], describe("mug"))


@pytest.mark.parametrize("epsilon", [0.0, -0.1, math.nan, math.inf])
def test_a_radius_that_is_no_radius_is_refused(epsilon: float) -> None:
    with pytest.raises(InputError, match="--epsilon: expected a finite number greater than 0"):
        TextureControl(epsilon=epsilon)


def test_other_settings_out_of_range_are_refused() -> None:
    with pytest.raises(InputError, match="--norm: expected one of linf, l2, got 'l1'"):
        TextureControl(norm="l1")
    with pytest.raises(InputError, match="--texture-resolution: expected 2 to 4096"):
        TextureControl(resolution=1)


def test_the_texture_starts_as_the_objects_own_and_is_linearised() -> None:
    scene = describe("mug")
    bound = TextureControl().bind(scene)
    own = torch.from_numpy(scene.object.base_color.copy())
    assert torch.equal(bound.start.reshape(own.shape), own)
    (linear,) = bound.inputs(bound.start).values()
    assert torch.allclose(linear, srgb_to_linear(own))


def test_the_resolution_is_a_choice_and_keeps_the_mean() -> None:
    scene = describe("mug")
    bound = TextureControl(resolution=32).bind(scene)
    assert bound.start.numel() == 32 * 32 * 3
    assert float(bound.start.mean()) == pytest.approx(float(scene.object.base_color.mean()), abs=0.01)


def test_the_default_balls_reach_the_same_root_mean_square() -> None:
    linf, l2 = (TextureControl(norm=norm, resolution=32).bind(describe("mug")).budget for norm in ("linf", "l2"))
    assert linf.epsilon is not None and l2.epsilon is not None
    assert l2.epsilon == pytest.approx(linf.epsilon * math.sqrt(32 * 32 * 3))
