"""The gradient plan: what each estimator computes, what is left out, and how it is chosen. Renders are small."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from advsearch import load_scene
from advsearch.engine.gradients import (
    Bench,
    find_interior_point,
    find_probes,
    make_smooth_loss,
    measure_reference,
    restrict_plan,
)
from advsearch.questions.attack.carry_out import problem_from_config
from advsearch.questions.attack.settings import AttackConfig
from advsearch.scene.gradients import Group
from advsearch.scene.renderer import Renderer

SIZE = 48


def renderer(controls: Any, *, object: str = "mug", transfer: str = "linear", **options: Any) -> Renderer:
    made = load_scene(object).renderer(controls, resolution=SIZE, denoise="none", **options)
    made.formation = replace(made.formation, transfer=transfer)
    made.plan = made.plan.with_pixel_steps()  # as `check` does for smooth losses, which these are
    return made


def group(name: str, begin: int, size: int, valid: tuple[str, ...], **more: Any) -> Group:
    control, _, parameter = name.partition(".")
    return Group(parameter, size, valid, control=control, begin=begin, **more)


@pytest.mark.medium
def test_differences_are_central_differences_of_the_picture_with_one_seed() -> None:
    render = renderer(["camera"], estimators={"*": "differences"})
    weights = torch.rand(SIZE, SIZE, 3, generator=torch.Generator().manual_seed(1))
    u = find_interior_point(render)
    leaf = u.clone().requires_grad_()
    before = render.n_renders
    (render(leaf, seed=3, spp=4) * weights).sum().backward()
    assert render.n_renders - before == 1 + 2 * len(u)
    first = render.plan.groups[1]
    noise = render.compute_differences(u, weights, 3, 4)
    assert leaf.grad is not None and torch.equal(leaf.grad, noise)
    assert first.periodic is False
    step = torch.zeros_like(u)
    step[1] = first.step
    from advsearch import seeds

    common = seeds.derive_seed(render.root_seed, "differences", 3)
    with torch.no_grad():
        rise = (weights * (render(u + step, common, 4) - render(u - step, common, 4))).sum()
    assert float(leaf.grad[1]) == pytest.approx(float(rise) / (2.0 * first.step), rel=1e-3)


@pytest.mark.slow
def test_the_azimuth_of_the_mug_has_the_sign_of_what_the_loss_does_over_degrees() -> None:
    """96 x 96: differences over a pixel, 0.3 degrees, had the other one in two of three seeds."""
    problem, _ = problem_from_config(AttackConfig(object="mug", controls=["camera.azimuth"], resolution=(96, 96)))
    renderer, start = problem.renderer, problem.domain.start
    steps = [half * degrees / 360.0 for half in (1.0, -1.0) for degrees in (7.2, 10.8, 18.0)]
    with torch.no_grad():
        seen = [float(problem.compute_loss(renderer((start + step) % 1.0, seed=9, spp=64))) for step in steps]
    slope = sum(seen[:3]) - sum(seen[3:])
    for seed in range(6):
        assert float(renderer.gradient(problem.compute_loss, start, seed, 8)[1][0]) * slope > 0.0


def test_a_secant_differences_the_loss_itself() -> None:
    render = renderer(["camera.elevation"], estimators={"*": "secant"}, transfer="srgb")
    u = find_interior_point(render)

    def bent(image: Tensor) -> Tensor:
        return torch.sigmoid(30.0 * (image.mean() - 0.45))

    value, gradient = render.gradient(bent, u, 5, 4)
    from advsearch import seeds

    common, step = seeds.derive_seed(render.root_seed, "differences", 5), render.plan.groups[0].step
    with torch.no_grad():
        rise = bent(render(u + step, common, 4)) - bent(render(u - step, common, 4))
        assert float(value) == pytest.approx(float(bent(render(u, 5, 4))))
    assert float(gradient[0]) == pytest.approx(float(rise) / (2.0 * step), rel=1e-3)


def test_differences_at_the_edge_of_the_box_stay_inside_and_are_finite() -> None:
    render = renderer({"camera": {"elevation": [5, 60], "azimuth": [0, 360]}}, estimators={"*": "differences"})
    for corner in (torch.zeros(2), torch.ones(2)):
        _, gradient = render.gradient(make_smooth_loss((SIZE, SIZE)), corner, 0, 4)
        assert bool(torch.isfinite(gradient).all()) and bool(gradient.any())


def test_a_full_turn_meets_itself() -> None:
    render = renderer(
        {"camera": {"azimuth": [0, 360]}, "pose": {"yaw": [0, 360]}, "environment": {"rotation": [0, 360]}}
    )
    with torch.no_grad():
        assert torch.allclose(render(torch.zeros(3), 1, 4), render(torch.ones(3), 1, 4), atol=1e-3)


def test_a_texture_beside_a_pose_is_differentiated_once_and_nothing_geometric_for_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    render = renderer({"texture": {"resolution": 16}, "pose": {"yaw": [0, 360]}})
    asked: list[tuple[str, ...]] = []
    original = render.scene.render_adjoint

    def spy(inputs: Any, cotangent: Tensor, seed: int, spp: int, *, wrt: Any = None, method: str = "path") -> Any:
        asked.append((method, *wrt))
        return original(inputs, cotangent, seed, spp, wrt=wrt, method=method)

    monkeypatch.setattr(render.scene, "render_adjoint", spy)
    _, gradient = render.gradient(make_smooth_loss((SIZE, SIZE)), find_interior_point(render), 0, 4)
    assert asked == [("path", "object.base_color")]
    assert bool(gradient[:-1].any()) and float(gradient[-1]) != 0.0


@pytest.mark.medium
def test_turning_an_environment_has_the_right_sign_and_size() -> None:
    """Mitsuba's own derivative of `to_world` has the wrong sign (docs/gradients.md); texels have the right one."""
    render = renderer(["environment.rotation"])
    bench = Bench(render, make_smooth_loss((SIZE, SIZE)), find_interior_point(render), seed=0, spp=64)
    by_adjoint = restrict_plan(render.plan, [render.plan.groups[0].name], "adjoint")
    adjoint = torch.stack([replace(bench, spp=128).compute_gradient(by_adjoint, seed) for seed in range(6)]).mean()
    (probe,) = find_probes(bench)
    truth = measure_reference(bench, probe)
    assert float(adjoint) * truth.value > 0.0
    assert float(adjoint) == pytest.approx(truth.value, rel=0.1)


