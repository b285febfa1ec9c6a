"""What a detector returns: which of its outputs are boxes, scores and classes, and
which rows only fill up.

Detections of one picture are a mapping with `boxes` (D, 4) as they came and `scores`:
(D, C) of every class, or (D,) with `labels` (D,), the class of each box. Where types,
names and shapes leave open which of two numbers of a box is its score and which its
class, these stand as `either` (D, 2) in place of both. One tensor that only the number
of classes explains stands as `raw` (A, B) in place of all, with the channels of maps
that came with it as `beside` (K,), see `boxes`. Logits that only that number explains
stand as `logits` (D, K) in place of scores, see `QUERIES`. Rows that only fill up are
gone; how many of them were NaN throughout is said as `blank` (1,), if any.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

from advsearch.models.labels import sets_of
from advsearch.models.model import tensors_in
from advsearch.tasks.boxes import Detections, as_option, counted, nowhere

EXPECTED = (
    "expected boxes (N, D, 4) and scores (N, D, classes); boxes (N, D, 4), labels (N, "
    "D) and scores (N, D); rows "
    "(N, D, 6) of a box, a score and a class; one tensor (N, 4 + classes, D) or (N, D, "
    "5 + classes) as YOLO's; or for "
    "each picture a mapping with boxes (D, 4), labels (D,) and scores (D,)"
)

# what two numbers of a box may be
ORDERS = ("boxes scores labels", "boxes labels scores")

QUERIES = ("boxes logits", "boxes logits nothing")
"""What DETR's networks return: logits that judge each class by itself, with a sigmoid
(Zhu et al. 2021, section 4), or of which a softmax chooses one, the last of which
stands for nothing (Carion et al. 2020, section 3.1).
"""

# what these are called where the boxes are `pred_boxes`
QUERY_LOGITS = ("pred_logits", "logits")

HEADS = {"boxes scores": 4, "boxes objectness scores": 5}
"""What the numbers of a place of a YOLO's output are, and how many stand before the
scores.
"""

LAYOUTS = ("channels first", "channels last")
OF_HEADS = frozenset(
    [*HEADS, *(f"{head} {layout}" for head in HEADS for layout in LAYOUTS)]
)
TOLD_BY_CLASSES = OF_HEADS | frozenset(QUERIES)
"""Orders of outputs that the number of classes explains; their boxes have a middle and
sides.
"""

TOLERANCE = 1e-3  # how far outside [0, 1] a score may lie
_WITH_ANGLE = f"boxes objectness scores {LAYOUTS[0]}"
"""What a head of oriented boxes looks like: an angle after the scores makes as many
numbers as objectness before.
"""

_UNREAD = "which are not read"

NAMES = {
    "boxes": (
        "boxes",
        "pred_boxes",
        "detection_boxes",
        "bboxes",
        "xyxy",
        "box",
        "bbox",
    ),
    "scores": (
        "scores",
        "pred_scores",
        "detection_scores",
        "confidences",
        "confidence",
        "conf",
        "score",
    ),
    "labels": (
        "labels",
        "pred_classes",
        "detection_classes",
        "classes",
        "class_ids",
        "category_ids",
        "cls",
        "label",
    ),
}
"""What the parts of an output are called, the usual name first."""

WORDS = {
    "boxes": ("box",),
    "scores": ("score", "conf", "prob", "logit"),
    "labels": ("label", "class", "cls", "categ"),
}
"""What is in a name that is none of these."""

ASK_ORDER = f"say {' or '.join(as_option(f'order: {order}') for order in ORDERS)}"
"""What to say where scores and classes cannot be told apart."""

NOTHING: Detections = {"boxes": torch.zeros(0, 4), "either": torch.zeros(0, 2)}


def checked_order(text: str) -> tuple[str, ...]:
    """Return the parts that an order names: boxes, scores and labels, and "batch" for
    the number of the picture. Of one of YOLO's heads these are the words of `HEADS`,
    and of a layout; of DETR's one of `QUERIES`. Raises ValueError: it names others.
    """
    parts = tuple(text.replace(",", " ").split())
    if " ".join(parts) in TOLD_BY_CLASSES:
        return parts
    if sorted(parts) not in (sorted(NAMES), sorted([*NAMES, "batch"])):
        raise ValueError(
            f"expected boxes, scores and labels in their order, such as '{ORDERS[0]}', "
            "of a YOLO's head "
            f"{' or '.join(map(repr, HEADS))} with '{LAYOUTS[0]}' or '{LAYOUTS[1]}' "
            "after it, or of a DETR's "
            f"{' or '.join(map(repr, QUERIES))}, got {text!r}"
        )
    return parts


def detections_in(returned: Any, count: int, order: str = "") -> list[Detections]:
    """Return what a detector returned, as `EXPECTED` says, for each of `count`
    pictures. The order is of parts that have no names, see `checked_order`; "" for what
    types and shapes say. Raises ValueError: it is something else, or scores are not in
    [0, 1].
    """
    parts = checked_order(order) if order else ()
    listed = isinstance(returned, (list, tuple)) and len(returned) > 0
    if listed and all(isinstance(one, Tensor) and one.ndim > 3 for one in returned):
        raise ValueError(
            "expected boxes, and not the maps of a head from which they "
            "are made: export it in .eval()"
        )
    if (queries := _queries(returned, " ".join(parts))) is not None:
        boxes, logits = queries
        if (
            boxes.ndim != 3
            or boxes.shape[2] != 4
            or logits.ndim != 3
            or boxes.shape[:2] != logits.shape[:2]
        ):
            raise ValueError("expected boxes (N, D, 4) and logits (N, D, classes)")
        return [
            {"boxes": b.float(), "logits": one.float()}
            for b, one in zip(boxes, logits, strict=True)
        ]
    returned, channels = _first(returned)
    beside = torch.tensor(sorted(channels), dtype=torch.long)
    grid = (
        isinstance(returned, Tensor)
        and returned.ndim == 3
        and returned.shape[0] == count
        and returned.shape[2] != 4
    )
    masked = (
        grid
        and returned.shape[2] - 6 in channels
        and bool((returned[..., 5] == returned[..., 5].round()).all())
    )
    if grid and (
        " ".join(parts) in OF_HEADS or not (parts or masked or returned.shape[2] == 6)
    ):
        return [{"raw": one.float(), "beside": beside} for one in returned]
    if masked:  # rows of a box, a score, a class and mask coefficients
        return [
            {**one, "beside": beside}
            for one in detections_in(returned[..., :6], count, order)
        ]
    if "objectness" in parts or "channels" in parts:
        raise ValueError(EXPECTED)
    if (
        isinstance(returned, (list, tuple))
        and len(returned) == count
        and all(map(_is_one, returned))
    ):
        found = [
            dict(NOTHING) if one is None else _parts(one, parts) for one in returned
        ]
    elif isinstance(returned, Tensor) and returned.ndim == 2 and returned.shape[1] == 7:
        # rows of all pictures, with the number of the picture in the first column, or
        # where the order says
        before = parts[: parts.index("batch")] if "batch" in parts else ()
        place = len(before) + 3 * ("boxes" in before)
        numbers = returned.detach()[:, place]
        if not bool(
            ((numbers == numbers.round()) & (numbers >= -1) & (numbers < count)).all()
        ):
            raise ValueError(EXPECTED)
        rows = torch.cat([returned[:, :place], returned[:, place + 1 :]], dim=1)
        beside_number = [part for part in parts if part != "batch"]
        found = [
            _parts(rows[numbers == number], beside_number) for number in range(count)
        ]
    else:
        together = _parts(returned, parts)
        # the network has dropped the batch dimension
        if together["boxes"].ndim == 2 and count == 1:
            together = {name: part[None] for name, part in together.items()}
        if together["boxes"].ndim != 3 or any(
            len(part) != count for part in together.values()
        ):
            raise ValueError(EXPECTED)
        found = [
            {name: part[k] for name, part in together.items()} for k in range(count)
        ]
    return [_one(one) for one in found]


def _queries(returned: Any, order: str) -> tuple[Tensor, Tensor] | None:
    """The boxes and logits of an output as DETR's networks give it, or that is said to
    be one; None of any other.
    """
    # boxes are shares, which logits are not
    if order in QUERIES and isinstance(returned, (list, tuple)):
        tensors = [one for one in returned if isinstance(one, Tensor)]
        boxes = [
            one
            for one in tensors
            if one.shape[-1] == 4 and bool(((one >= 0.0) & (one <= 1.0)).all())
        ][:1]
        logits = [one for one in tensors if not any(one is box for box in boxes)][:1]
        return (boxes[0], logits[0]) if boxes and logits else None
    part = returned.get if isinstance(returned, Mapping) else partial(getattr, returned)
    found = [
        [one] if isinstance(one := part(name, None), Tensor) else []
        for name in ("pred_boxes", *QUERY_LOGITS)
    ]
    boxes = found[0]
    logits = [*found[1], *found[2]][:1]
    return (
        (boxes[0], logits[0]) if boxes and logits and order in ("", *QUERIES) else None
    )


def _first(returned: Any) -> tuple[Any, set[int]]:
    """The predictions of a YOLO's output, and how many channels the maps (N, K, h, w)
    have that came with them. In training form they are the first of a tuple, feature
    maps and prototypes of masks stand beside them, in lists and mappings too. Any other
    output is returned as it is.
    """
    if (
        not isinstance(returned, (list, tuple))
        or not returned
        or not isinstance(returned[0], Tensor)
    ):
        return returned, set()
    first = returned[0]
    others = returned[1:]
    beside = any(isinstance(one, Tensor) and one.ndim < 4 for one in others)
    if first.ndim != 3 or first.shape[2] == 4 or beside:
        return returned, set()
    maps = [
        part
        for part in tensors_in(list(others))
        if part.ndim == 4 and len(part) == len(first)
    ]
    return first, {part.shape[1] for part in maps}


def _is_one(part: Any) -> bool:
    """Whether a part of an output is that for one picture, and not boxes or scores of
    all; None where nothing is.
    """
    if isinstance(part, Tensor):
        return part.ndim == 2 and part.shape[1] == 6
    return (
        part is None
        or isinstance(part, (Mapping, list, tuple))
        or _named(part) is not None
    )


def _parts(returned: Any, order: Sequence[str]) -> dict[str, Tensor]:
    """Return the parts of an output by name: boxes, and scores, with labels or without,
    or `either`.
    """
    if isinstance(returned, Tensor):
        if returned.ndim not in (2, 3) or returned.shape[-1] != 6:
            raise ValueError(EXPECTED)
        if order:
            columns = returned.split(
                [4 if name == "boxes" else 1 for name in order], dim=-1
            )
            return {
                name: part if name == "boxes" else part[..., 0]
                for name, part in zip(order, columns, strict=True)
            }
        return {"boxes": returned[..., :4], "either": returned[..., 4:]}
    named = _named(returned)
    if named is not None and "boxes" in named and "scores" in named:
        return named
    listed = returned.values() if isinstance(returned, Mapping) else returned
    if not isinstance(listed, Iterable):
        raise ValueError(EXPECTED)
    tensors = list(listed)
    if isinstance(returned, Mapping):
        tensors = [one for one in tensors if isinstance(one, Tensor)]
    if not all(isinstance(one, Tensor) for one in tensors):
        raise ValueError(EXPECTED)
    if order and len(tensors) == len(order):
        given = dict(zip(order, tensors, strict=True))
        shape = given["boxes"].shape[:-1]
        return {
            name: part[..., 0] if part.shape == (*shape, 1) else part
            for name, part in given.items()
        }
    return _by_shape(tensors)


def _named(returned: Any) -> dict[str, Tensor] | None:
    """The parts of a mapping or an object by their names; None of what is neither."""
    if isinstance(returned, Mapping):
        given = {
            str(name): part
            for name, part in returned.items()
            if isinstance(part, Tensor)
        }
    elif any(hasattr(returned, name) for name in NAMES["boxes"]):
        known = [name for names in NAMES.values() for name in names]
        given = {
            name: getattr(returned, name)
            for name in known
            if isinstance(getattr(returned, name, None), Tensor)
        }
    else:
        return None
    found = dict[str, Tensor]()
    left = dict(given)
    for part, names in NAMES.items():
        exact = [name for name in names if name in left]
        near = [
            name for name in left if any(word in name.lower() for word in WORDS[part])
        ]
        if exact or len(near) == 1:
            found[part] = left.pop((exact or near)[0])
    return found


def _by_shape(tensors: Sequence[Tensor]) -> dict[str, Tensor]:
    """The parts of a tuple: boxes have four numbers, classes are whole numbers by
    type.
    """
    fours = [one for one in tensors if one.ndim > 1 and one.shape[-1] == 4]
    fours = [one for one in fours if one.ndim == max(four.ndim for four in fours)]
    # no scores of four classes
    far = [one for one in fours if bool((one.detach() > 1.0 + TOLERANCE).any())]
    if not fours or len(tensors) < 2:
        raise ValueError(EXPECTED)
    boxes = far[0] if len(far) == 1 else fours[0]
    shape = boxes.shape[:-1]
    others = [
        one for one in tensors if one is not boxes and one.shape[: len(shape)] == shape
    ]
    if len(others) == 1 and others[0].ndim == boxes.ndim:
        return {"boxes": boxes, "scores": others[0]}
    flat = [one[..., 0] if one.shape == (*shape, 1) else one for one in others]
    whole = [one for one in flat if not one.is_floating_point()]
    if len(flat) != 2 or len(whole) == 2 or any(one.shape != shape for one in flat):
        raise ValueError(EXPECTED)
    if whole:
        return {
            "boxes": boxes,
            "scores": flat[0] if flat[1] is whole[0] else flat[1],
            "labels": whole[0],
        }
    return {
        "boxes": boxes,
        "either": torch.stack([one.to(boxes.dtype) for one in flat], dim=-1),
    }


def _one(one: Mapping[str, Tensor]) -> Detections:
    """The detections of one picture, checked, without rows that only fill up. Such a
    row has a class or score of -1, or four equal numbers or NaN for a box, and no
    score.
    """
    boxes = one["boxes"].reshape(-1, 4) if one["boxes"].numel() == 0 else one["boxes"]
    parts = [part for name, part in one.items() if name != "blank"]
    if (
        boxes.ndim != 2
        or boxes.shape[1] != 4
        or any(len(part) != len(boxes) for part in parts)
    ):
        raise ValueError(EXPECTED)
    boxes = boxes.float()
    if "either" in one:
        either = one["either"].float()
        filling = nowhere(boxes.detach()) & ~(either.detach() > 0.0).all(dim=1)
        return _kept({"boxes": boxes, "either": either}, filling, either.detach())
    scores = one["scores"].float()
    labels = one.get("labels")
    if scores.ndim != (2 if labels is None else 1) or (
        labels is not None and labels.shape != scores.shape
    ):
        raise ValueError(EXPECTED)
    if labels is not None and labels.is_floating_point():
        nameless = labels.detach().isnan()
        scores = scores.masked_fill(nameless, math.nan)
        labels = labels.detach().masked_fill(nameless, 0.0)
        if bool((labels != labels.round()).any()):
            raise ValueError("expected classes that are whole numbers")
    best = scores.detach() if labels is None else scores.detach()[:, None]
    filling = nowhere(boxes.detach()) & ~(best > 0.0).any(dim=1) | (best == -1.0).all(
        dim=1
    )
    filling = filling if labels is None else filling | (labels < 0)
    outside = best[~filling]
    if bool(
        (
            (outside < -TOLERANCE) | (outside > 1.0 + TOLERANCE) & outside.isfinite()
        ).any()
    ):
        said = (
            f", or say {' or '.join(as_option(f'order: {order}') for order in QUERIES)}"
            if labels is None
            else ""
        )
        raise ValueError(
            "expected scores that are probabilities in [0, 1]; apply a sigmoid or a "
            f"softmax to them{said}"
        )
    found = {
        "boxes": boxes,
        "scores": scores,
        **({} if labels is None else {"labels": labels.long()}),
    }
    return {
        **_kept(found, filling, best),
        **{name: one[name] for name in one if name == "blank"},
    }


def _kept(one: dict[str, Tensor], filling: Tensor, numbers: Tensor) -> Detections:
    """The rows that do not fill up (D,), and how many of those that do are NaN in box
    and numbers (D, K).
    """
    if not bool(filling.any()):
        return one
    blank = (
        filling & numbers.isnan().all(dim=1) & one["boxes"].detach().isnan().all(dim=1)
    )
    kept = {name: part[~filling] for name, part in one.items()}
    return {**kept, "blank": blank.sum()[None]} if bool(blank.any()) else kept


# ---- scores and classes by what they are
# ----------------------------------------------------------------------------


def settled(one: Detections, order: str = "", classes: int | None = None) -> Detections:
    """Return the detections of a picture with boxes, scores and labels told apart, by
    an order (`ORDERS`, `QUERIES`, or `HEADS` with a layout; "" for what its rows show)
    and the number of classes, None where nobody says. Raises ValueError: they do not
    show it, or something else than the order says.
    """
    if "raw" in one or "logits" in one:
        if classes is None:
            raise ValueError(EXPECTED)
        order = order or order_in([one], classes)
        if "raw" in one:
            boxes, scores = split(one["raw"], classes, order)
        else:
            boxes = one["boxes"]
            logits = one["logits"]
            scores = (
                logits.softmax(dim=1)[:, :classes]
                if order == QUERIES[1]
                else logits.sigmoid()
            )
        return _one({"boxes": boxes, "scores": scores})
    if "either" not in one:
        return {name: part for name, part in one.items() if name != "beside"}
    rows = counted(one) | one["either"].isnan().any(dim=1)
    order = order or order_in([one], classes) or ("" if bool(rows.any()) else ORDERS[0])
    if not order:
        raise ValueError(
            f"which of a box's two numbers is its score does not show; {ASK_ORDER}"
        )
    if order in OF_HEADS:
        scores = (
            one["either"].prod(dim=1, keepdim=True)
            if "objectness" in order
            else one["either"]
        )
        return _one({"boxes": one["boxes"], "scores": scores})
    first, second = one["either"].unbind(dim=1)
    scores, labels = (first, second) if order == ORDERS[0] else (second, first)
    said = {
        name: part for name, part in one.items() if name not in ("either", "beside")
    }
    return _one({**said, "scores": scores, "labels": labels})


def order_in(
    found: Sequence[Detections], classes: int | None = None, head: str = ""
) -> str:
    """Return which order detections of any pictures show, one of `ORDERS`, of
    `QUERIES`, or of `HEADS` with its layout; "" where they leave it open. Nobody may
    say how many classes there are; `head` is what is said of outputs in one tensor, one
    of `HEADS` or of `QUERIES`, or "".

    A class is a whole number, a score lies in [0, 1]; and what suppression leaves comes
    by falling scores. Two numbers of which none is a class are the scores of two
    classes, or objectness and the score of the only one.

    Raises:
        ValueError: no number can be a score, or none a class; or a grid of boxes has
            none or several of its orders; or there are more or fewer logits than
            classes.
    """
    sizes = [one["logits"].shape[1] for one in found if "logits" in one]
    if sizes and classes is not None:
        size = sizes[0]
        order = head or QUERIES[size == classes + 1]
        if size in ((classes, classes + 1) if order == QUERIES[1] else (classes,)):
            return order
        fitting = [
            f"`labels={name}`"
            for name in dict.fromkeys([*sets_of(size), *sets_of(size - 1)])
        ]
        raise ValueError(
            f"expected {classes} logits of a box for {classes} classes, or "
            f"{classes + 1} with one for nothing, got "
            f"{size}; {' or '.join(fitting) + ' would fit' if fitting else 'give the `labels` of its classes'}"
        )
    grids = [one for one in found if "raw" in one]
    if grids and classes is not None:
        heads = set.intersection(
            *(
                set(head_in(one["raw"], one["beside"].tolist(), classes, head))
                for one in grids
            )
        )
        if not heads:
            raise ValueError(
                "pictures do not agree about how its numbers are to be read"
            )
        if len(heads) > 1:
            said = " or ".join(as_option(f"order: {head}") for head in sorted(heads))
            raise ValueError(
                f"how its numbers are to be read does not show; say {said}"
            )
        return heads.pop()
    each = [one["either"][counted(one)] for one in found if "either" in one]
    rows = [one[one.isfinite().all(dim=1)].detach() for one in each]
    if not any(map(len, rows)):
        return ""
    numbers = torch.cat(rows).unbind(dim=1)
    most = math.inf if classes is None else classes
    whole = [bool(((c == c.round()) & (c >= -1.0) & (c < most)).all()) for c in numbers]
    share = [bool(((c >= -TOLERANCE) & (c <= 1.0 + TOLERANCE)).all()) for c in numbers]
    fits = [share[0] and whole[1], share[1] and whole[0]]
    broken = not any(bool((c == c.round()).all()) for c in numbers)
    if not any(fits) and all(share) and broken and classes in (1, 2):
        return f"{list(HEADS)[2 - classes]} {LAYOUTS[1]}"
    if not any(fits) and classes is not None:
        return order_in(found)
    if not any(fits):
        raise ValueError(
            "expected for each box a score in [0, 1] and the number of a "
            "class, got other numbers"
        )
    if all(fits):
        fits = [
            all(bool((one[:, k].diff() <= 0.0).all()) for one in rows) for k in (0, 1)
        ]
    return "" if fits[0] == fits[1] else ORDERS[0] if fits[0] else ORDERS[1]


# ---- in one tensor, as YOLO's networks give them
# --------------------------------------------------------------------- It is (A, B) for
# each picture: "channels first" (places are columns, v8 to v12 and YOLO11) or "channels
# last" (v5 to v7, YOLOX, RT-DETR). The numbers of a place are a box (middle, width,
# height), in older ones objectness, with which scores are multiplied, a score of each
# class, and mask coefficients.


def head_in(
    returned: Tensor, beside: Collection[int], classes: int, order: str = ""
) -> tuple[str, ...]:
    """Return the orders that an output (A, B) for one picture may have, such as "boxes
    scores channels first"; what is said of it already narrows them. Sides tell
    (`beside`: the channels of maps that came with it), and scores, which lie in [0, 1].
    Raises ValueError where it has none of them; the text says what it seems to be.
    """
    found = list[str]()
    outside = ""
    for layout, length in zip(LAYOUTS, returned.shape, strict=True):
        for head, start in HEADS.items():
            name = f"{head} {layout}"
            masks = length - start - classes
            if order not in ("", head, name) or (masks and masks not in beside):
                continue
            scores = split(returned, classes, name, multiplied=False)[1].detach()
            far = (scores < -TOLERANCE) | (scores > 1.0 + TOLERANCE)
            if not bool((far & scores.isfinite()).any()):
                found.append(name)
            elif name == _WITH_ANGLE and not bool(far[:, :-1].any()):
                outside = f"an angle after the scores, as OBB heads have it, {_UNREAD}"
            else:
                outside = outside or (
                    f"scores from {float(scores.min()):.3g} to "
                    f"{float(scores.max()):.3g} if it is read as '{name}'; "
                    "expected probabilities in [0, 1]: apply a sigmoid to them"
                )
    if found == [_WITH_ANGLE] and not order:
        raise ValueError(
            f"its {5 + classes} channels may be those of an OBB head (with an angle), "
            f"{_UNREAD}; if it has "
            f"objectness, say `task='detection={{order: {_WITH_ANGLE}}}'`"
        )
    if outside and not found:
        raise ValueError(f"it has {outside}")
    if found:
        return tuple(found)
    size = min(returned.shape)
    last = returned.shape[0] >= returned.shape[1]
    over = {size - 4 - classes, size - 6 if last else 0}
    advice = "; give the `labels` of the model's classes"
    if named := [
        f"`labels={name}`" for start in HEADS.values() for name in sets_of(size - start)
    ]:
        advice = f"; {' or '.join(named)} would fit"
    elif 1 in over:
        advice = f", as OBB heads (oriented boxes, with an angle) have it, {_UNREAD}"
    elif 32 in over:
        advice = (
            ", as with mask coefficients, and no prototypes (N, 32, h, w) came "
            "beside them"
        )
    elif any(more > 0 and more % 3 == 0 for more in over):
        advice = (
            f", as pose heads (with keypoints) have it, {_UNREAD}; or give the "
            "`labels` of the model's classes"
        )
    of = f"{classes} class{'es' * (classes > 1)}"
    raise ValueError(
        f"expected 4 + {classes} or 5 + {classes} numbers of a box for "
        f"{of}, got {size}{advice}"
    )


def split(
    returned: Tensor, classes: int, order: str, *, multiplied: bool = True
) -> tuple[Tensor, Tensor]:
    """Return the boxes (D, 4) and scores (D, classes) of an output (A, B) for one
    picture; differentiable. Its order has a layout. Unless objectness is `multiplied`
    with the scores, it is the first of (D, 1 + classes).
    """
    places = returned.T if order.endswith(LAYOUTS[0]) else returned
    scores = places[:, 4 : 4 + classes]
    if order.startswith("boxes objectness"):
        objectness = places[:, 4:5]
        scores = places[:, 5 : 5 + classes]
        scores = (
            objectness * scores
            if multiplied
            else torch.cat([objectness, scores], dim=1)
        )
    return places[:, :4], scores
