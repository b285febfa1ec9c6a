"""Answers in one tensor, as YOLO's networks give them: a box for each place of a grid, and a score of every class.

Such an answer is (A, B) for each picture. Either its columns are places and its rows are numbers ("channels first", v8
to v12 and YOLO11), or the other way round ("channels last", v5 to v7, YOLOX, RT-DETR). The numbers of a place are a box
(by its middle, width and height), in the older ones objectness, with which scores are multiplied, and a score of each
class; those of segmentation have mask coefficients after these, as many as the prototypes have channels.
"""

from __future__ import annotations

import re
from collections.abc import Collection

import torch
from torch import Tensor

from advsearch.models.labels import sets_of

HEADS = {"boxes scores": 4, "boxes objectness scores": 5}
"""What the numbers of a place are, and how many stand before the scores."""

LAYOUTS = ("channels first", "channels last")

TOLERANCE = 1e-3
"""How far outside [0, 1] a score may lie."""

_ORDER = re.compile(rf"({'|'.join(HEADS)})(?: ({'|'.join(LAYOUTS)}))?")


def names_head(order: str) -> bool:
    """Whether an order is one of `HEADS`, with one of `LAYOUTS` after it or without."""
    return _ORDER.fullmatch(order) is not None


def head_in(answer: Tensor, beside: Collection[int], classes: int, order: str = "") -> tuple[str, ...]:
    """Return the orders that an answer (A, B) to one picture may have, such as "boxes scores channels first".

    Sides tell, and scores, which lie in [0, 1].

    Args:
        answer: numbers of places.
        beside: how many channels the maps have that came with it.
        classes: that there are.
        order: what is said of it already; "" for nothing.

    Raises:
        ValueError: it has none of them; the text says what it seems to be.
    """
    found, outside = list[str](), ""
    for layout, length in zip(LAYOUTS, answer.shape, strict=True):
        for head, start in HEADS.items():
            name, masks = f"{head} {layout}", length - start - classes
            if order not in ("", head, name) or (masks and masks not in beside):
                continue
            scores = split(answer, classes, name, multiplied=False)[1].detach()
            far = (scores < -TOLERANCE) | (scores > 1.0 + TOLERANCE)
            if not bool((far & scores.isfinite()).any()):
                found.append(name)
            elif name == _WITH_ANGLE and not bool(far[:, :-1].any()):
                outside = f"an angle after the scores, as OBB heads have it, {_UNREAD}"
            else:
                outside = outside or (
                    f"scores from {float(scores.min()):.3g} to {float(scores.max()):.3g} if it is read as '{name}'; "
                    "expected probabilities in [0, 1]: apply a sigmoid to them"
                )
    if found == [_WITH_ANGLE] and not order:
        raise ValueError(
            f"its {5 + classes} channels may be those of an OBB head (with an angle), {_UNREAD}; if it has "
            f"objectness, say `task='detection={{order: {_WITH_ANGLE}}}'`"
        )
    if outside and not found:
        raise ValueError(f"it has {outside}")
    if not found:
        raise ValueError(_unfitting(answer, classes))
    return tuple(found)


_WITH_ANGLE = f"boxes objectness scores {LAYOUTS[0]}"
"""What a head of oriented boxes looks like: an angle after the scores makes as many numbers as objectness before."""

_UNREAD = "which are not read"


def _unfitting(answer: Tensor, classes: int) -> str:
    """What an answer is that has not as many numbers as the classes ask for."""
    length, last = min(answer.shape), answer.shape[0] >= answer.shape[1]
    over = {length - 4 - classes, length - 6 if last else 0}
    of = f"{classes} class{'es' * (classes > 1)}"
    said = f"expected 4 + {classes} or 5 + {classes} numbers of a box for {of}, got {length}"
    named = [name for start in HEADS.values() for name in sets_of(length - start)]
    if named:
        return f"{said}; {' or '.join(f'`labels={name}`' for name in named)} would fit"
    if 1 in over:
        return f"{said}, as OBB heads (oriented boxes, with an angle) have it, {_UNREAD}"
    if 32 in over:
        return f"{said}, as with mask coefficients, and no prototypes (N, 32, h, w) came beside them"
    if any(one > 0 and one % 3 == 0 for one in over):
        return f"{said}, as pose heads (with keypoints) have it, {_UNREAD}; or give the `labels` of the model's classes"
    return f"{said}; give the `labels` of the model's classes"


def split(answer: Tensor, classes: int, order: str, *, multiplied: bool = True) -> tuple[Tensor, Tensor]:
    """Return the boxes (D, 4) and scores (D, classes) of an answer to one picture; differentiable.

    Args:
        answer: (A, B).
        classes: that there are.
        order: with its layout.
        multiplied: whether objectness is multiplied with the scores; otherwise it is the first of (D, 1 + classes).
    """
    places = answer.T if order.endswith(LAYOUTS[0]) else answer
    scores = places[:, 4 : 4 + classes]
    if order.startswith("boxes objectness"):
        objectness, scores = places[:, 4:5], places[:, 5 : 5 + classes]
        scores = objectness * scores if multiplied else torch.cat([objectness, scores], dim=1)
    return places[:, :4], scores
