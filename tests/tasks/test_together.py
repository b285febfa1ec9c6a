"""Two tasks at once, with a model each: one answer against both."""

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

import advsearch
from advsearch.engine.judging import make_objective
from advsearch.models import Model
from advsearch.questions.attack.settings import AttackConfig
from advsearch.runs.files import read_png
from advsearch.runs.store import Store
from advsearch.tasks import Detection, Facts, Sight, Task, make_task
from advsearch.tasks.depth import AS_BACKGROUND, AS_FAR, DISPARITY, Depth
from advsearch.tasks.segmentation import Segmentation
from advsearch.tasks.together import EnsembleTask, join_models
from small_models import SIDE, Finder, Painter, Ranger, answer, save_exported

pytestmark = pytest.mark.island("advsearch.tasks.depth", "advsearch.tasks.segmentation")

BOTH = {"name": "detection+depth", "depth": {"kind": DISPARITY}}


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A detector and a network of depth as files, with a comma between them."""
    folder = tmp_path_factory.mktemp("both")
    networks: dict[str, nn.Module] = {"finder": Finder(), "ranger": Ranger()}
    for name, network in networks.items():
        save_exported(network, folder / f"{name}.pt2")
    return ",".join(str(folder / f"{name}.pt2") for name in networks)


@pytest.mark.medium
def test_one_configuration_against_a_detector_and_a_model_of_depth(
    files: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    run = tmp_path / "run"
    found = answer(
        capsys, "attack", "--object", "mug", "--task", f"detection+depth={{kind: {DISPARITY}, seek: gone}}",
        "--model", files, "--labels", "cup,bowl,dog", "--label", "cup", "--epsilon", "0.5", "--steps", "12",
        "--spp", "2", "--verify-spp", "4", "--measure", "no", "--denoise", "none", "--trials", "6", "--no-baseline",
        "--run", str(run), "--json",
    )  # fmt: skip
    assert found["ending"] == "found" and found["objective"] == "each" and found["task"] == "detection+depth"
    assert found["clean"]["label"] == f"cup; {AS_FAR}" and found["verified"]["labels"] == {f"bowl; {AS_BACKGROUND}": 6}
    with Store(run / "results.sqlite", read_only=True) as store:
        payloads: list[Any] = [row.payload for row in store.rows("verification")]
    for one in payloads:
        assert {"bowl"} == {box["label"] for box in one["finder"]["found"] if box["score"] > 0.5}
        assert one["ranger"]["relief"] < 0.5
    drawn = read_png(run / "images" / "clean-prediction.png")
    for colour in ((0, 190, 255), (255, 110, 0)):  # a true box, and the detector's; depth tints
        assert (abs(drawn - torch.tensor(colour).numpy() / 255) < 1 / 255).all(axis=2).sum() > 100


FORMS: list[tuple[Any, Any]] = [
    ("detection+depth", "detection+depth"),
    ("detection={iou: 0.7} + depth", {"name": "detection+depth", "detection": {"iou": 0.7}}),
    (f"detection+depth={{kind: {DISPARITY}}}", BOTH),
    (f"detection+depth={{depth: {{kind: {DISPARITY}}}}}", BOTH),
    (["detection", {"name": "depth", "kind": DISPARITY}], BOTH),
    (BOTH, BOTH),
]


@pytest.mark.parametrize(("asked", "kept"), FORMS)
def test_tasks_are_joined_by_a_plus_or_in_a_list(asked: Any, kept: Any) -> None:
    config = AttackConfig(object="mug", model="a.pt2,b.pt2", task=asked)
    assert config.task == kept and config.models == ("a.pt2,b.pt2",) and not config.is_matrix
    made = make_task(config.task)
    assert isinstance(made, EnsembleTask) and [type(one) for one in made.parts] == [Detection, Depth]


def test_all_models_have_a_derivative() -> None:
    """Of a sum over linear models: the sum of their weights."""
    layers = [nn.Linear(3, 2, bias=False) for _ in range(2)]
    model = join_models(
        [advsearch.load_model(nn.Sequential(nn.Flatten(), one), labels=("a", "b"), input_size=1) for one in layers]
    )
    image = torch.full((1, 1, 3), 0.5, requires_grad=True)
    torch.stack([output.sum() for output in model(image)[0]]).sum().backward()
    weights = torch.stack([layer.weight.detach() for layer in layers])
    torch.testing.assert_close(image.grad, weights.sum(dim=(0, 1))[None, None])


def models(*tasks: tuple[nn.Module, Task, Any]) -> list[Model]:
    return [
        advsearch.load_model(network, input_size=SIDE, task=task, labels=labels, name=type(network).__name__)
        for network, task, labels in tasks
    ]


def test_each_is_judged_by_its_own_rule() -> None:
    """A label goes to the task that takes one, a picture to both; the objective is the least of both."""
    parts = (Segmentation(), Depth(kind=DISPARITY, seek="farther"))
    both = models((Painter(), parts[0], ["background", "mug", "dog"]), (Ranger(), parts[1], None))
    task = EnsembleTask(parts=parts).on(model := join_models(both))
    mask = torch.zeros(SIDE, SIDE).bool()
    mask[8:20, 8:20] = True
    distance = torch.linspace(3.0, 2.0, SIDE)[:, None].expand(SIDE, SIDE) - 0.5 * mask
    facts = Facts("mug", "mug", compute_sight=lambda: Sight(mask, distance, distance))
    task.check(facts)
    truth = task.truth(facts)
    output = model(torch.rand((SIDE, SIDE, 3), generator=torch.Generator().manual_seed(0)))
    task = task.after_calibration(output, truth)
    assert task.calibrates and not task.ambiguity_message and len(task.output_remarks) == 1
    own = list(zip(task.tasks, output[0], truth, strict=True))
    margins = [-float(one.loss(said, true)) for one, said, true in own]
    scores = [float(one.score(said, true)) for one, said, true in own]
    (judged,) = task.judge(output, truth)
    assert judged.margin == min(margins) and judged.score == min(scores) and judged.right is (min(margins) >= 0.0)
    objective, _ = make_objective("each", task, model, None, 0)  # type: ignore[arg-type]
    values = [float(parts[0].pixel_margin(output[0][0], truth[0])), scores[1]]
    assert float(objective(output, torch.zeros(1), truth)) == pytest.approx(min(values))
    assert judged.prediction.label.count(";") == 1 and task.select_facts(task.tasks[1], facts).label is None
