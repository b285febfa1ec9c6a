"""Free answers: what counts as right, and the margin beside it."""

import math
from collections.abc import Sequence

import pytest
import torch
from torch import Tensor, nn

import advsearch
from advsearch.tasks import Facts, Prediction, make_task
from advsearch.tasks.answers import AnswerWithLogits, FreeAnswer, has_word

pytestmark = pytest.mark.island("advsearch.tasks.answers")

VOCABULARY = ("a", "mug", "cup", "bowl", ".")


def begins(word: str) -> Sequence[int]:
    return [number for number, known in enumerate(VOCABULARY) if known == word]


def said(text: str, logits: Tensor) -> AnswerWithLogits:
    return {"text": text, "logits": logits, "begins": begins}


class Speaker(nn.Module):
    """Says "mug ." of a picture that is bright, and "bowl ." of a dark one."""

    def forward(self, images: Tensor) -> list[AnswerWithLogits]:
        bright = images.mean(dim=(1, 2, 3)) - 0.5
        found = []
        for one in bright:
            steps = torch.zeros(2, len(VOCABULARY))
            steps = torch.stack([steps[0] + torch.stack([one * 0, one, one * 0, -one, one * 0 - 1.0]), steps[1]])
            found.append(said("A mug." if float(one.detach()) > 0 else "A bowl.", steps))
        return found


@pytest.mark.parametrize(
    ("text", "right"),
    [
        ("A white Mug on a table.", True), ("a coffee  mug", True), ("mug-like", True), ("smug", False),
        ("two mugs", False), ("", False), ("yes", False),
    ],
)  # fmt: skip
def test_right_is_a_whole_word(text: str, right: bool) -> None:
    assert has_word(text, ("mug", "coffee mug")) is right


def test_the_text_alone_says_what_is_right() -> None:
    """The margin is log(1 - p) of a right answer and -log(p) of a wrong one, and moves one way with the logits."""
    task = FreeAnswer()
    logits = torch.tensor([[0.0, 1.5, 0.5, 1.0, -1.0], [2.0, 0.0, 0.0, 0.0, 0.0]])  # cup: -1 at first, -2 then
    near = torch.sigmoid(torch.tensor(-1.0))
    right, wrong = task.loss([said("cup", logits), said("bowl", logits)], ("cup",))
    assert float(right) == pytest.approx(float(torch.log(1 - near)))
    assert float(wrong) == pytest.approx(float(-torch.log(near)))
    leaf = logits.clone().requires_grad_()
    for text in ("cup", "bowl"):
        (gradient,) = torch.autograd.grad(task.loss([said(text, leaf)], ("cup",)).sum(), leaf)
        assert gradient[0, 2] < 0 < gradient[0, 1] and not gradient[1].any()
    first, second = task.judge([said("cup", logits), said(" \n", logits)], ("cup",))
    assert first.right and not first.success and second.success and not second.right
    assert (first.prediction.label, second.prediction.label) == ("cup", "(nothing)")
    assert task.predictions([said("a\n\x1b[2J cup", logits)]) == [(Prediction("a [2J cup"),)]
    assert task.judge([said("cup", logits * math.nan)], ("cup",))[0].is_non_finite


@pytest.mark.medium
def test_a_target_is_a_word_that_is_said() -> None:
    model = advsearch.load_model(Speaker(), task="answer", input_size=8)
    task = make_task("answer").on(model, target="Bowl")
    assert task.truth(Facts("mug", label="mug, Cup")) == ("mug", "cup")
    bright, dark = (task.judge(model(torch.full((8, 8, 3), level)), ("mug",))[0] for level in (0.9, 0.1))
    assert (bright.success, dark.success) == (False, True)
    assert make_task("answer").on(model, minimise=True).judge(model(torch.full((8, 8, 3), 0.9)), ("mug",))[0].success
