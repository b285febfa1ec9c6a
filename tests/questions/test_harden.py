"""`harden` as a whole: a small network, pictures of 32 x 32, and a stand-in for the attacks of the measurement."""

from __future__ import annotations

import json
import shutil
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from safetensors import torch as safetensors

import advsearch
from advsearch.attacks import make_policy
from advsearch.cli.main import main
from advsearch.cli.output import format_result as text_of
from advsearch.engine.loading import Scene
from advsearch.engine.surface_light import find_surface_light_refusal
from advsearch.errors import InputError, ModelError
from advsearch.experiment import Experiment
from advsearch.models import Model
from advsearch.models.reference import load
from advsearch.progress import NullProgress
from advsearch.questions.attack.carry_out import make_problem_on, open_executor
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.harden import carry_out as hardening
from advsearch.questions.harden import harden as asked
from advsearch.questions.harden import scenes as harden_scenes
from advsearch.questions.harden import training
from advsearch.questions.harden.lessons import Lesson, RenderedLesson, TextureLesson
from advsearch.questions.harden.networks import Trainable
from advsearch.questions.harden.result import QUICK, HardenConfig
from advsearch.questions.harden.rounds import ROUNDS_NOTE, Rounds, Score
from advsearch.questions.harden.scenes import FURTHER, TRAINING, VALIDATION, Job, SceneJobs
from advsearch.questions.harden.training import ClassifierTrainer
from advsearch.runs.directory import RunDirectory
from advsearch.runs.summary import read_result

SMALL: dict[str, Any] = {
    "object": "ball,book", "model": "small_models:Colours", "resolution": 32, "texture_resolution": 16, "epsilon": 0.03,
    "rounds": 2, "scenes": 1, "views": 1, "epochs": 1, "measured": 2, "threads": 1,
}  # fmt: skip


