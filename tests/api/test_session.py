"""A question inside somebody's program: torch as it was before, whatever it was; instances; what exists only there."""

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import advsearch
from advsearch.config import CONFIGS
from advsearch.errors import AdvsearchError, InputError
from advsearch.questions.attack import python
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.sweep.settings import SweepConfig
from advsearch.runs.directory import is_run
from advsearch.runs.store import Store
from small_models import Brightness
from stand_ins import interrupted

SIDE = 16
FAST: dict[str, Any] = {
    **{"resolution": SIDE, "steps": 6, "spp": 8, "trials": 6, "verify_spp": 16, "denoise": "none", "measure": "no"},
    **{"baseline": False, "epsilon": 0.3},
}


@pytest.fixture(scope="module")
def scene() -> advsearch.Scene:
    return advsearch.load_scene("mug")


@pytest.fixture(scope="module")
def level(scene: advsearch.Scene) -> float:
    """What `Brightness` sees of the clean mug."""
    render = scene.renderer("texture", resolution=SIDE, denoise="none")
    return float(render(render.start, spp=16)[4:-4, 4:-4].mean())


def victim(threshold: float, name: str = "bright") -> advsearch.Model:
    return advsearch.load_model(Brightness(threshold, border=4), labels=["mug", "vase"], input_size=SIDE, name=name)


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    """What an attack would do, without doing it."""
    monkeypatch.setattr(python, "run_attack", lambda parts, *_: parts)
    return advsearch.attack


@pytest.mark.medium
def test_a_search_learns_whatever_is_switched_off_around_it(scene: advsearch.Scene, level: float) -> None:
    with torch.inference_mode():
        result = advsearch.attack(scene, victim(level + 0.03), **FAST)
        assert not torch.is_grad_enabled(), "the caller's mode is the caller's"
    assert result.found and result.search is not None and result.search.gradients > 0
    assert not result.u.is_inference()


@pytest.mark.medium
def test_a_renderer_and_a_model_that_were_made_in_inference_mode_are_differentiable(level: float) -> None:
    with torch.inference_mode():
        render = advsearch.load_scene("mug").renderer(["texture", "pose.yaw"], resolution=SIDE, denoise="none")
        model, bare = victim(level), Brightness(level, border=4)
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
        with pytest.raises(InputError, match="inference_mode"):
            render(render.start.clone().requires_grad_(), spp=1)
    with torch.no_grad():
        assert not render(u, spp=1).requires_grad, "as any function of torch"


def broken(logits: Tensor, images: Tensor, labels: Any) -> Tensor:
    raise ZeroDivisionError


def interrupted_once() -> Callable[..., Tensor]:
    """An objective during which somebody presses Ctrl-C."""
    pressed = iter([True])

    def objective(logits: Tensor, images: Tensor, labels: Any) -> Tensor:
        if next(pressed, False):
            raise KeyboardInterrupt
        return logits[:, 1]

    return objective


@pytest.mark.medium
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
        advsearch.attack(scene, model, objective=interrupted_once(), threads=1, **FAST)
        assert (torch.get_num_threads(), drjit.thread_count()) == (3, workers)
        advsearch.sweep(scene, model, {"pose.yaw": [0, 90]}, resolution=SIDE, spp=1, trials=0, threads=1)
        assert (torch.get_num_threads(), drjit.thread_count()) == (3, workers)
        with pytest.raises(AdvsearchError):
            advsearch.region("mug", "nonesuch", threads=1)
        assert (torch.get_num_threads(), drjit.thread_count()) == (3, workers)
    finally:
        torch.set_num_threads(before)


@pytest.mark.medium
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


SMALL: dict[str, Any] = {**FAST, "spp": 2, "verify_spp": 2, "steps": 4}


class Loss:
    """An objective that settings call by the same name whatever the factor is, which nobody can read off it."""

    __name__ = "loss"

    def __init__(self, factor: float) -> None:
        self.factor = torch.tensor(factor)

    def __call__(self, logits: Tensor, images: Tensor, labels: Any) -> Tensor:
        return self.factor * images.mean(dim=(1, 2, 3))


def stopped(monkeypatch: pytest.MonkeyPatch, after: int = 2) -> Any:
    """Let a search be interrupted after so many evaluations."""
    patch = pytest.MonkeyPatch()
    interrupted(patch, after)
    return patch


@pytest.mark.medium
def test_a_run_goes_on_with_the_objective_and_the_weights_that_it_began_with(
    scene: advsearch.Scene, level: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, model = tmp_path / "run", victim(level + 0.03)
    patch = stopped(monkeypatch)
    assert advsearch.attack(scene, model, objective=Loss(1.0), run=run, **SMALL).summary.ending == "interrupted"
    patch.undo()
    again: dict[str, Any] = {**SMALL, "run": run, "resume": True}
    with pytest.raises(InputError, match="objective"):
        advsearch.attack(scene, model, objective=Loss(-1.0), **again)
    with pytest.raises(InputError, match="began with"):
        advsearch.attack(scene, victim(level + 0.05), objective=Loss(1.0), **again)
    assert advsearch.attack(scene, model, objective=Loss(1.0), **again).summary.ending != "interrupted"
    with Store(run / "results.sqlite", read_only=True) as store:
        noted = store.read_json_note("made of")
    assert len(noted["objective"]) == len(noted["model bright"]) == 64


def test_a_run_that_is_killed_while_it_loads_goes_on(tmp_path: Path) -> None:
    """By the command line and from Python: the folder is there before anything is loaded."""
    from advsearch.experiment import run_experiment

    run = tmp_path / "new" / "run"

    config = AttackConfig(object="mug", run=str(run), **{**SMALL, "resolution": (SIDE, SIDE)})
    seen: list[bool] = []

    def killed(*_: Any, **__: Any) -> Any:
        seen.append(is_run(run) and (run / "run.yaml").is_file())
        raise InterruptedError

    asks: list[Callable[[], Any]] = [
        lambda: run_experiment(config),
        lambda: advsearch.attack("mug", run=run, **SMALL),
        lambda: advsearch.sweep("mug", grid={"pose.yaw": [0, 90]}, run=run),
        lambda: run_experiment(SweepConfig(object="mug", grid={"pose.yaw": [0, 90]}, run=str(run))),
    ]
    if "region" in CONFIGS:
        asks.append(lambda: run_experiment(CONFIGS["region"](object="mug", controls="pose", run=str(run))))
    for ask in asks:
        with pytest.MonkeyPatch.context() as patch:
            for module in ("questions.attack.carry_out", "questions.sweep.carry_out"):
                patch.setattr(f"advsearch.{module}.load_models", killed)
            with pytest.raises(InterruptedError):
                ask()
        assert seen.pop() and not run.parent.exists(), "what was only refused leaves nothing"
    assert not seen
