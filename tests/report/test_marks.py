"""Boxes and masks drawn into pictures: where they lie, in which colour, and what stands beside them."""

from types import SimpleNamespace

import numpy as np
import numpy.typing as npt
import pytest
import torch

from advsearch.options import Outcome
from advsearch.report.figures import MIN_IMAGE_SIDE, PREDICTED_COLOR, TINT, TRUE_COLOR, draw_marks
from advsearch.report.wording import format_mistake, format_mistake_participle, format_prediction
from advsearch.tasks import Mark


def where(picture: npt.NDArray[np.float32], colour: tuple[int, int, int]) -> npt.NDArray[np.bool_]:
    near: npt.NDArray[np.bool_] = np.asarray((np.abs(picture - np.array(colour) / 255) < 1 / 255).all(axis=2))
    return near


GREY = np.full((64, 64, 3), 0.5, dtype=np.float32)
"""Magnified by 8."""


def test_a_box_frames_the_pixels_that_it_says() -> None:
    drawn = draw_marks(GREY, [Mark("cup", False, box=(16.0, 24.0, 48.0, 56.0))])
    assert drawn.shape == (MIN_IMAGE_SIDE, MIN_IMAGE_SIDE, 3)
    orange = where(drawn, PREDICTED_COLOR)
    assert orange[192:448, [128, 129, 382, 383]].all() and orange[[192, 193, 446, 447], 128:384].all()
    assert not orange[200:440, 136:376].any() and not orange[450:].any() and not orange[:, 390:].any()
    assert orange[172:192, 128:140].mean() > 0.5, "its text stands above"
    assert not where(drawn, TRUE_COLOR).any()


@pytest.mark.parametrize("box", [(-20.0, -20.0, 90.0, 90.0), (60.0, 60.0, 64.0, 64.0), (5.0, 5.0, 5.0, 5.0)])
def test_what_reaches_out_of_the_picture_is_cut(box: tuple[float, float, float, float]) -> None:
    drawn = draw_marks(GREY, [Mark("a very long name of a thing that is there", True, box=box)])
    assert drawn.shape == (MIN_IMAGE_SIDE, MIN_IMAGE_SIDE, 3) and where(drawn, TRUE_COLOR).any()


def test_a_mask_is_tinted_and_the_true_one_outlined() -> None:
    mask = torch.zeros(32, 32).bool()
    mask[8:24, 8:24] = True
    said = draw_marks(GREY, [Mark("mug", False, mask=mask)])
    tint = (1 - TINT) * 0.5 + TINT * np.array(PREDICTED_COLOR) / 255
    assert np.abs(said[140:370, 140:370] - tint).max() < 0.01 and np.abs(said[:120] - 0.5).max() < 0.01
    blue = where(draw_marks(GREY, [Mark("mug", True, mask=mask)]), TRUE_COLOR)
    assert blue[128:384, 128].all() and blue[383, 128:384].all() and not blue[140:370, 140:370].any()
    assert not blue[:128].any(), "the outline is inside"


def said(label: str, probability: float, **payload: object) -> SimpleNamespace:
    """A prediction as a result has it: with what its task keeps beside it."""
    return SimpleNamespace(label=label, index=None, probability=probability, payload=payload)


@pytest.mark.parametrize("payload", [{"outcome": "loose", "iou": "x"}, {"outcome": ["loose"]}, {"outcome": "missed"}])
def test_a_payload_of_a_stranger_is_no_error(payload: dict[str, object]) -> None:
    assert format_prediction("detection", said("cup", 0.5, **payload)).startswith("cup")


@pytest.mark.parametrize(
    ("task", "label", "outcome", "does", "doing"),
    [
        ("detection", "no cup", "missed", "finds no cup", "finding no cup"),
        ("detection", "dog elsewhere", "phantom", "sees a dog elsewhere, and none where this mug is",
         "seeing a dog elsewhere, and none where it is"),
    ],
)  # fmt: skip
def test_what_a_detector_does_follows_its_outcome(task: str, label: str, outcome: str, does: str, doing: str) -> None:
    became = Outcome(outcome)
    assert (format_mistake(task, "this mug", label, became), format_mistake_participle(task, label, became)) == (
        does,
        doing,
    )
