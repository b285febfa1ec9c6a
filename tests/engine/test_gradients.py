"""The gradient plan: what each estimator computes, what is left out, and how it is chosen. Renders are small."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from advsearch import load_scene
from advsearch.controls import make_control
from advsearch.engine.gradients import (
    Bench,
    Estimate,
    Probe,
    Reference,
    compare_with_reference,
    find_interior_point,
    find_probes,
    list_attempts,
    make_smooth_loss,
    measure_reference,
    restrict_plan,
)
from advsearch.engine.gradients.planning import (
    MIN_AGREEMENT,
    choose_estimators,
    choose_steps,
    list_contested,
    measure_cosines,
    rate_cosine,
)
from advsearch.errors import InputError, UnknownNameError
from advsearch.questions.attack.carry_out import problem_from_config
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.check import check
from advsearch.questions.check.result import CheckConfig, make_check_view
from advsearch.runs.results import Measured
from advsearch.scene.formation import ImageFormation
from advsearch.scene.gradients import ESTIMATORS, SEARCH_STEP, Group, make_first_plan
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


# ---- the plan as data -----------------------------------------------------------------------------------------------


def test_the_first_plan_takes_what_is_preferred_and_obeys_force() -> None:
    groups = (
        group("pose.yaw", 0, 1, ("secant", "material")),
        group("texture.texels", 1, 9, ("adjoint",)),
        group("environment.which", 10, 1, ()),
    )
    steps = torch.full((11,), 0.02)
    plan = make_first_plan(groups, steps)
    assert [one.estimator for one in plan.groups] == ["secant", "adjoint", "none"]
    assert plan.renders == 2 and plan.autograd_mask.tolist() == [0.0] + [1.0] * 9 + [0.0]
    forced = make_first_plan(groups, steps, {"pose": "material", "texture.texels": "secant"})
    assert [one.estimator for one in forced.groups] == ["material", "secant", "none"]
    assert "forced" in forced.groups[0].reason
    everywhere = make_first_plan(groups, steps, {"*": "differences"})
    assert [one.estimator for one in everywhere.groups] == ["differences", "differences", "none"]


@pytest.mark.parametrize(
    ("forced", "message"),
    [
        ({"pose": "magic"}, "unknown estimator for pose 'magic'"),
        ({"*": "magic"}, "unknown estimator 'magic'"),
        ({"*": "forward"}, "unknown estimator 'forward'.*Known: adjoint, differences, image, material, none, secant"),
        ({"poze": "secant"}, "unknown control in `estimators` 'poze'"),
        ({"pose.yaw": "adjoint"}, "`estimators` pose.yaw=adjoint: not valid there; expected one of secant, material"),
    ],
)
def test_an_estimator_that_cannot_be_is_refused(forced: dict[str, str], message: str) -> None:
    with pytest.raises(InputError, match=message):
        make_first_plan((group("pose.yaw", 0, 1, ("secant", "material")),), torch.zeros(1), forced)


def test_every_estimator_that_a_control_names_exists() -> None:
    from advsearch.controls import CONTROLS

    for kind in CONTROLS:
        for parameter in CONTROLS[kind].parameters:
            assert set(parameter.estimators) <= set(ESTIMATORS), kind


# ---- what estimators compute ----------------------------------------------------------------------------------------


@pytest.mark.medium
def test_differences_are_central_differences_of_the_picture_with_one_seed() -> None:
    render = renderer(["camera"], estimators={"*": "differences"})
    weights = torch.rand(SIZE, SIZE, 3, generator=torch.Generator().manual_seed(1))
    u = find_interior_point(render)
    leaf = u.clone().requires_grad_()
    before = render.renders
    (render(leaf, seed=3, spp=4) * weights).sum().backward()
    assert render.renders - before == 1 + 2 * len(u)
    first = render.plan.groups[1]
    noise = render.compute_differences(u, weights, 3, 4)
    assert leaf.grad is not None and torch.equal(leaf.grad, noise)
    assert first.periodic is False
    step = torch.zeros_like(u)
    step[1] = first.step
    from advsearch import seeds

    common = seeds.stream(render.root_seed, "differences", 3)
    with torch.no_grad():
        rise = (weights * (render(u + step, common, 4) - render(u - step, common, 4))).sum()
    assert float(leaf.grad[1]) == pytest.approx(float(rise) / (2.0 * first.step), rel=1e-3)


def test_a_step_is_one_that_a_search_can_follow_and_never_under_a_pixel() -> None:
    both = torch.tensor([0.001, 0.1])
    fast, slow = make_first_plan((group("a.b", 0, 1, ("secant",)), group("a.c", 1, 1, ("secant",))), both).groups
    assert fast.step == SEARCH_STEP and fast.pixel == pytest.approx(0.001) and slow.step == slow.pixel == both[1]
    assert fast.step_reason == "30 times as wide as moves an outline by a pixel, so that a search can follow"
    assert slow.step_reason == "an outline moves by a pixel, or nothing moves"
    for lit in (("adjoint", "differences"), ("image",)):  # what moves no outline is as it was
        assert make_first_plan((group("a.b", 0, 1, lit),), both).groups[0].step == pytest.approx(0.001)
    assert make_first_plan((group("a.b", 0, 2, ("secant",)),), both).groups[0].step == pytest.approx(0.001)
    endless = make_first_plan((group("a.b", 0, 1, ("secant",)),), 1e-6 * both, image_size=100.0).groups[0]
    assert endless.step == pytest.approx(0.4 * 100.0 * 1e-9)  # things stay in sight
    narrow = make_first_plan((group("a.b", 0, 1, ("secant",)),), both).with_pixel_steps()
    assert narrow.groups[0].step == pytest.approx(0.001)


def test_a_plan_says_its_steps_in_the_parameters_unit_and_why() -> None:
    config = AttackConfig(object="mug", controls={"camera": {"azimuth": [0, 360]}}, resolution=(32, 32))
    problem, _ = problem_from_config(config)
    (found,) = problem.summarize_plan(problem.plan).groups
    assert found.step == SEARCH_STEP and found.unit == "degrees"
    assert found.step_in_unit == pytest.approx(0.03 * 360.0, abs=0.01)
    assert "so that a search can follow" in found.step_reason


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

    common, step = seeds.stream(render.root_seed, "differences", 5), render.plan.groups[0].step
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


def test_the_free_part_of_a_gradient_takes_no_render_of_its_own() -> None:
    render = renderer({"environment": {"exposure": [-1, 1]}, "camera": {"elevation": [5, 60]}})
    u, before = find_interior_point(render), render.renders
    _, free = render.gradient(make_smooth_loss((SIZE, SIZE)), u, 0, 4, free=True)
    assert render.renders - before == 1
    assert float(free[0]) != 0.0 and float(free[1]) == 0.0


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


@pytest.mark.slow
@pytest.mark.parametrize(("parameter", "share"), [("roughness", 0.3), ("metallic", 0.5), ("specular", 0.5)])
def test_the_adjoint_of_a_surface_agrees_with_differences_to_a_twentieth(parameter: str, share: float) -> None:
    """To a looser bound, with fewer samples, in tests/controls/test_control_material.py."""
    render = renderer({"material": {parameter: [0.1, 0.9]}})
    bench = Bench(render, make_smooth_loss((SIZE, SIZE)), torch.tensor([share]), seed=0, spp=256)
    adjoint = restrict_plan(render.plan, [render.plan.groups[0].name], "adjoint")
    values = torch.stack([replace(bench, spp=128).compute_gradient(adjoint, seed) for seed in range(6)]).flatten()
    (probe,) = find_probes(bench)
    truth = measure_reference(bench, probe)
    doubt = 3.0 * math.hypot(float(values.std()) / math.sqrt(len(values)), truth.noise)
    assert doubt < 0.5 * abs(truth.value), "too noisy to say anything"
    assert float(values.mean()) == pytest.approx(truth.value, abs=0.05 * abs(truth.value) + doubt)


# ---- nothing stays behind -------------------------------------------------------------------------------------------


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
    plain.scene._freeze = False
    generator = torch.Generator().manual_seed(0)
    of_a_move: dict[int, Any] = {}  # by their ids, which others get when a recording is let go
    for number in range(6):
        u = torch.rand(2, generator=generator)
        if number == 3:
            assert bool(recorded.gradient(lambda image: image.square().sum(), u, 1, 2)[1].any())
            recorded.scene._integrator("hidden")
        if number == 4:  # a second owner of the vertices, which makes Dr.Jit copy them
            held = recorded.scene.parameters["object.vertex_positions"]
            second = type(held)(held)
        with torch.no_grad():
            for again in range(2):
                assert torch.equal(recorded(u, again, 4), plain(u, again, 4)), (number, again)
        recording = recorded.scene._recorded["path", 4, recorded.scene.depth]
        of_a_move[id(recording)] = recording
        if number < 4:
            assert len(of_a_move) == 1 + (number == 3)  # an integrator that is new makes recordings stale
    assert len(second) == len(held)


# ---- judging --------------------------------------------------------------------------------------------------------


def test_a_judgement_needs_more_than_noise() -> None:
    sure = Reference(1.0, 0.001, (1.0, 1.0))
    assert compare_with_reference(Estimate("x", 1.01, 0.05, 9, 1.0), sure).status == "ok"
    assert compare_with_reference(Estimate("x", 1.2, 0.05, 9, 1.0), sure).status == "biased"
    turned = compare_with_reference(Estimate("x", -1.0, 0.06, 9, 1.0), sure)
    assert (turned.status, turned.bias, turned.noise) == ("biased", 2.0, 0.06)
    assert turned.doubt == pytest.approx(0.05, rel=1e-2)
    assert turned.doubt is not None and turned.excess == 2.0 - turned.doubt
    assert compare_with_reference(Estimate("x", 1.0, 0.5, 9, 1.0), sure).status == "noisy"
    unsure = Reference(0.1, 0.5, (0.6, 0.1))
    assert compare_with_reference(Estimate("x", 0.4, 0.1, 9, 1.0), unsure).status == "reference unusable"
    assert compare_with_reference(Estimate("x", 0.0, 0.0, 9, 1.0), Reference(0.0, 0.0, (0.0, 0.0))).bias == 0.0


def test_a_derivative_near_zero_is_judged_beside_the_others_of_its_control() -> None:
    small, large = Reference(0.01, 0.0, (0.01, 0.01)), Reference(5.0, 0.01, (5.0, 5.0))
    off = Estimate("x", 0.03, 0.0, 9, 1.0)
    alone, beside = compare_with_reference(off, small), compare_with_reference(off, small, [small, large])
    assert (alone.status, beside.status) == ("biased", "ok")
    assert [alone.bias, beside.bias] == pytest.approx([2.0, 0.04])
    assert compare_with_reference(off, large, [small, large]).bias == compare_with_reference(off, large).bias


def test_a_reference_of_a_parabola_has_its_bias_taken_off() -> None:
    class Curve:
        renders = 0

        def __call__(self, u: Tensor, seed: int, spp: int) -> Tensor:
            return u[0] ** 3 + 1e-4 * math.sin(seed)

    one = group("a.b", 0, 1, ("differences",), step=0.2)
    curve: Any = Curve()
    bench = Bench(curve, lambda image: image, torch.tensor([0.5]), seed=0, spp=1)
    found = measure_reference(bench, Probe(one, "a.b", torch.ones(1), 0.2))
    assert found.value == pytest.approx(0.75, abs=1e-4)
    assert found.steps[0] == pytest.approx(0.75 + 0.04, abs=1e-4)


def test_a_reference_takes_wider_steps_where_narrow_ones_are_noise() -> None:
    class Curve:
        """A slope of 1 under noise that does not depend on the step, so that wide differences see less of it."""

        renders = 0

        def __call__(self, u: Tensor, seed: int, spp: int) -> Tensor:
            self.renders += 1
            return u[0] + 0.004 * math.sin(seed * 1e3 + float(u[0]) * 1e5)

    one = group("a.b", 0, 1, ("differences",), step=0.01)
    probe = Probe(one, "a.b", torch.ones(1), 0.01)

    def found(factors: Sequence[float]) -> tuple[Reference, int]:
        curve: Any = Curve()
        bench = Bench(curve, lambda image: image, torch.tensor([0.5]), seed=0, spp=1)
        return measure_reference(bench, probe, repeats=(6, 6), factors=factors), curve.renders

    (narrow, few), (wide, many) = found((1.0,)), found((1.0, 3.0, 9.0))
    assert narrow.noise > 0.1 and narrow.factor == 1.0 and few == 24
    assert wide.factor > 1.0 and many > 24
    assert abs(wide.value - 1.0) <= 3.0 * wide.noise < 0.5 * narrow.noise


def test_what_falls_short_at_a_pixel_is_tried_with_other_steps() -> None:
    several = group("a.b", 0, 1, ("secant", "differences"), step=0.01)
    assert list_attempts(several)[:2] == [("secant", 1.0), ("differences", 1.0)]
    assert list_attempts(several)[2:] == [("differences", factor) for factor in (3.0, 9.0, 1.0 / 3.0)]
    factors = [factor for _, factor in list_attempts(replace(several, step=0.05))]
    assert factors == [1.0, 1.0, 3.0, 1.0 / 3.0]  # 9 times would be as wide as 3 times
    assert list_attempts(group("a.b", 0, 1, ("adjoint",))) == [("adjoint", 1.0)]
    forced = replace(several, estimator="secant", is_forced=True)
    assert [name for name, _ in list_attempts(forced)] == ["secant"] * 4


def test_a_wider_step_of_one_gradient_leaves_the_plan_as_it_was() -> None:
    render = renderer({"pose": {"yaw": [0, 360]}})
    steps = []

    def loss(image: Tensor) -> Tensor:
        steps.append(render.plan.groups[0].step)
        return image.sum()

    before = render.plan
    Bench(render, loss, find_interior_point(render), seed=0, spp=1).compute_gradient(
        restrict_plan(before.scale_steps(3.0), ["pose.yaw"], "secant"), 0
    )
    assert render.plan is before
    assert max(steps) == pytest.approx(3.0 * before.groups[0].step)


@pytest.mark.medium
def test_a_measured_plan_keeps_what_was_forced_and_says_what_it_measured() -> None:
    render = renderer({"environment": {"rotation": [0, 360], "exposure": [-1, 1]}})
    plan = choose_estimators(
        Bench(render, make_smooth_loss((SIZE, SIZE)), find_interior_point(render), seed=0, spp=4), repeats=2
    )
    for one in plan.groups:
        assert set(one.measured) == {"adjoint", "differences"}
        assert one.estimator == min(one.measured, key=lambda name: one.measured[name])
        assert "least squared error x time" in one.reason
    forced = renderer({"environment": {"rotation": [0, 360]}}, estimators={"environment": "adjoint"})
    assert list_contested(forced.plan) == []


def test_a_loss_that_is_flat_keeps_what_is_preferred() -> None:
    """As of a detector that sees nothing with the right name: all gradients are nil, and none has an error."""
    render = renderer({"environment": {"exposure": [-1, 1]}})
    plan = choose_estimators(
        Bench(render, lambda image: 0.0 * image.sum(), find_interior_point(render), seed=0, spp=2), repeats=2
    )
    (one,) = plan.groups
    assert set(one.measured.values()) == {0.0}
    assert (one.estimator, one.reason) == (
        render.plan.groups[0].estimator,
        "as preferred: none of them has an error, measured at 2 samples",
    )


def test_over_many_coordinates_an_adjoint_is_not_compared_with_differences() -> None:
    many, few = (
        make_first_plan(
            (group("geometry.amplitudes", 0, size, ("material", "differences")),), torch.full((size,), 0.01)
        )
        for size in (24, 8)
    )
    assert list_contested(many) == list_contested(many, with_all=True) == []
    assert list_attempts(many.groups[0]) == [("material", 1.0)]
    assert list_contested(few) == []  # material is preferred, unless all are to be compared
    assert list_contested(few, with_all=True) == [(few.groups, ("material", "differences"))]


class Told:
    """A renderer whose gradients are told: by sample count, one for each call in turn."""

    formation = ImageFormation()

    def __init__(self, gradients: dict[int, list[list[float]]]) -> None:
        self.plan = make_first_plan((group("haze.density", 0, 2, ("adjoint",)),), torch.tensor([0.01, 0.01]))
        self.gradients, self.asked = gradients, list[int]()

    def gradient(self, loss: Any, u: Tensor, seed: int, spp: int) -> tuple[Tensor, Tensor]:
        self.asked.append(spp)
        told = self.gradients[spp]
        return torch.zeros(()), torch.tensor(told[self.asked.count(spp) % len(told)])


def bench_of(renderer: Any) -> Bench:
    return Bench(renderer, lambda image: image, torch.zeros(2), seed=0, spp=1)


def test_converged_gradients_of_which_one_disagrees_get_more_samples() -> None:
    """Two of three agree to 1 here, as they do by luck where there are few numbers."""
    right, wrong = [1.0, 0.0], [-1.0, 0.1]
    told: Any = Told({128: [right, right, wrong], 512: [right], 8: [right]})
    (row,) = measure_cosines(bench_of(told), counts=(8,))
    assert told.asked == [128, 128, 128, 512, 512, 512, 8, 8, 8]
    assert (row.status, row.cosine, row.reference_cosine) == ("ok", 1.0, 1.0)
    agreed: Any = Told({128: [right], 8: [right]})
    list(measure_cosines(bench_of(agreed), counts=(8,)))
    assert 512 not in agreed.asked


def test_a_working_gradient_is_not_held_against_one_of_fewer_samples() -> None:
    right, across = [1.0, 0.0], [0.0, 1.0]
    told: Any = Told({128: [across], 512: [right], 64: [right], 256: [right]})
    dear = measure_cosines(bench_of(told), counts=(64, 256))
    assert [(row.spp, row.cosine) for row in dear] == [(64, 0.0), (256, 1.0)]


def test_the_widest_step_is_tried_only_where_no_other_will_do() -> None:
    right, across = [1.0, 0.0], [0.0, 1.0]

    def factors(working: list[list[float]], step: float = 0.01) -> list[float]:
        told: Any = Told({128: [right], 8: working})
        told.plan = make_first_plan((group("pose.x", 0, 2, ("secant",)),), torch.tensor([step, step]))
        return [row.factor for row in measure_cosines(bench_of(told), counts=(8,))]

    assert factors([right]) == [1.0, 3.0]
    assert factors([across]) == [1.0, 3.0, 9.0]
    assert factors([across], step=0.05) == [1.0, 3.0]  # as wide as a step may be


def test_the_cheapest_setting_that_reaches_the_goal_is_taken() -> None:
    plan = make_first_plan((group("pose.yaw", 0, 1, ("secant",)),), torch.tensor([0.01]))
    place: Any = {
        "quantity": "gradient",
        "estimator": "secant",
        "control": "pose",
        "reference_cosine": 0.99,
        "repeats": 3,
    }
    rows = [
        Measured(factor=1.0, spp=8, cosine=0.5, seconds=1.0, status="noisy", **place),
        Measured(factor=1.0, spp=64, cosine=0.95, seconds=8.0, status="ok", **place),
        Measured(factor=3.0, spp=16, cosine=0.93, seconds=2.0, status="ok", **place),
    ]
    chosen, spp = choose_steps(plan, rows)
    assert spp == 16 and chosen.groups[0].step == pytest.approx(3.0 * SEARCH_STEP)
    luck = rows[1].model_copy(update={"spp": 16, "cosine": 0.91, "seconds": 0.1})
    assert choose_steps(plan, [luck, rows[2]])[0] == choose_steps(plan, [rows[2]])[0]  # times are of the machine
    poor, spp = choose_steps(plan, rows[:1])
    assert spp == 8 and "below 0.9, the best that was found" in poor.groups[0].reason
    assert choose_steps(plan, [])[1] is None


@pytest.mark.parametrize(
    ("cosine", "converged", "status"),
    [
        (0.95, 0.99, "ok"),
        (0.95, 0.6, "ok"),
        (0.8, 0.99, "noisy"),
        (0.8, 0.6, "reference unusable"),
        (0.95, -0.8, "reference unusable"),
        (float("nan"), float("nan"), "reference unusable"),
    ],
)
def test_a_cosine_counts_only_where_converged_gradients_agree(cosine: float, converged: float, status: str) -> None:
    assert rate_cosine(cosine, converged) == status


def test_a_noisy_reference_only_lowers_a_cosine() -> None:
    """The bound of `MIN_AGREEMENT`: working gradients of cosine 0.95 with the truth, references
    of noise as large as makes two agree to a half. What is measured stays below, and below the bound times 0.95."""
    generator = torch.Generator().manual_seed(3)
    truth, n = torch.randn(50, generator=generator), 50
    noise = float(truth.norm()) / n**0.5  # as large as the truth: two such references have a cosine of a half
    measured = []
    for _ in range(400):
        working = truth + 0.33 * noise * torch.randn(n, generator=generator)
        one, other = (truth + noise * torch.randn(n, generator=generator) for _ in range(2))
        measured.append(float(torch.cosine_similarity(working, (one + other) / 2.0, dim=0)))
    assert sum(measured) / len(measured) == pytest.approx(
        0.95 * (2 * MIN_AGREEMENT / (1 + MIN_AGREEMENT)) ** 0.5, abs=0.02
    )


# ---- settings of controls -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"yaw": [10, 10]}, r"pose.yaw: the range \[10, 10\] has no size; write 10 to fix the value"),
        ({"yaw": [20, 10]}, r"pose.yaw: the range \[20, 10\] is reversed; write \[-340, 10\] for .* or \[10, 20\]"),
        ({"scale": [0.0, 1.0]}, r"pose.scale: expected a number from 0.01 to 100 \(1\), got 0"),
        ({"scale": 1000}, "pose.scale: expected a number from 0.01 to 100"),
        ({"yaw": math.nan}, "pose.yaw: expected a number from"),
        ({"yaw": "north"}, "pose.yaw: expected a number in degrees, got 'north'"),
        ({"yaw": True}, "pose.yaw: expected a number in degrees, got True"),
        ({"yaw": {"low": 1}}, "pose.yaw: expected a number in degrees, got 'low'"),
        ({"yaw": {"low": "1"}}, r"pose.yaw: expected .*\{choices: \[value, ...\]"),
        ({"yaw": [5]}, r"pose.yaw: expected a value, \[low, high\] or a list of values"),
        ({"on_ground": "maybe"}, "pose.on_ground: expected yes or no"),
        ({"jaw": 5}, "unknown setting of control pose 'jaw'. Did you mean 'yaw'"),
    ],
)
def test_bad_settings_say_what_to_do(settings: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        make_control("pose", settings)


def test_a_control_with_nothing_to_search_says_so() -> None:
    fixed = {name: 0.0 for name in ("yaw", "pitch", "roll", "x", "y", "z")} | {"scale": 1.0}
    with pytest.raises(InputError, match="`controls` pose: every parameter is fixed, so there is nothing to search"):
        load_scene("mug").renderer({"pose": fixed}, resolution=16)


def test_naming_one_parameter_searches_only_that() -> None:
    scene = load_scene("mug")
    for asked, names in (
        ({"pose": {"yaw": [0, 90]}}, ["pose.yaw"]),
        (["pose.yaw", "pose.x"], ["pose.yaw", "pose.x"]),
        ({"pose": {"yaw": 30}}, ["pose.pitch", "pose.roll", "pose.x", "pose.y", "pose.scale"]),
        ({"far": {"kind": "pose", "yaw": [0, 90]}}, ["far.yaw"]),
        (["light:near.power"], ["near.power"]),
    ):
        render = scene.renderer(asked, resolution=16)
        assert [one.name for one in render.plan.groups] == names
    with pytest.raises(UnknownNameError, match="unknown parameter of control pose 'yow'"):
        scene.renderer(["pose.yow"], resolution=16)


@pytest.mark.medium
def test_the_start_is_the_scene_as_it_is() -> None:
    scene = load_scene("mug")
    plain = scene.renderer({"texture": {"resolution": 256}}, resolution=32, denoise="none")
    expected = plain(plain.start, seed=0, spp=64)
    for controls in (["pose"], ["camera"], ["environment"], ["pose", "camera", "environment"]):
        render = scene.renderer(controls, resolution=32, denoise="none")
        assert float((render(render.start, seed=0, spp=64) - expected).abs().mean()) < 2e-3, controls


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


def test_a_lens_keeps_what_it_frames() -> None:
    """A dolly zoom: the object reaches as far in the picture while the field of view changes."""
    bound = make_control("camera", {"fov": [15, 60]}).bind(load_scene("ball").description)
    vertices = torch.from_numpy(load_scene("ball").description.base_vertices).float()
    for share in (0.0, 0.5, 1.0):
        inputs = bound.inputs(torch.tensor([share]))
        camera = inputs["camera.to_world"]
        seen = (vertices - camera[:3, 3]) @ camera[:3, :3]
        reach = (seen[:, :2].abs() / seen[:, 2:]).max() / torch.tan(torch.deg2rad(inputs["camera.fov"]) / 2)
        assert float(reach) == pytest.approx(0.86, rel=1e-3)


@pytest.mark.medium
def test_the_start_is_the_scene_as_it_is_in_a_picture_that_is_not_square() -> None:
    scene = load_scene("mug")
    for size in ((32, 48), (48, 32)):
        plain = scene.renderer({"environment": {"exposure": [-1, 1]}}, resolution=size, denoise="none")
        render = scene.renderer(["camera"], resolution=size, denoise="none")
        with torch.no_grad():
            difference = render(render.start, seed=0, spp=32) - plain(plain.start, seed=0, spp=32)
        assert float(difference.abs().mean()) < 2e-3


# ---- how fast things move -------------------------------------------------------------------------------------------


def azimuth_speed(**fixed: float) -> float:
    """Pixels a degree of azimuth."""
    scene = load_scene("mug", settings={name.replace("_", ".", 1): value for name, value in fixed.items()})
    made = scene.renderer({"camera": {"azimuth": [30, 50]}}, resolution=SIZE, denoise="none")
    return 1.0 / made.plan.groups[0].pixel / 20.0


def test_the_camera_follows_what_is_seen_behind_the_object() -> None:
    open_air = azimuth_speed(ground_size=0.0, camera_elevation=5.0)
    focal = SIZE / 2.0 / math.tan(math.radians(35.0 / 2.0))
    assert 1.0 <= open_air / math.radians(focal) <= 1.2  # what is far turns with the camera, faster at the edges
    below = azimuth_speed(ground_size=0.0, camera_elevation=30.0)
    assert below > 0.8 * math.radians(focal) * math.cos(math.radians(30.0))


def test_what_the_ground_hides_is_not_followed() -> None:
    hidden = azimuth_speed(ground_size=1000.0, camera_elevation=45.0)
    assert hidden < 0.7 * azimuth_speed(ground_size=0.0, camera_elevation=45.0)


def test_the_smooth_loss_does_not_see_the_edge_of_the_picture() -> None:
    loss = make_smooth_loss((SIZE, SIZE), seed=3)
    picture = torch.rand(SIZE, SIZE, 3)
    framed = picture.clone()
    framed[0], framed[-1], framed[:, 0], framed[:, -1] = 100.0, 100.0, 100.0, 100.0
    assert float(loss(framed)) == pytest.approx(float(loss(picture)), abs=1e-4)
    assert abs(float(loss(picture))) > 1e-4


# ---- the whole check ------------------------------------------------------------------------------------------------


@pytest.mark.medium
def test_a_check_says_of_both_losses_how_good_a_gradient_is(tmp_path: Path) -> None:
    config = CheckConfig(controls={"background": {}}, resolution=(24, 24), spp=4, run=str(tmp_path / "run"))
    checked = check.run(config)
    rows = checked.rows
    linear = [row for row in rows if row.loss == "linear"]
    assert {row.parameter for row in linear} >= {"hue", "saturation", "value"}
    for row in linear:
        assert row.status == "ok", row
        assert row.noise is not None and row.noise <= 0.2 and row.spp == 4
    whole = [row for row in rows if row.loss == "model" and row.quantity == "gradient"]
    assert {row.control for row in whole} == {"background"} and whole[0].estimator in ESTIMATORS
    last = whole[-1]
    assert last.cosine is not None and last.reference_cosine is not None
    assert (last.status == "ok") == (last.cosine >= 0.9 and last.reference_cosine >= MIN_AGREEMENT)
    single = {row.parameter: row for row in rows if row.loss == "model" and row.quantity == "derivative"}
    assert set(single) == {row.parameter for row in linear}
    for row in single.values():
        assert None not in (row.noise, row.reference_error, row.bias) and math.isfinite(row.value or 0.0)
        assert row.status in ("ok", "noisy", "biased", "reference unusable")
    text = " ".join(one.title for one in make_check_view(checked).sections if not one.is_empty)
    assert "Smooth linear loss" in text and "each parameter" in text and "cosine with the converged" in text
