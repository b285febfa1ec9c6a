"""A question inside somebody's program: torch as it was before, whatever it was; instances; what exists only there."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

import advsearch
from advsearch.api.keywords import make_config
from advsearch.attacks import make_policy
from advsearch.cli.main import main
from advsearch.config import CONFIGS
from advsearch.controls import Control
from advsearch.controls.base import NumberControl
from advsearch.controls.pose import PoseControl
from advsearch.controls.texture import TextureControl
from advsearch.engine.naming import load_configured_scene, load_models, make_configured_controls
from advsearch.errors import AdvsearchError, InputError
from advsearch.models import ModelWarning
from advsearch.progress import NullProgress
from advsearch.questions.attack import python
from advsearch.questions.attack.carry_out import problem_from_config
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.attack.wording import objective_text
from advsearch.questions.region.result import RegionConfig
from advsearch.questions.sweep.settings import SweepConfig
from advsearch.runs.directory import is_run
from advsearch.runs.store import Store
from advsearch.scene.settings import Parameter
from advsearch.settings import settings
from advsearch.tasks import make_task
from covering import only
from samples import SUMMARY
from stand_ins import interrupted

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
    monkeypatch.setattr(python, "run_attack", lambda parts, *_: parts)
    return advsearch.attack


# ---- what torch is in the middle of ---------------------------------------------------------------------------------

MODES: dict[str, Callable[[], Any]] = {
    "inference_mode": torch.inference_mode,
    "no_grad": torch.no_grad,
    "set_grad_enabled": lambda: torch.set_grad_enabled(False),
}


@pytest.mark.medium
@pytest.mark.parametrize("mode", only(["inference_mode"], MODES))
def test_a_search_learns_whatever_is_switched_off_around_it(mode: str, scene: advsearch.Scene, level: float) -> None:
    with MODES[mode]():
        result = advsearch.attack(scene, victim(level + 0.03), **FAST)
        assert not torch.is_grad_enabled(), "the caller's mode is the caller's"
    assert result.found and result.search is not None and result.search.gradients > 0
    assert not result.u.is_inference()


@pytest.mark.medium
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
        return str(value) in re.split(r",|; |\+| \| ", kept) or kept.endswith(f"/{value}")
    inner = kept.values() if isinstance(kept, dict) else kept if isinstance(kept, tuple) else [kept]
    return any(one == value for one in inner) or (isinstance(kept, dict) and value in kept)


@pytest.mark.medium
@pytest.mark.parametrize("command", CONFIGS)
def test_every_setting_takes_each_value_that_it_is_given_or_none(command: str) -> None:
    """The same over all settings of all questions: nothing of a list is dropped, and a number is one of any library."""
    config = CONFIGS[command]
    needed = {
        "object": "mug",
        "out": "a.png",
        "attack": "run",
        "recipe": "a.yaml",
        "sweeps": "run",
        "compared": "run,b",
        "suite": "a.yaml",
    }
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


@pytest.mark.medium
def test_several_epsilons_are_not_the_first_one(asked: Callable[..., Any], scene: advsearch.Scene) -> None:
    for several in ([0.1, 0.2], (0.1, 0.2), np.array([0.1, 0.2]), torch.tensor([0.5, 0.25]), "0.1,0.2"):
        with pytest.raises(InputError, match=r"^epsilon: expected one, got 0\.[15], 0\.2.*; attack with each, or have"):
            asked(scene, epsilon=several)
    for one in (0.5, [0.5], np.float32(0.5), torch.tensor(0.5), np.array([0.5])):
        assert asked(scene, epsilon=one).controls[0].chosen["epsilon"] == 0.5


@pytest.mark.medium
def test_what_an_attack_takes_beside_its_settings_is_read_as_they_are(asked: Callable[..., Any]) -> None:
    job = asked("mug", environment=["loft"], exposure=np.float32(1.0), set={"camera.azimuth": torch.tensor(3.0)})
    assert (job.scene.description.environment_name, job.scene.description.values["camera.azimuth"]) == ("loft", 3.0)
    assert job.scene.description.values["camera.exposure"] == 1.0
    job = asked("mug", policy={"name": "pgd", "momentum": np.float64(0.5)}, camera=["orbit"], task=["classification"])
    assert "momentum: 0.5" in job.config.to_yaml() and job.policy == make_policy("pgd", momentum=0.5)
    assert asked("mug", controls={"pose": {"yaw": np.array([0.0, 90.0])}}).config.controls == {
        "pose": {"yaw": [0.0, 90.0]}
    }
    assert asked("mug", label=[0, 1]).config.label == "0,1"
    for wrong in ({"policy": ["pgd", "random"]}, {"objective": ["margin", "dlr"]}):
        with pytest.raises(InputError, match=rf"^{next(iter(wrong))}: expected "):
            asked("mug", **wrong)
    with pytest.raises(InputError, match="labels: 2 labels, but model reference has 14 classes"):
        asked("mug", labels=["mug", "vase"])
    assert advsearch.load_scene("mug", settings={"pose.yaw": np.float32(9.0)}).description.values["pose.yaw"] == 9.0


def test_what_belongs_to_a_loaded_scene_is_not_given_beside_it(scene: advsearch.Scene) -> None:
    for function in (advsearch.attack, advsearch.sweep):
        with pytest.raises(InputError, match="environment: belongs to the scene, and a loaded scene was given"):
            function(scene, environment="loft")


# ---- instances ------------------------------------------------------------------------------------------------------


class Faded(NumberControl):
    """How dark the object is: a control that no package registers."""

    kind = "faded"
    summary = "How dark the object is."
    parameters = (
        Parameter("amount", (), "1", 0.0, 1.0, 0.0, "1 is black.", search=(0.0, 1.0), estimators=("adjoint",)),
    )

    def scene_inputs(self, values: Any, so_far: Any) -> dict[str, Tensor]:
        return {"object.roughness": 0.5 + 0.5 * values["amount"]}


def test_settings_hold_the_objects_that_they_name_and_nothing_else_does(scene: advsearch.Scene) -> None:
    model, faded = victim(0.5), Faded(amount=[0.0, 0.5])
    config = make_config(RegionConfig, object=scene, model=model, controls=[faded, "pose.yaw"])
    assert [(part.role, part.name) for part in config.python_only_parts] == [("model", "bright"), ("control", "Faded")]
    assert (config.object, config.model, [*config.controls]) == ("mug", "bright", ["faded", "pose.yaw"])
    attacked = AttackConfig.from_config(config, seed=3)  # goes on from one experiment to another
    assert (
        load_configured_scene(attacked) is scene and make_configured_controls(attacked, attacked.controls)[0] is faded
    )
    (loaded,), _ = load_models([attacked.model], make_task("classification"), attacked)
    assert loaded.module is model.module
    with pytest.raises(AdvsearchError, match="bright"):  # the name alone is not known
        load_models(["bright"], make_task("classification"), AttackConfig(object="mug", model="bright"))
    assert load_configured_scene(AttackConfig(object="mug")) is not scene


@pytest.mark.medium
def test_instances_and_names_go_together_in_every_question(
    scene: advsearch.Scene, tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    mixed: list[str | Control] = [Faded(amount=[0.0, 0.5]), "pose.yaw"]
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
    seen: list[Any] = []

    def loaded(config: Any, **_: Any) -> None:
        seen.append(problem_from_config(config)[0])
        raise ZeroDivisionError

    monkeypatch.setattr("advsearch.api.workbench.problem_from_config", loaded)
    with pytest.raises(ZeroDivisionError):
        advsearch.check("mug", controls=mixed, run=tmp_path / "check", **small)
    assert [bound.name for bound in seen[0].space.controls] == ["faded", "pose"]
    with pytest.raises(InputError, match="workers: other processes load objects, models, controls"):
        advsearch.attack("mug", controls=mixed, workers=2)
    with pytest.raises(InputError, match="epsilon: control texture was given as an instance"):
        advsearch.attack("mug", controls=[TextureControl(), PoseControl()], epsilon=0.1, run=tmp_path / "not")
    with pytest.raises(InputError, match="unknown control 'faded'"):
        advsearch.attack("mug", controls="faded", run=tmp_path / "not")


# ---- a run of this session ------------------------------------------------------------------------------------------

SMALL: dict[str, Any] = {**FAST, "spp": 2, "verify_spp": 2, "steps": 4}


def brightness(factor: float) -> Callable[..., Tensor]:
    """An objective that settings call by the same name whatever the factor is."""

    def loss(logits: Tensor, images: Tensor, labels: Any) -> Tensor:
        return factor * images.mean(dim=(1, 2, 3))

    return loss


class Loss:
    """The same as an object, whose numbers nobody can read off it."""

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
@pytest.mark.parametrize("own", only([Loss], [brightness, Loss]))
def test_a_run_goes_on_with_the_objective_and_the_weights_that_it_began_with(
    own: Callable[[float], Any], scene: advsearch.Scene, level: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, model = tmp_path / "run", victim(level + 0.03)
    patch = stopped(monkeypatch)
    assert advsearch.attack(scene, model, objective=own(1.0), run=run, **SMALL).summary.ending == "interrupted"
    patch.undo()
    again: dict[str, Any] = {**SMALL, "run": run, "resume": True}
    with pytest.raises(InputError, match=r"cannot resume with something else than the run began with: objective;"):
        advsearch.attack(scene, model, objective=own(-1.0), **again)
    with pytest.raises(InputError, match="began with: model bright; restore it, or start again where it was asked"):
        advsearch.attack(scene, victim(level + 0.05), objective=own(1.0), **again)
    assert advsearch.attack(scene, model, objective=own(1.0), **again).summary.ending != "interrupted"
    with Store(run / "results.sqlite", read_only=True) as store:
        noted = store.read_json_note("made of")
    assert len(noted["objective"]) == len(noted["model bright"]) == 64


@pytest.mark.medium
def test_a_model_that_answers_at_random_goes_on(
    scene: advsearch.Scene, level: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Random(Bright):
        def forward(self, images: Tensor) -> Tensor:
            return super().forward(images) + 0.2 * torch.rand(())

    with pytest.warns(ModelWarning):
        model = advsearch.load_model(Random(level + 0.03), labels=["mug", "vase"], input_size=SIDE)
    patch = stopped(monkeypatch)
    advsearch.attack(scene, model, run=tmp_path / "run", **SMALL)
    patch.undo()
    found = advsearch.attack(scene, model, run=tmp_path / "run", resume=True, **SMALL)
    assert found.summary.ending != "interrupted"


@pytest.mark.medium
def test_a_sweep_goes_on_with_the_weights_that_it_began_with(scene: advsearch.Scene, tmp_path: Path) -> None:
    class Stops(NullProgress):
        def advance(self, n: int = 1, **info: float | str) -> None:
            if n:
                raise KeyboardInterrupt

    asked: dict[str, Any] = {"resolution": SIDE, "spp": 1, "trials": 0, "denoise": "none", "batch": 1}
    grid = {"pose.yaw": [0, 90, 180, 270]}
    model = victim(0.5)
    for ends in (Stops(), NullProgress()):
        with suppress(KeyboardInterrupt):
            advsearch.sweep(scene, model, grid, run=tmp_path / "run", progress=ends, **asked)
        if isinstance(ends, Stops):
            with pytest.raises(InputError, match=r"cannot resume with .* began with: model bright;"):
                advsearch.sweep(scene, victim(0.6), grid, run=tmp_path / "run", **asked)
    with Store(tmp_path / "run" / "results.sqlite", read_only=True) as store:
        assert store.count_rows("sweep") == 4


@pytest.mark.medium
def test_what_exists_only_here_is_no_command(
    scene: advsearch.Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    objective = lambda logits, images, labels: images.mean(dim=(1, 2, 3))  # noqa: E731
    result = advsearch.attack(
        scene, "reference", objective=objective, run=run, **{**SMALL, "steps": 1, "resolution": 128}
    )
    assert (result.summary.command_line, result.summary.python_only) == (None, ["the objective <lambda>"])
    page = (run / "report.html").read_text("utf-8")
    assert "the objective &lt;lambda&gt; exists only in" in page and f"advsearch run {run}" not in page
    assert "# But it can't be: the objective <lambda>" in (run / "run.yaml").read_text("utf-8")
    (run / "summary.json").unlink()
    assert main(["resume", str(run)]) == 2
    assert "the objective <lambda> existed only in the Python session of the run" in capsys.readouterr().err
    run.joinpath("summary.json").write_text(json.dumps(result.summary.to_dict()), "utf-8")
    replayed = advsearch.replay(run, ways="curve", trials=6, run=tmp_path / "again", threads=1)
    assert {row.ending for row in replayed.table} <= {"found", "budget spent", "not verified", "already wrong"}
    drawn = advsearch.load_scene(scene.description.object)
    swept = advsearch.sweep(drawn, "reference", {"pose.yaw": [0, 90]}, resolution=SIDE, spp=1, trials=0)
    assert (swept.summary.command_line, swept.summary.python_only) == (None, ["the scene"])
    named = advsearch.attack(scene, advsearch.load_model("reference"), run=tmp_path / "named", **{**SMALL, "steps": 1})
    assert named.summary.command_line == f"advsearch run {tmp_path}/named/run.yaml" and not named.summary.python_only
    assert AttackConfig.from_yaml(tmp_path / "named" / "run.yaml").model == "reference"


@pytest.mark.medium
def test_an_objective_of_ones_own_stands_beside_the_score_of_every_trial(
    scene: advsearch.Scene, level: float, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    result = advsearch.attack(scene, victim(level + 0.03), objective=brightness(1.0), run=run, average=2, **SMALL)
    for row in result.rows():
        assert row.margin is not None and row.score == -row.margin, "of classification without a target"
        assert row.objective is not None and 0.0 < row.objective < 1.0, row.kind
    tried = result.summary.tried_objective
    control = [row.objective for row in result.rows("control") if row.objective is not None]
    assert tried is not None and tried.clean is not None and tried.answer is not None
    assert tried.clean.mean == pytest.approx(sum(control) / 6) and tried.clean.low == min(control)
    assert tried.answer.low <= tried.answer.mean <= tried.answer.high and tried.answer.deviation > 0.0
    assert "loss in the trials: clean 0.4" in objective_text(result.summary)
    assert objective_text(SUMMARY) == "", "of a margin"


def test_a_run_that_is_killed_while_it_loads_goes_on(tmp_path: Path) -> None:
    """By the command line and from Python: the folder is there before anything is loaded."""
    from advsearch.experiment import run_experiment

    run = tmp_path / "new" / "run"

    config = AttackConfig(object="mug", run=str(run), **{**SMALL, "resolution": (SIDE, SIDE)})
    seen: list[bool] = []

    def killed(*_: Any, **__: Any) -> Any:
        seen.append(is_run(run) and (run / "run.yaml").is_file())
        raise InterruptedError

    for ask in (
        lambda: run_experiment(config),
        lambda: advsearch.attack("mug", run=run, **SMALL),
        lambda: advsearch.sweep("mug", grid={"pose.yaw": [0, 90]}, run=run),
        lambda: run_experiment(SweepConfig(object="mug", grid={"pose.yaw": [0, 90]}, run=str(run))),
        lambda: run_experiment(RegionConfig(object="mug", controls="pose", run=str(run))),
    ):
        with pytest.MonkeyPatch.context() as patch:
            for module in ("questions.attack.carry_out", "questions.sweep.carry_out"):
                patch.setattr(f"advsearch.{module}.load_models", killed)
            with pytest.raises(InterruptedError):
                ask()
        assert seen.pop() and not run.parent.exists(), "what was only refused leaves nothing"
    assert not seen


@pytest.mark.medium
def test_a_run_that_was_killed_at_once_is_resumed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = tmp_path / "run"
    words = ["attack", "--object", "mug", "--run", str(run), "--resolution", str(SIDE), "--steps", "1", "--spp", "1"]
    words += ["--trials", "6", "--verify-spp", "1", "--no-baseline", "--measure", "no", "--denoise", "none"]
    child = subprocess.Popen([sys.executable, "-m", "advsearch", *words, "--quiet"], env=dict(os.environ))
    while not (run / "run.yaml").is_file():
        assert child.poll() is None
        time.sleep(0.005)
    child.kill()
    child.wait()
    assert main(["resume", str(run), "--quiet"]) == 0
    assert "mug" in capsys.readouterr().out


@pytest.mark.medium
def test_a_run_is_replaced_when_something_takes_its_place(scene: advsearch.Scene, tmp_path: Path) -> None:
    run = tmp_path / "run"
    advsearch.attack(scene, victim(0.9), run=run, **{**SMALL, "steps": 1})
    before = (run / "summary.json").read_bytes()
    with pytest.raises(InputError):
        advsearch.attack(scene, victim(0.9), label="teapot", run=run, overwrite=True, **SMALL)
    assert (run / "summary.json").read_bytes() == before
