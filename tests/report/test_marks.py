"""Boxes and masks drawn into pictures: where they lie, in which colour, and what stands beside them."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import numpy.typing as npt
import pytest
import torch

from advsearch.options import Outcome
from advsearch.report.figures import MIN_IMAGE_SIDE, PREDICTED_COLOR, TINT, TRUE_COLOR, draw_marks
from advsearch.report.wording import (
    format_goal,
    format_mistake,
    format_mistake_participle,
    format_outcomes,
    format_prediction,
    format_prediction_cells,
    get_margin_meaning,
    get_marks_legend,
    get_only_outcome,
)
from advsearch.tasks import Mark, Prediction


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


def test_maps_stand_beside_the_picture_in_one_range() -> None:
    """That of what is true, which comes first; what is no number is black."""
    true, said = torch.tensor([[0.0, 1.0], [2.0, 4.0]]), torch.tensor([[4.0, 8.0], [-1.0, torch.nan]])
    drawn = draw_marks(GREY, [Mark("near", False, map=said), Mark("near", True, map=true)])
    assert (
        drawn.shape == (MIN_IMAGE_SIDE, 3 * MIN_IMAGE_SIDE, 3)
        and float(np.abs(drawn[:, :MIN_IMAGE_SIDE] - 0.5).max()) < 0.01
    )
    columns = [MIN_IMAGE_SIDE * panel + 192 + 128 * side for panel in (1, 2) for side in (0, 1)]
    assert drawn[192, columns, 0].tolist() == pytest.approx([0.0, 0.25, 1.0, 1.0], abs=0.01)
    assert drawn[320, columns, 0].tolist() == pytest.approx([0.5, 1.0, 0.0, 0.0], abs=0.01)


def test_what_is_true_is_written_below_and_both_can_be_seen() -> None:
    box = (16.0, 24.0, 48.0, 56.0)
    drawn = draw_marks(GREY, [Mark("cup", True, box=box), Mark("cup 0.76", False, box=box)])
    blue, orange = where(drawn, TRUE_COLOR), where(drawn, PREDICTED_COLOR)
    assert blue[450:470, 130:180].mean() > 0.3 and orange[172:192, 128:140].mean() > 0.3


def test_texts_of_boxes_in_one_place_do_not_cover_each_other() -> None:
    box = (16.0, 24.0, 48.0, 56.0)
    both = [Mark("cup 0.76", False, box=box), Mark("bowl 0.54", False, box=box)]
    drawn = draw_marks(GREY, both)
    for alone in (draw_marks(GREY, [one]) for one in both):
        top = int(np.flatnonzero(where(alone, PREDICTED_COLOR)[:, 132])[0])
        text = alone[top:192, 128:180]
        assert any(np.array_equal(drawn[y : y + len(text), 128:180], text) for y in range(230))


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


def test_a_large_picture_keeps_its_size_and_nothing_changes_nothing() -> None:
    large = np.random.default_rng(0).integers(0, 256, (600, 300, 3)).astype(np.float32) / 255
    assert np.abs(draw_marks(large, []) - large).max() < 1e-6


# ---- the same in words ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("task", "answer", "text"),
    [
        ("classification", Prediction("vase", 3, 0.913), "vase, 91 %"),
        ("classification", Prediction("vase", 3, 0.9999999), "vase, over 99.9 %"),
        ("detection", Prediction("cup", 46, 0.762), "cup (score 0.76)"),
        ("detection", Prediction("cup elsewhere", None, 0.7), "cup elsewhere (score 0.70)"),
        ("detection", Prediction("out of view"), "out of view"),
        ("segmentation", Prediction("background", 0, 0.031),
         "accuracy over the object's pixels 3.1 %, most often background"),
        ("yaw", Prediction("30 degrees"), "30 degrees"),
    ],
)  # fmt: skip
def test_an_answer_in_words(task: str, answer: Prediction, text: str) -> None:
    assert format_prediction(task, answer) == text


def said(label: str, probability: float, **payload: object) -> SimpleNamespace:
    """A prediction as a result has it: with what its task keeps beside it."""
    return SimpleNamespace(label=label, index=None, probability=probability, payload=payload)


def test_a_detector_s_prediction_in_words_follows_its_outcome() -> None:
    missed = said("no cup", 0.124, outcome="missed", **{"class": "cup"})
    assert format_prediction("detection", missed) == "no cup found (best score of cup 0.12)"
    assert format_prediction_cells("detection", missed) == ["no cup found", "best score of cup 0.12"]
    loose = said("cup in a loose box", 0.81, outcome="loose", iou=0.431)
    assert format_prediction("detection", loose) == "cup in a loose box (score 0.81, overlap 0.43)"
    none = said("no bottle", 0.02, outcome="missed")
    assert format_prediction("segmentation", none) == "no bottle found, accuracy over the object's pixels 2 %"
    partly = said("bottle in part", 0.31, outcome="loose")
    assert format_prediction("segmentation", partly) == "bottle in part, accuracy over the object's pixels 31 %"


@pytest.mark.parametrize("payload", [{"outcome": "loose", "iou": "x"}, {"outcome": ["loose"]}, {"outcome": "missed"}])
def test_a_payload_of_a_stranger_is_no_error(payload: dict[str, object]) -> None:
    assert format_prediction("detection", said("cup", 0.5, **payload)).startswith("cup")


@pytest.mark.parametrize(
    ("task", "label", "outcome", "does", "doing"),
    [
        ("detection", "no cup", "missed", "finds no cup", "finding no cup"),
        ("detection", "bowl", "wrong class", "takes this mug for a bowl", "taking it for a bowl"),
        ("detection", "cup in a loose box", "loose", "sees this mug, but in a loose box",
         "seeing it, but in a loose box"),
        ("detection", "dog elsewhere", "phantom", "sees a dog elsewhere, and none where this mug is",
         "seeing a dog elsewhere, and none where it is"),
        ("segmentation", "cup in part", "loose", "sees this mug, but only in part", "seeing it, but only in part"),
    ],
)  # fmt: skip
def test_what_a_detector_does_follows_its_outcome(task: str, label: str, outcome: str, does: str, doing: str) -> None:
    became = Outcome(outcome)
    assert (format_mistake(task, "this mug", label, became), format_mistake_participle(task, label, became)) == (
        does,
        doing,
    )


def test_outcomes_are_counted_in_words() -> None:
    counts = {"loose": 4, "missed": 9, "phantom": 1, "wrong class": 2}
    assert format_outcomes(counts, "detection") == "9 missed, 4 in a loose box, 2 of another class, 1 elsewhere"
    assert format_outcomes(counts) == "9 missed, 4 loose, 2 of another class, 1 elsewhere"
    assert format_outcomes({"loose": 4}, "segmentation") == "4 in part"
    assert format_outcomes(None) == "" and format_outcomes({}) == ""
    assert get_only_outcome({"loose": 4}) is Outcome.LOOSE
    assert get_only_outcome(counts) is None and get_only_outcome(None) is None


@pytest.mark.parametrize(
    ("task", "label", "does", "doing"),
    [
        ("classification", "iron", "calls this mug an iron", "calling it an iron"),
        ("detection", "bowl", "takes this mug for a bowl", "taking it for a bowl"),
        ("segmentation", "sofa", "takes this mug for a sofa", "taking it for a sofa"),
        ("segmentation", "background", "takes this mug for background", "taking it for background"),
        ("yaw", "30 degrees", 'predicts "30 degrees" for this mug', 'predicting "30 degrees"'),
    ],
)
def test_what_a_model_does_in_words(task: str, label: str, does: str, doing: str) -> None:
    assert (format_mistake(task, "this mug", label), format_mistake_participle(task, label)) == (does, doing)


def test_margins_and_objectives_in_words() -> None:
    assert (
        len({get_margin_meaning(task) for task in ("classification", "detection", "segmentation", "depth", "yaw")}) == 5
    )
    assert len({get_marks_legend(task) for task in ("detection", "segmentation", "yaw")}) == 3
    assert format_goal("vanish", "this mug") == "makes the model miss this mug"
    assert format_goal("displace", "this mug") == "makes the model see this mug elsewhere or in a loose box"