@pytest.mark.medium
@pytest.mark.parametrize("others", [50, pytest.param(1000, marks=pytest.mark.slow)])
def test_a_configuration_after_many_others_is_bitwise_that_of_a_fresh_scene(others: int) -> None:
    controls = {"pose": {}, "camera": {}, "environment": {}, "material": {"roughness": [0.1, 0.9]}}
    used = load_scene("mug").renderer(controls, resolution=16, denoise="none")
    generator = torch.Generator().manual_seed(0)
    probe = torch.rand(used.start.shape, generator=generator)
    with torch.no_grad():
        for number in range(others):
            used(torch.rand(used.start.shape, generator=generator), seed=number, spp=1)
        after = used(probe, seed=7, spp=4)
        fresh = load_scene("mug").renderer(controls, resolution=16, denoise="none")
        assert torch.equal(after, fresh(probe, seed=7, spp=4))


@pytest.mark.medium
def test_recordings_live_on_over_moves_and_gradients() -> None:
    """Mitsuba's recordings hold on to the memory of vertices, so that it has to stay theirs."""
    controls = {"pose": {"yaw": [0, 360], "x": [-0.2, 0.2]}}
    recorded, plain = (
        load_scene("mug").renderer(controls, resolution=24, denoise="none", estimators={"*": "material"}) for _ in "ab"
    )
    plain.scene._uses_recordings = False
    generator = torch.Generator().manual_seed(0)
    of_a_move: dict[int, Any] = {}  # by their ids, which others get when a recording is let go
    for number in range(6):
        u = torch.rand(2, generator=generator)
        if number == 3:
            assert bool(recorded.gradient(lambda image: image.square().sum(), u, 1, 2)[1].any())
            recorded.scene._get_integrator("hidden")
        if number == 4:  # a second owner of the vertices, which makes Dr.Jit copy them
            held = recorded.scene.parameters["object.vertex_positions"]
            second = type(held)(held)
        with torch.no_grad():
            for again in range(2):
                assert torch.equal(recorded(u, again, 4), plain(u, again, 4)), (number, again)
        recording = recorded.scene._recorded["path", 4, recorded.scene.current_max_depth, None]
        of_a_move[id(recording)] = recording
        if number < 4:
            assert len(of_a_move) == 1 + (number == 3)  # an integrator that is new makes recordings stale
    assert len(second) == len(held)


def test_a_rotation_vector_is_a_rotation_with_a_derivative_at_zero() -> None:
    from advsearch.scene.geometry import make_euler_rotation, make_vector_rotation

    for degrees in ([0.0, 0.0, 0.0], [0.0, 0.0, 90.0], [100.0, -60.0, 45.0], [180.0, 0.0, 0.0]):
        vector = torch.tensor(degrees, requires_grad=True)
        matrix = make_vector_rotation(vector)
        assert torch.allclose(matrix @ matrix.T, torch.eye(3), atol=1e-5)
        (gradient,) = torch.autograd.grad((matrix * torch.arange(9.0).reshape(3, 3)).sum(), vector)
        assert bool(torch.isfinite(gradient).all()) and bool(gradient.any())
    turned = make_euler_rotation(torch.tensor(30.0), torch.tensor(0.0), torch.tensor(0.0))
    assert torch.allclose(make_vector_rotation(torch.tensor([0.0, 0.0, 30.0])), turned, atol=1e-6)
