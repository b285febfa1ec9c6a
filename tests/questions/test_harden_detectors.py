"""Hardening detectors: what their training sees, whose loss it descends, and a run as a whole on a small network."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

import advsearch
from advsearch.errors import FileFormatError, InputError, ModelError
from advsearch.questions.harden.detectors import DetectorTrainer, Example, compute_network_loss, read_coco
from advsearch.questions.harden.networks import make_trainable
from advsearch.questions.harden.result import HardenConfig
from advsearch.questions.harden.scenes import SceneJobs
from advsearch.runs.files import write_png
from advsearch.tasks import make_task
from advsearch.tasks.boxes import DetectionTruth

pytestmark = [pytest.mark.usefixtures("two_threads"), pytest.mark.island("advsearch.questions.harden")]

SIDE, LABELS = 24, ("mug", "ball")
TASK = {"name": "detection", "unit": "fractions"}


class OneBox(nn.Module):
    """One box with a score for each class, by the means of 36 squares; in training the loss of both."""

    def __init__(self) -> None:
        super().__init__()
        self.args = {"imgsz": SIDE}
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(1)
            self.norm, self.last = nn.BatchNorm1d(108), nn.Linear(108, 4 + len(LABELS))

    def forward(self, x: Tensor, targets: Sequence[Mapping[str, Tensor]] | None = None) -> Any:
        found = self.last(self.norm(F.adaptive_avg_pool2d(x, 6).flatten(1)))
        middle, half = found[:, :2].sigmoid(), found[:, 2:4].sigmoid() / 2
        boxes = torch.cat([middle - half, middle + half], dim=1)
        if targets is None:
            return boxes[:, None], found[:, None, 4:].sigmoid()
        wanted = torch.stack([one["boxes"][0] / SIDE for one in targets])
        labels = torch.cat([one["labels"][:1] for one in targets])
        return {"boxes": F.l1_loss(boxes, wanted), "scores": F.cross_entropy(found[:, 4:], labels)}


def model() -> advsearch.Model:
    return advsearch.load_model(OneBox(), task=TASK, labels=LABELS, input_size=SIDE, name="one box")


def course_of(loss: Any = None, **settings: Any) -> DetectorTrainer:
    work = SceneJobs(HardenConfig(task=TASK, **settings), model(), {})
    return DetectorTrainer(work, make_trainable(work.model, logits=False), loss=loss)


def example(seed: int) -> Example:
    """A square on grey, red or green by its class, in a picture twice as large as the network's input."""
    rng = np.random.default_rng(seed)
    left, top, label = int(rng.integers(4, 20)), int(rng.integers(4, 20)), seed % 2
    levels = torch.full((48, 48, 3), 90, dtype=torch.uint8)
    levels[top : top + 20, left : left + 20, label] = 240
    box = (left, top, left + 20, top + 20)
    task = make_task(TASK).on(model())
    boxes, labels = torch.tensor([box], dtype=torch.float32), torch.tensor([label])
    return Example(levels, boxes, labels, task, DetectionTruth((label,), box, (48, 48)))


@pytest.mark.medium
def test_a_copy_learns_by_the_networks_own_loss_and_keeps_its_statistics() -> None:
    course, seen = course_of(epochs=60, rate=0.02), [example(k) for k in range(24)]
    course.train_round(1, seen)
    models, held_out = (course.scene_jobs.model, course.student.model), [example(k) for k in range(100, 112)]
    before, after = ([one.is_right(which) for one in held_out] for which in models)
    assert sum(before) <= 3 and sum(after) >= 9
    network = course.student.network
    assert isinstance(network, OneBox) and not network.norm.running_mean.any()  # type: ignore[union-attr]


def test_losses_are_torchvisions_transformers_or_the_callers() -> None:
    x, target = (
        torch.zeros((1, 3, 20, 40)),
        [{"boxes": torch.tensor([[10.0, 5.0, 30.0, 15.0]]), "labels": torch.tensor([1])}],
    )
    seen: list[Any] = []

    class Inner(nn.Module):
        def forward(self, *args: Any, **named: Any) -> Any:
            seen.append((args, named))
            found = {"classes": torch.tensor(2.0), "boxes": torch.tensor(3.0)}
            return SimpleNamespace(loss=torch.tensor(7.0)) if named else found

    class Wrapped(nn.Module):
        def __init__(self, config: bool) -> None:
            super().__init__()
            self.network = Inner()
            if config:
                vars(self.network)["config"] = SimpleNamespace()

    assert float(compute_network_loss(Wrapped(False), x, target)) == 5.0 and seen[-1][0][1] == target
    assert [tuple(one.shape) for one in seen[-1][0][0]] == [(3, 20, 40)]
    assert float(compute_network_loss(Wrapped(True), x, target)) == 7.0
    (named,) = seen[-1][1]["labels"]
    assert named["boxes"].tolist() == [[0.5, 0.5, 0.5, 0.5]] and named["class_labels"].tolist() == [1]
    with pytest.raises(ModelError, match="returns no loss"):
        compute_network_loss(nn.Flatten(), x, target)
    asked: list[int] = []

    def mine(network: nn.Module, x: Tensor, targets: Sequence[Mapping[str, Tensor]]) -> Tensor:
        asked.append(len(targets))
        return network(x)[0].sum()  # type: ignore[no-any-return]

    course_of(mine, epochs=1).train_round(1, [example(k) for k in range(3)])
    assert asked == [3]


