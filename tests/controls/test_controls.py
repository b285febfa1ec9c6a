"""Every registered control passes one battery; the texture control's own rules follow."""

from typing import Any

import pytest
import torch

from advsearch.controls import CONTROLS, Control, make_control, make_space
from advsearch.errors import InputError
from advsearch.scene.description import load_description
from advsearch.scene.gradients import ESTIMATORS
from advsearch.scene.settings import SETTINGS
from hostile import SHORT, shown
from samples import load_photographed_box

every_control = pytest.mark.parametrize("kind", CONTROLS)
NEEDED: dict[str, dict[str, Any]] = {
    "mitsuba": {"ground.bsdf.brdf_0.reflectance.value": [0.1, 0.9]},
    "backdrop": {"which": ["000001.jpg", "000003.jpg"]},
}
"""What a control cannot be made without."""


SUITS = {"body": "person"}
"""Objects for controls that a mug does not suit."""
BESIDE = "bottle@0.4,0.1; vase@-0.3,0.3"
"""What `things` moves."""


def bound(kind: str, object: str = "mug") -> Control:
    """A control with its defaults in a scene, alone."""
    scene = load_description(SUITS.get(kind, object), things=BESIDE)
    if kind == "backdrop":
        scene = load_photographed_box().description
    return make_space([make_control(kind, NEEDED.get(kind))], scene).controls[0]


@every_control
def test_a_control_declares_itself(kind: str) -> None:
    control = CONTROLS[kind]
    parameters = control.declare_parameters(NEEDED.get(kind, {}))
    assert control.kind == kind and control.summary.endswith(".") and parameters
    for parameter in parameters:
        assert parameter.low < parameter.high and parameter.unit and parameter.description.endswith(".")
        assert set(parameter.estimators) <= set(ESTIMATORS)
        if parameter.search is not None and not parameter.options:
            assert parameter.low <= parameter.search[0] < parameter.search[1] <= parameter.high or parameter.log
        if parameter.options:
            assert parameter.low == 0.0 and parameter.high == len(parameter.options) - 1
        if parameter.moves_silhouettes:
            assert not {"adjoint"} & set(parameter.estimators), "an interior adjoint misses moving outlines"
    assert len({one.name for one in control.parameters} | {one.name for one in control.choices}) == len(
        control.parameters
    ) + len(control.choices)


def test_a_setting_of_the_scene_and_the_parameter_of_that_name_are_one_declaration() -> None:
    fixed = {"camera.ev", "camera.lamps", "camera.drops", "camera.drop_size", "camera.drop_seed"}  # searched by nobody
    for name, declared in SETTINGS.items():
        kind, _, parameter = name.partition(".")
        if kind in CONTROLS and name not in fixed and kind != "backdrop":  # of the photograph, not of the choice
            (own,) = (one for one in CONTROLS[kind].parameters if one.name == parameter)
            assert own is declared, name


@every_control
def test_a_bound_control_starts_inside_and_maps_differentiably(kind: str) -> None:
    control = bound(kind)
    start = control.start
    assert start.ndim == 1 and start.dtype == torch.float32
    assert float(start.min()) >= 0.0 and float(start.max()) <= 1.0
    assert sum(group.size for group in control.groups) == len(start)
    inner = start * 0.5 + 0.26  # where a symmetric start has slopes too
    begin = 0
    for group in control.groups:
        if group.options:
            inner[begin] = start[begin]
        begin += group.size
    u = inner.requires_grad_()
    picture = torch.rand(24, 24, 3, generator=torch.Generator().manual_seed(0))
    total = sum(
        (tensor.sin().sum() for tensor in control.inputs(u).values()), control.apply_to_image(u, picture).sin().sum()
    )
    if not total.requires_grad:
        assert not any(set(group.valid) & {"adjoint", "image", "material"} for group in control.groups)
        return
    total.backward()
    assert u.grad is not None and bool(torch.isfinite(u.grad).all())
    begin = 0
    for group in control.groups:
        part = u.grad[begin : begin + group.size]
        begin += group.size
        if "adjoint" in group.valid or "image" in group.valid or "material" in group.valid:
            assert bool(part.any()), f"{kind}.{group.name} says that its derivative runs through its inputs"


@every_control
def test_a_control_is_finite_in_every_corner(kind: str) -> None:
    control = bound(kind)
    picture = torch.rand(24, 24, 3, generator=torch.Generator().manual_seed(0))
    for corner in (torch.zeros_like(control.start), torch.ones_like(control.start)):
        u = corner.requires_grad_()
        changed = control.apply_to_image(u, picture)
        assert float(changed.detach().min()) >= 0.0 and float(changed.detach().max()) <= 1.0
        outputs = [*control.inputs(u).values(), changed]
        assert all(bool(torch.isfinite(one).all()) for one in outputs)
        live = [one.sum() for one in outputs if one.requires_grad]
        if live:
            (gradient,) = torch.autograd.grad(torch.stack(live).sum(), u, allow_unused=True)
            assert gradient is None or bool(torch.isfinite(gradient).all())


@pytest.mark.medium
@pytest.mark.parametrize("kind", ["light", "projector", "spot", "shadow", "occlusion", "patch"])
def test_two_of_a_kind_live_side_by_side(kind: str) -> None:
    space = make_space([make_control(f"{kind}:one"), make_control(f"{kind}:two")], load_description("mug"))
    assert [control.name for control in space.controls] == ["one", "two"]
    u = torch.full_like(space.start, 0.4)
    both = space.inputs(u)
    half = len(u) // 2
    only_first = u.clone()
    only_first[half:] = 0.8
    changed = space.inputs(only_first)
    assert any(not torch.equal(both[name], changed[name]) for name in both)
    assert {name.split(".")[0] for name in space.describe(u)} == {"one", "two"}


@pytest.mark.parametrize("kind", CONTROLS)
def test_no_value_of_any_control_ends_in_a_traceback(kind: str) -> None:
    """Neither a parameter, a choice, a name nor a kind; what is bound to a scene later is not looked at here."""
    control = CONTROLS[kind]
    for name in [one.name for one in control.parameters] + [one.name for one in control.choices] + ["name", "kind"]:
        for value in SHORT:
            try:
                made = make_control(kind, {name: value})
            except InputError:
                continue
            assert made.kind == kind, (name, shown(value))
