"""`harden` as a whole: a small network, pictures of 32 x 32, and a stand-in for the attacks of the measurement."""

import json
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

import advsearch
from advsearch.engine.loading import Scene
from advsearch.models import Model
from advsearch.models.reference import load
from advsearch.questions.attack.settings import AttackConfig
from advsearch.questions.harden import harden as asked
from advsearch.questions.harden import scenes as harden_scenes
from advsearch.questions.harden import training
from advsearch.questions.harden.networks import Trainable
from advsearch.questions.harden.result import HardenConfig
from advsearch.questions.harden.rounds import Rounds, Score
from advsearch.questions.harden.scenes import SceneJobs
from advsearch.questions.harden.training import ClassifierTrainer
from advsearch.runs.directory import RunDirectory
from advsearch.runs.summary import read_result

pytestmark = [pytest.mark.medium, pytest.mark.island("advsearch.questions.harden")]

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


def test_a_run_trains_measures_and_goes_on(
    attacks: list[tuple[str, int | None]], monkeypatch: pytest.MonkeyPatch
) -> None:
    given = {**SMALL, "labels": "labels.json", "run": "run"}
    config = HardenConfig(**given)
    given.pop("model")
    taught = ClassifierTrainer.train_round

    def stopped(self: Any, number: int, *args: Any, **options: Any) -> None:
        if number == 2:
            raise KeyboardInterrupt
        taught(self, number, *args, **options)

    monkeypatch.setattr(ClassifierTrainer, "train_round", stopped)
    first = asked.run(config)
    assert (first.ending, len(first.rounds), first.after, first.hardened) == ("interrupted", 2, None, None)
    both = [("ball", 40), ("book", 40), ("ball", 120)]  # what was found is not sought any harder
    assert attacks == both
    monkeypatch.setattr(ClassifierTrainer, "train_round", taught)
    result = advsearch.harden(SMALL["model"], resume=True, **given)
    assert attacks[3:] == both
    (row,) = result.table
    assert row.stronger_before is not None and (row.stronger_before.right, row.stronger.right) == (1, 1)
    assert result.rounds[:2] == [one.model_copy(update={"is_selected": result.rounds[k].is_selected}) for k, one in
                                 enumerate(first.rounds)]  # fmt: skip
    assert [one.lessons for one in result.rounds] == [0, 3, 6] and sum(one.is_selected for one in result.rounds) == 1
    assert result.before is not None and (result.before.right, result.before.count) == (1, 2)
    assert result.clean_after is not None and result.clean_after.count == 4
    assert read_result(Path("runs/run")) == result
    held = result.split["held out"]
    assert not set(held.environments) & set(result.split["training"].environments)
    assert result.hardened == f"small_models:Colours@{result.weights}"
    assert advsearch.load_model(result.hardened, input_size=32).classes == 14
    assert len(list(Path(str(result.pictures)).glob("*/*.png"))) == 2 * (2 + 1 + 1)


def course_of(config: HardenConfig, net: torch.nn.Module | None = None) -> ClassifierTrainer:
    """The training of a small network in the place of the reference model."""
    work = SceneJobs(config, load(), harden_scenes.make_splits(config, load()))
    return ClassifierTrainer(work, Trainable(net or torch.nn.Linear(2, 3), load()))


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

    monkeypatch.setattr(ClassifierTrainer, "evaluate_student", judged)
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