def coco(folder: Path, **changes: Any) -> Path:
    (folder / "images").mkdir(parents=True)
    write_png(folder / "images" / "a.png", np.full((10, 20, 3), 0.5))
    told = {
        "images": [{"id": 7, "file_name": "a.png", "height": 10, "width": 20}],
        "annotations": [{"id": 1, "image_id": 7, "category_id": 3, "bbox": [2, 1, 5, 4], "iscrowd": 0},
                        {"id": 2, "image_id": 7, "category_id": 9, "bbox": [0, 0, 1, 1], "iscrowd": 0}],
        "categories": [{"id": 3, "name": "ball"}, {"id": 9, "name": "dog"}], **changes,
    }  # fmt: skip
    (folder / "annotations.json").write_text(json.dumps(told))
    return folder


def test_a_coco_folder_is_read_by_the_names_of_its_categories(tmp_path: Path) -> None:
    (one,) = read_coco(coco(tmp_path / "good"), model())
    assert one.boxes.tolist() == [[2.0, 1.0, 7.0, 5.0]] and one.labels.tolist() == [1]
    assert one.image_uint8.shape == (10, 20, 3)
    with pytest.raises(InputError, match="none of its categories"):
        read_coco(coco(tmp_path / "other", categories=[{"id": 3, "name": "cat"}]), model())
    image = {"id": 7, "height": 10, "width": 20}
    for number, name in enumerate(("../secret.png", "/etc/passwd", "none.png")):
        with pytest.raises(FileFormatError):
            read_coco(coco(tmp_path / f"bad{number}", images=[{**image, "file_name": name}]), model())
    linked = coco(tmp_path / "linked", images=[{**image, "file_name": "there/a.png"}])
    (linked / "images" / "there").symlink_to(tmp_path / "good" / "images")
    with pytest.raises(FileFormatError, match="names of files in images/"):
        read_coco(linked, model())
    with pytest.raises(FileFormatError, match="COCO's JSON"):
        read_coco(coco(tmp_path / "size", images=[{**image, "file_name": "a.png", "width": 9}]), model())


@pytest.mark.medium
def test_a_run_trains_on_what_it_found_and_measures_scene_by_scene(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    given: dict[str, Any] = {
        "task": TASK, "labels": ",".join(LABELS), "object": "mug,ball", "controls": {"light": {}}, "resolution": SIDE,
        "rounds": 2, "scenes": 1, "epochs": 2, "measured": 1, "steps": 2, "spp": 1, "verify_spp": 1, "denoise": "none",
        "threads": 1, "run": "run", "environment": "studio", "held_out_environment": "noon",
    }  # fmt: skip
    monkeypatch.setattr("advsearch.questions.harden.scenes.CLEAN_SCENES", 1)
    given["data"], taught = str(coco(tmp_path / "own")), DetectorTrainer.train_round

    def stopped(self: DetectorTrainer, number: int, *args: Any, **options: Any) -> None:
        if number == 2:
            raise KeyboardInterrupt
        taught(self, number, *args, **options)

    monkeypatch.setattr(DetectorTrainer, "train_round", stopped)
    first = advsearch.harden(OneBox(), **given)
    assert first.ending == "interrupted" and first.after is None
    monkeypatch.setattr(DetectorTrainer, "train_round", taught)
    result = advsearch.harden(OneBox(), resume=True, **given)
    assert [one.robust for one in result.rounds[:2]] == [one.robust for one in first.rounds]
    assert result.ending == "done" and result.weights and result.hardened is None
    assert result.before is not None and result.before.count == 1 and result.gained is not None
    assert [one.lessons for one in result.rounds] == [0, 5, 9] and sum(one.is_selected for one in result.rounds) == 1
    kept = json.loads((Path(str(result.pictures)) / "round-001" / "annotations.json").read_text())
    assert [one["file_name"][6:] for one in kept["images"]] == ["plain.png"] * 3 + ["worst.png"]
    assert {one["category_id"] for one in kept["annotations"]} == {0}
    again = read_coco(Path(str(result.pictures)) / "round-001", model())
    assert len(again) == 4, "what it was trained on can be trained on"
