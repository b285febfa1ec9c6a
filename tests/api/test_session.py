"""A question inside somebody's program: torch as it was before, whatever it was; instances; what exists only there."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

import advsearch
from advsearch.api import attack as attacking
from advsearch.config import CONFIGS
from advsearch.controls.numbers import NumberControl
from advsearch.controls.pose import PoseControl
from advsearch.controls.texture import TextureControl
from advsearch.errors import AdvsearchError, InputError
from advsearch.scene.parameters import Parameter
from advsearch.settings import settings

SIDE = 16
FAST: dict[str, Any] = {
    **{"resolution": SIDE, "steps": 6, "spp": 8, "trials": 6, "verify_spp": 16, "denoise": "none", "measure": "no"},
    **{"baseline": False, "epsilon": 0.3},
}


class Bright(nn.Module):
    """Says "mug" while the middle of the picture is darker than a threshold."""

    def __init__(self, threshold: float) -> None:
        super().__init__()
        self.threshold = nn.Parameter(torch.tensor(threshold))

    def forward(self, images: Tensor) -> Tensor:
        score = 40.0 * (images[:, :, 4:-4, 4:-4].mean(dim=(1, 2, 3)) - self.threshold)
        return torch.stack([-score, score], dim=1)


@pytest.fixture(scope="module")
def scene() -> advsearch.Scene:
    return advsearch.load_scene("mug")


@pytest.fixture(scope="module")
def level(scene: advsearch.Scene) -> float:
    """What `Bright` sees of the clean mug."""
    render = scene.renderer("texture", resolution=SIDE, denoise="none")
    return float(render(render.start, spp=16)[4:-4, 4:-4].mean())


def victim(threshold: float, name: str = "bright") -> advsearch.Model:
    return advsearch.load_model(Bright(threshold), labels=["mug", "vase"], input_size=SIDE, name=name)


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    """What an attack would do, without doing it."""
    monkeypatch.setattr(attacking, "_carry_out", lambda job, progress: job)
    return advsearch.attack


# ---- what torch is in the middle of ---------------------------------------------------------------------------------

MODES: dict[str, Callable[[], Any]] = {
    "inference_mode": torch.inference_mode,
    "no_grad": torch.no_grad,
    "set_grad_enabled": lambda: torch.set_grad_enabled(False),
}


@pytest.mark.parametrize("mode", MODES)
def test_a_search_learns_whatever_is_switched_off_around_it(mode: str, scene: advsearch.Scene, level: float) -> None:
    with MODES[mode]():
        result = advsearch.attack(scene, victim(level + 0.03), **FAST)
        assert not torch.is_grad_enabled(), "the caller's mode is the caller's"
    assert result.found and result.search is not None and result.search.gradients > 0
    assert not result.u.is_inference()


def test_a_renderer_and_a_model_that_were_made_in_inference_mode_are_differentiable(level: float) -> None:
    with torch.inference_mode():
        render = advsearch.load_scene("mug").renderer(["texture", "pose.yaw"], resolution=SIDE, denoise="none")
        model, bare = victim(level), Bright(level)
        picture = render(render.start, spp=1)
    assert not picture.is_inference() and not picture.requires_grad
    u = render.start.clone().requires_grad_()
    for judge in (model, advsearch.load_model(bare, input_size=SIDE)):
        assert judge.differentiable
        (found,) = torch.autograd.grad(judge(render(u, spp=2))[0, 0], u)
        assert float(found[:-1].abs().sum()) > 0.0 and float(found[-1]) != 0.0
    with torch.inference_mode():
        assert render(u, spp=1).requires_grad
        assert float(render.gradient(lambda image: image.mean(), u, 0, 1)[1].abs().sum()) > 0.0
        with pytest.raises(InputError, match=r"u was made in `torch\.inference_mode\(\)`, so that nothing can be"):
            render(render.start.clone().requires_grad_(), spp=1)
    with torch.no_grad():
        assert not render(u, spp=1).requires_grad, "as any function of torch"


def broken(logits: Tensor, images: Tensor, labels: Any) -> Tensor:
    raise ZeroDivisionError


def interrupted(logits: Tensor, images: Tensor, labels: Any) -> Tensor:
    raise KeyboardInterrupt


def test_threads_are_given_back_after_answers_errors_and_interrupts(scene: advsearch.Scene, level: float) -> None:
    import drjit

    before, model = torch.get_num_threads(), victim(level + 0.03)
    torch.set_num_threads(3)
    workers = drjit.thread_count()
    try:
        advsearch.attack(scene, model, deterministic=True, **{**FAST, "steps": 1})
        assert (torch.get_num_threads(), drjit.thread_count()) == (3, workers)
        with pytest.raises(ZeroDivisionError):
            advsearch.attack(scene, model, objective=broken, threads=1, **FAST)
        assert (torch.get_num_threads(), drjit.thread_count()) == (3, workers)
        advsearch.attack(scene, model, objective=interrupted, threads=1, **FAST)
        assert (torch.get_num_threads(), drjit.thread_count()) == (3, workers)
        advsearch.sweep(scene, model, {"pose.yaw": [0, 90]}, resolution=SIDE, spp=1, trials=0, threads=1)
        assert (torch.get_num_threads(), drjit.thread_count()) == (3, workers)
        with pytest.raises(AdvsearchError):
            advsearch.region("mug", "nonesuch", threads=1)
        assert (torch.get_num_threads(), drjit.thread_count()) == (3, workers)
    finally:
        torch.set_num_threads(before)


def test_questions_and_renders_of_several_threads_come_out_as_they_do_alone(
    scene: advsearch.Scene, level: float
) -> None:
    def attacked(seed: int) -> Tensor:
        small = {**FAST, "steps": 2, "spp": 2, "verify_spp": 2}
        return advsearch.attack(scene, victim(level + 0.03), seed=seed, threads=1, **small).u

    def rendered(seed: int) -> Tensor:
        render = scene.renderer("texture", resolution=SIDE)
        return torch.stack([render(render.start, seed=seed + number, spp=1) for number in range(3)])

    work = [(attacked, 0), (attacked, 1), (rendered, 2), (rendered, 3)]
    alone = [function(seed) for function, seed in work]
    found: dict[int, Tensor] = {}
    workers = [
        threading.Thread(target=lambda function=function, seed=seed: found.__setitem__(seed, function(seed)))
        for function, seed in work
    ]
    for one in workers:
        one.start()
    for one in workers:
        one.join()
    assert [torch.equal(found[seed], alone[seed]) for seed in range(4)] == [True] * 4


# ---- values ---------------------------------------------------------------------------------------------------------


def forms(value: Any, other: Any) -> list[Any]:
    """One value, and two, as Python programs have them."""
    if isinstance(value, str):
        return [[value], (value,), np.str_(value), [value, other], (value, other), np.array([value, other])]
    one = [np.float64(value), np.float32(value), np.array(value), torch.tensor(value)]
    return [*one, [value, other], (value, other), np.array([value, other]), torch.tensor([value, other])]


def holds(kept: Any, value: Any) -> bool:
    """Whether a value is in what a setting came to."""
    if isinstance(kept, str):
        return str(value) in kept.split(",") or kept.endswith(f"/{value}")
    inner = kept.values() if isinstance(kept, dict) else kept if isinstance(kept, tuple) else [kept]
    return any(one == value for one in inner) or (isinstance(kept, dict) and value in kept)


@pytest.mark.parametrize("command", CONFIGS)
def test_every_setting_takes_each_value_that_it_is_given_or_none(command: str) -> None:
    """The same over all settings of all questions: nothing of a list is dropped, and a number is one of any library."""
    config = CONFIGS[command]
    needed = {"object": "mug", "out": "a.png", "answer": "run", "recipe": "a.yaml", "sweeps": "run"}
    needed = {name: value for name, value in needed.items() if name in {one.field for one in settings(config)}}
    taken = 0
    for one in settings(config):
        for value, other in ((8, 9), (0.5, 0.25), ("random", "auto"), ("mug", "bowl")):
            for given in forms(value, other):
                try:
                    kept = getattr(config(**{**needed, one.name: given}), one.field)
                except InputError:
                    continue
                taken += 1
                several = len(np.atleast_1d(np.asarray(given))) > 1
                assert holds(kept, value) and (not several or holds(kept, other)), (one.name, given, kept)
        if isinstance(one.default, (int, float)) and not isinstance(one.default, bool):
            for given in (np.float64(one.default), np.array(one.default), torch.tensor(one.default)):
                assert getattr(config(**{**needed, one.name: given}), one.field) == pytest.approx(one.default), one.name
    assert taken > 10


def test_several_epsilons_are_not_the_first_one(asked: Callable[..., Any], scene: advsearch.Scene) -> None:
    for several in ([0.1, 0.2], (0.1, 0.2), np.array([0.1, 0.2]), torch.tensor([0.5, 0.25]), "0.1,0.2"):
        with pytest.raises(InputError, match=r"^epsilon: expected one, got 0\.[15], 0\.2.*; attack with each, or have"):
            asked(scene, epsilon=several)
    for one in (0.5, [0.5], np.float32(0.5), torch.tensor(0.5), np.array([0.5])):
        assert asked(scene, epsilon=one).controls[0].epsilon == 0.5


def test_what_an_attack_takes_beside_its_settings_is_read_as_they_are(asked: Callable[..., Any]) -> None:
    job = asked("mug", environment=["loft"], exposure=np.float32(1.0), set={"camera.azimuth": torch.tensor(3.0)})
    assert (job.scene.description.environment_name, job.scene.description.values["camera.azimuth"]) == ("loft", 3.0)
    assert job.scene.description.values["camera.exposure"] == 1.0
    job = asked("mug", policy={"name": "pgd", "momentum": np.float64(0.5)}, camera=["orbit"], task=["classification"])
    assert "momentum: 0.5" in job.config.command_line() and job.policy == "pgd"
    assert asked("mug", controls={"pose": {"yaw": np.array([0.0, 90.0])}}).config.controls == {
        "pose": {"yaw": [0.0, 90.0]}
    }
    assert asked("mug", label=[0, 1]).config.label == "0,1"
    for wrong in ({"policy": ["pgd", "random"]}, {"objective": ["margin", "dlr"]}, {"task": ["yaw", "seen"]}):
        with pytest.raises(InputError, match=rf"^{next(iter(wrong))}: expected "):
            asked("mug", **wrong)
    with pytest.raises(InputError, match="labels: expected a JSON or text file"):
        asked("mug", labels=["mug", "vase"])
    assert advsearch.load_scene("mug", settings={"pose.yaw": np.float32(9.0)}).description.values["pose.yaw"] == 9.0


def test_what_belongs_to_a_loaded_scene_is_not_given_beside_it(scene: advsearch.Scene) -> None:
    for function in (advsearch.attack, advsearch.sweep):
        with pytest.raises(InputError, match="environment: belongs to the scene, which is given already"):
            function(scene, environment="loft")


# ---- instances ------------------------------------------------------------------------------------------------------


class Faded(NumberControl):
    """How dark the object is: a control that no package registers."""

    kind = "faded"
    summary = "How dark the object is."
    parameters = (
        Parameter("amount", (), "1", 0.0, 1.0, 0.0, "1 is black.", search=(0.0, 1.0), estimators=("adjoint",)),
    )

    def scene_inputs(self, scene: Any, values: Any, so_far: Any) -> dict[str, Tensor]:
        return {"object.roughness": 0.5 + 0.5 * values["amount"]}


def test_instances_and_names_go_together_in_every_question(
    scene: advsearch.Scene, tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    mixed = [Faded(amount=[0.0, 0.5]), "pose.yaw"]
    found = advsearch.attack(scene, victim(0.9), controls=mixed, policy="random", **{**FAST, "steps": 2})
    assert found.summary.controls == ["faded", "pose"] and set(found.summary.configuration or {}) >= {"faded.amount"}
    swept = advsearch.sweep(
        scene, victim(0.9), controls=mixed, samples=2, resolution=SIDE, spp=1, trials=0, denoise="none"
    )
    assert swept.summary.configurations == 2
    over = advsearch.attack(
        scene, victim(0.9), controls="texture", over=mixed, draws=1, **{**FAST, "steps": 1, "trials": 6}
    )
    assert over.summary.over == ["faded", "pose"]
    small: dict[str, Any] = {"resolution": SIDE, "spp": 1, "threads": 1, "denoise": "none"}
    gap = advsearch.gap(
        "mug", controls=mixed, steps=1, average=6, trials=6, verify_spp=1, baseline=False, policy="random",
        run=tmp_path / "gap", **small,
    )  # fmt: skip
    assert [row.control for row in gap.table] == ["faded", "pose.yaw"]
    seen: list[Any] = []
    monkeypatch.setattr("advsearch.api.plan._Measurements", lambda problem, *_: seen.append(problem) or 1 / 0)
    with pytest.raises(ZeroDivisionError):
        advsearch.plan("mug", controls=mixed, run=tmp_path / "plan", **small)
    assert [bound.name for bound in seen[0].space.controls] == ["faded", "pose"]
    with pytest.raises(InputError, match="workers: expected names of objects, models, controls"):
        advsearch.gap("mug", controls=mixed, workers=2)
    with pytest.raises(InputError, match="workers: expected names of objects, models, controls"):
        advsearch.attack("mug", controls=mixed, workers=2)
    with pytest.raises(InputError, match="epsilon: control texture is an instance already"):
        advsearch.gap("mug", controls=[TextureControl(), PoseControl()], epsilon=0.1, run=tmp_path / "not")
    with pytest.raises(InputError, match="unknown control 'faded'"):
        advsearch.gap("mug", controls="faded", run=tmp_path / "not")
