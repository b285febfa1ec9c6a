"""Hardening segmenters: what their training sees, whose loss it descends, and a run as a whole on a small network."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor, nn

import advsearch
from advsearch.errors import InputError
from advsearch.questions.harden.detectors import Example, SegmenterTrainer, compute_pixel_loss
from advsearch.questions.harden.networks import make_trainable
from advsearch.questions.harden.result import HardenConfig
from advsearch.questions.harden.scenes import SceneJobs
from advsearch.tasks import make_task
from advsearch.tasks.segmentation import Segmentation, SegmentationTruth

pytestmark = [
    pytest.mark.usefixtures("two_threads"),
    pytest.mark.island("advsearch.questions.harden", "advsearch.tasks.segmentation"),
]

SIDE, LABELS = 16, ("background", "mug", "ball")


class ByColour(nn.Module):
    """The class of each pixel by its own colour: background everywhere, until it has learned."""

    def __init__(self) -> None:
        super().__init__()
        self.args = {"imgsz": SIDE}
        self.last = nn.Conv2d(3, len(LABELS), 1)
        with torch.no_grad():
            self.last.weight.copy_(torch.linspace(-0.02, 0.02, 9).reshape(3, 3, 1, 1))
            self.last.bias.copy_(torch.tensor([2.0, 0.0, 0.0]))  # type: ignore[union-attr]

    def forward(self, x: Tensor) -> dict[str, Tensor]:
        return {"out": self.last(x)}


def model() -> advsearch.Model:
    return advsearch.load_model(ByColour(), task="segmentation", labels=LABELS, input_size=SIDE, name="by colour")


def course_of(loss: Any = None, **settings: Any) -> SegmenterTrainer:
    work = SceneJobs(HardenConfig(task="segmentation", **settings), model(), {})
    return SegmenterTrainer(work, make_trainable(work.model, logits=False), loss=loss)


def example(label: int, left: int) -> Example:
    """A square on grey, red or green by its class."""
    levels = torch.full((SIDE, SIDE, 3), 90, dtype=torch.uint8)
    levels[4:9, left : left + 5, label - 1] = 240
    mask = torch.zeros((SIDE, SIDE), dtype=torch.bool)
    mask[4:9, left : left + 5] = True
    task = make_task("segmentation").on(model())
    return Example(levels, torch.zeros((0, 4)), torch.zeros(0), task, SegmentationTruth((label,), mask))


@pytest.mark.medium
def test_a_copy_learns_the_objects_pixels_and_leaves_the_others_as_they_were() -> None:
    course, seen = course_of(epochs=80, rate=0.1), [example(1 + k % 2, k) for k in range(8)]
    course.train_round(1, seen)
    held_out = [example(1, 10), example(2, 9)]
    assert [one.is_right(course.scene_jobs.model) for one in held_out] == [False, False]
    assert [one.is_right(course.student.model) for one in held_out] == [True, True]
    for one in held_out:
        said = course.student.model(one.image_uint8[None] / 255.0)[0].argmax(dim=0)
        region: Any = one.truth
        assert (said[~region.mask] == 0).all()


def test_the_loss_is_transformers_or_the_callers_or_that_of_the_pixels() -> None:
    task: Any = make_task("segmentation")
    assert isinstance(task, Segmentation)
    classes = torch.zeros((1, 4, 4), dtype=torch.int64)
    target = [{"classes": classes[0], "object": torch.zeros((4, 4), dtype=torch.bool)}]
    seen: list[Any] = []

    class Published(nn.Module):
        def forward(self, **named: Any) -> Any:
            seen.append(named)
            return SimpleNamespace(loss=torch.tensor(7.0))

    published = Published()
    vars(published)["config"] = SimpleNamespace()
    assert float(compute_pixel_loss(task, published, torch.zeros(1, 3, 4, 4), target)) == 7.0
    assert (seen[0]["labels"] == classes).all()
    expected = 0.5 * -float(torch.log_softmax(torch.tensor([2.0, 0.0, 0.0]), 0)[0])
    given = compute_pixel_loss(task, ByColour(), torch.zeros(1, 3, 4, 4), target)
    assert given.item() == pytest.approx(expected)
    own = course_of(loss=lambda network, x, targets: torch.tensor(1.0))
    assert own.loss(own.student.network, torch.zeros(1), target) == 1.0


@pytest.mark.medium
def test_a_segmenter_is_hardened_as_a_whole(tmp_path: Path) -> None:
    found = advsearch.harden(
        model(), task="segmentation", object="mug", controls="light", scenes=1,
        rounds=1, epochs=2, measured=2, steps=2, verify_spp=2, trials=6, run=tmp_path / "run",
    )  # fmt: skip
    assert found.task == "segmentation" and found.before is not None and found.after is not None
    pictures = sorted(one.name for one in (tmp_path / "run" / "artifacts" / "pictures").rglob("*.png"))
    assert "00001-plain.png" in pictures and "00001-plain-mask.png" in pictures
    with pytest.raises(InputError, match="data"):
        advsearch.harden(model(), task="segmentation", data=str(tmp_path), run=tmp_path / "other")