@pytest.fixture
def attacks(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[tuple[str, int | None]]:
    """Objects and steps of the attacks of a measurement; their stand-in finds an answer for books."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "labels.json").write_text(json.dumps(list(load().labels)))
    done: list[tuple[str, int | None]] = []

    def attacked(config: AttackConfig, scene: Scene, model: Model) -> str:
        done.append((config.object, config.steps))
        return "found" if config.object == "book" else "robust"

    monkeypatch.setattr(harden_scenes, "attack_scene", attacked)
    monkeypatch.setattr(harden_scenes, "CLEAN_SCENES", 1)
    monkeypatch.setattr(training, "PLAIN_SCENES", 1)
    monkeypatch.setattr(training, "RENDERED_SCENES", 2)
    return done


@pytest.mark.medium
def test_a_run_trains_measures_and_goes_on(
    attacks: list[tuple[str, int | None]], monkeypatch: pytest.MonkeyPatch
) -> None:
    given = {**SMALL, "labels": "labels.json", "run": "run"}
    config = HardenConfig(**given)
    given.pop("model")
    taught = ClassifierTrainer.round

    def stopped(self: Any, number: int, *args: Any, **options: Any) -> None:
        if number == 2:
            raise KeyboardInterrupt
        taught(self, number, *args, **options)

    monkeypatch.setattr(ClassifierTrainer, "round", stopped)
    first = asked.run(config)
    assert (first.ending, len(first.rounds), first.after, first.hardened) == ("interrupted", 2, None, None)
    both = [("ball", 40), ("book", 40), ("ball", 120)]  # what was found is not sought any harder
    assert attacks == both
    monkeypatch.setattr(ClassifierTrainer, "round", taught)
    with pytest.raises(InputError, match="cannot resume: it began without `beside`, which only Python gives"):
        advsearch.harden(SMALL["model"], beside=[], resume=True, **given)
    result = advsearch.harden(SMALL["model"], resume=True, **given)
    assert attacks[3:] == both
    (row,) = result.table
    assert row.stronger_before is not None and (row.stronger_before.right, row.stronger.right) == (1, 1)
    assert result.rounds[:2] == [one.model_copy(update={"kept": result.rounds[k].kept}) for k, one in
                                 enumerate(first.rounds)]  # fmt: skip
    assert [one.lessons for one in result.rounds] == [0, 3, 6] and sum(one.kept for one in result.rounds) == 1
    assert result.before is not None and (result.before.right, result.before.count) == (1, 2)
    assert result.clean_after is not None and result.clean_after.count == 4
    assert read_result(Path("runs/run")) == result
    held = result.split["held out"]
    assert not set(held.environments) & set(result.split["training"].environments)
    assert result.hardened == f"small_models:Colours@{result.weights}"
    assert advsearch.load_model(result.hardened, input_size=32).classes == 14
    assert len(list(Path(str(result.pictures)).glob("*/*.png"))) == 2 * (2 + 1 + 1)
    assert "robust to texture" in text_of(result)
    page = Path("runs/run/report.html").read_text("utf-8")
    assert (
        "Of 2 held-out scenes the searches leave 1 right, before 1;" in page
        and "<svg" in page
        and Path("runs/run/images/harden.png").is_file()
    )


def drawing(number: int, control: str, plain: int = 0, beside: tuple[str, ...] = ()) -> Job:
    how: dict[str, Any] = {"controls": (control,), "views": 1, "plain": plain, "varying_controls": beside}
    return partial(SceneJobs.sample_lessons, split=TRAINING, number=number, **how)


def course_of(config: HardenConfig, net: torch.nn.Module | None = None) -> ClassifierTrainer:
    """The training of a small network in the place of the reference model."""
    work = SceneJobs(config, load(), harden_scenes.make_splits(config, load()))
    return ClassifierTrainer(work, Trainable(net or torch.nn.Linear(2, 3), load()))


@pytest.mark.medium
def test_what_is_rendered_is_searched_together_and_in_further_scenes_too(attacks: list[tuple[str, int | None]]) -> None:
    config = HardenConfig(**{**SMALL, "controls": "texture,pose,light", "labels": "labels.json"})
    course = course_of(config)
    found = course.sample_items("scenes", TRAINING, range(1))
    held_back = course.sample_items("scenes", VALIDATION, range(1))
    with RunDirectory.create_for(config) as run:
        counts = hardening.Hardening(run, course).n_scenes
    assert counts[FURTHER] == 2 * counts[TRAINING]
    assert [type(one) for one in held_back] == [TextureLesson] * 2 + [Lesson] + [RenderedLesson] * 2
    rendered = [RenderedLesson, Lesson, RenderedLesson, RenderedLesson]  # one scene as it is, too
    assert [type(one) for one in found] == [TextureLesson, Lesson, *rendered]
    tries = [len(one.images) for one in [*found, *held_back] if isinstance(one, RenderedLesson)]
    assert tries == [1] * 3 + [harden_scenes.N_VALIDATION_TRIES] * 2
    shutil.rmtree(run.path)


@pytest.mark.medium
def test_in_half_of_the_scenes_with_a_texture_what_is_rendered_varies_too(
    attacks: list[tuple[str, int | None]],
) -> None:
    config = HardenConfig(**{**SMALL, "controls": "texture,pose,haze", "labels": "labels.json"})
    course = course_of(config)
    assert course.work.random_controls == ("pose",)  # no matrix says what haze does
    drawn = [course.sample_scene_options("texture", number) for number in range(400)]
    for share, which in ((training.SHARED_TEXTURE_PROBABILITY, 0), (training.RANDOM_CONTROLS_PROBABILITY, 1)):
        for part in (drawn[::2], drawn[1::2]):  # objects take turns, and each has as many
            assert abs(sum(one[which] for one in part) / 200 - share) < 0.08
    seen = course.work([drawing(0, "texture", beside=beside) for beside in ((), ("pose",))])
    one, other = (some[0] for some in seen)
    assert isinstance(one, TextureLesson) and isinstance(other, TextureLesson)
    assert len(other.conditions) == len(one.conditions) + 6 and not torch.equal(one.plain_image, other.plain_image)


@pytest.mark.medium
def test_a_measurement_over_viewpoints_may_be_predicted() -> None:
    """Its searches are those of `attack`; a quick one looks at too few pictures."""
    config = HardenConfig(**{**SMALL, "object": "mug", "model": "reference", "controls": "camera", "epsilon": None})
    work = SceneJobs(config, load(), harden_scenes.make_splits(config, load()))
    name, scene = work.splits["held out"].load_scene(0)
    problem = make_problem_on(work.make_attack_config(("camera",), name), scene, work.model)
    against = [
        find_surface_light_refusal(problem, steps, make_policy("auto"), True)
        for steps in (config.steps, QUICK["steps"])
    ]
    assert against[0] is None and str(against[1]) == "light on surfaces pays from 32 pictures on"


@pytest.mark.slow
def test_workers_do_what_this_process_does(attacks: list[tuple[str, int | None]]) -> None:
    config = HardenConfig(**{**SMALL, "model": "reference", "controls": "texture,pose", "epsilon": {"texture": 0.03}})
    state = load().copy_network().state_dict()  # channels last, which safetensors refuses
    weights = safetensors.save({name: one.contiguous() for name, one in state.items()})
    looking = partial(SceneJobs.evaluate_plain_images, number=0, weights=weights)
    wanted = [drawing(1, "texture", plain=1), drawing(0, "pose"), looking]
    here = SceneJobs(config, load(), harden_scenes.make_splits(config, load()))(wanted)
    shared = config.model_copy(update={"workers": 1})
    with open_executor(shared, "advsearch.questions.harden.scenes:load_scene_work", NullProgress()) as pool:
        assert pool is not None
        there = {wanted.index(done.items[0]): done.value[0] for done in pool.compute([one] for one in wanted)}
    assert there.pop(2) == here.pop() == {"before": [True] * 2, "after": [True] * 2}
    for place, lessons in enumerate(here):
        assert isinstance(lessons, list) and len(lessons) == len(there[place])
        for one, other in zip(lessons, there[place], strict=True):
            assert type(one) is type(other) and torch.equal(one.plain, other.plain)
            if isinstance(one, TextureLesson) and isinstance(other, TextureLesson):
                torch.testing.assert_close(one.compute_image(one.texture), other.compute_image(other.texture))


@pytest.mark.medium
def test_the_weights_that_are_kept_are_within_the_clean_loss(attacks: list[tuple[str, int | None]]) -> None:
    config = HardenConfig(**SMALL, labels="labels.json")
    rows = [(0.9, 0.2), (0.89, 0.5), (0.87, 0.8), (0.885, 0.5)]
    with RunDirectory.create_for(config) as run:
        noted = [{"lessons": 1, "part": 1.0, "clean": clean, "robust": robust, "kept": False} for clean, robust in rows]
        run.store.write_note(ROUNDS_NOTE, json.dumps(noted))
        for loss, best in ((0.02, 3), (0.05, 2), (0.0, 0)):
            course = course_of(config.model_copy(update={"clean_loss": loss}))
            assert Rounds(run, course).best == best
    shutil.rmtree(run.path)


@pytest.mark.medium
def test_a_round_ends_with_the_part_of_the_way_that_is_best(
    attacks: list[tuple[str, int | None]], monkeypatch: pytest.MonkeyPatch
) -> None:
    config = HardenConfig(**SMALL, labels="labels.json")
    net = torch.nn.Linear(2, 3)
    given = {name: one.clone() for name, one in net.state_dict().items()}

    judged_at = list[float]()

    def judged(self: ClassifierTrainer, held_back: Any) -> Score:
        part = float(net.weight.detach()[0, 0] - given["weight"][0, 0])
        judged_at.append(part)
        return Score(1.0 - 0.1 * part, 0.5 + 0.2 * part)

    monkeypatch.setattr(ClassifierTrainer, "score", judged)
    with RunDirectory.create_for(config) as run:
        Rounds(run, course_of(config, net)).store_round(0, [], Score(1.0, 0.5), 0, 0.0)
        for loss, expected, looked_at in ((0.05, 0.4, 6), (0.2, 1.0, 2), (0.001, 0.25, 6)):
            judged_at.clear()
            net.load_state_dict({name: one + 1.0 for name, one in given.items()})
            rounds = Rounds(run, course_of(config.model_copy(update={"clean_loss": loss}), net))
            advanced = list[int]()
            watcher: Any = SimpleNamespace(advance=lambda n, worst, told=advanced: told.append(n))
            rounds.progress = watcher
            found, part = rounds.select_interpolation([])
            assert sum(advanced) == looked_at, "whoever watches sees each part of the way"
            assert part == expected and found.robust == pytest.approx(0.5 + 0.2 * part)
            assert len(judged_at) == looked_at, "less than the best part is looked at once"
            torch.testing.assert_close(net.bias.detach(), given["bias"] + part)
    shutil.rmtree(run.path)


def test_quick_is_less_of_what_nothing_is_said_of() -> None:
    quick = HardenConfig(quick=True, measured=3)
    assert quick.measured == 3 and quick.rounds == QUICK["rounds"] and quick.steps == QUICK["steps"]
    assert HardenConfig().rounds > quick.rounds


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"object": "x.glb"}, "held_out: x.glb has no other instances"),
        ({"environment": "noon,studio", "held_out_environment": "studio"}, "held_out_environment: studio is an env"),
        ({"epsilon": 0.1, "controls": "pose"}, "the control has ranges and no epsilon"),
        ({"task": "depth"}, "task: harden trains for classification, detection and segmentation"),
    ],
)
def test_what_cannot_be_hardened_is_refused_in_words(
    attacks: list[tuple[str, int | None]], given: dict[str, Any], text: str
) -> None:
    with pytest.raises(InputError, match=text):
        asked.run(HardenConfig(**{**SMALL, "labels": "labels.json", **given}))
    assert not list(Path("runs").glob("*/*"))


@pytest.mark.medium
def test_the_command_asks_what_its_flags_say(monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    given: list[HardenConfig] = []

    def noted(config: HardenConfig, **others: Any) -> Any:
        given.append(config)
        raise InputError("stop here")

    monkeypatch.setattr(Experiment, "run", lambda self, config, **others: noted(config))
    flags = "harden --model reference --control texture --epsilon 0.03 --quick --held-out a.glb --json"
    assert main(flags.split()) == 2 and "stop here" in capsys.readouterr().err
    assert given == [HardenConfig(controls={"texture": {}}, epsilon=0.03, quick=True, held_out="a.glb")]


def test_a_detector_is_refused_in_words_that_harden_can_follow(tmp_path: Path) -> None:
    class Boxes(torch.nn.Module):
        def forward(self, x: torch.Tensor) -> Any:
            return x.new_zeros(len(x), 3, 4), x.new_zeros(len(x), 3, 2)

    with pytest.raises(ModelError, match="what a detector gives; harden trains classifiers"):
        advsearch.harden(Boxes(), object="mug", run=tmp_path / "run")
