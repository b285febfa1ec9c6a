"""Functions that read the output of a detector.

They find out which tensors are boxes, scores and classes, and which rows are padding.
The detections of an image are a mapping with

* `boxes` (D, 4), in the format of the network, and
* `scores`: (D, C) for every class, or (D,) with `labels` (D,), the class of each box.

Instead of these it may have, as long as the output does not show what they are:

* `score_or_label` (D, 2) instead of scores and labels: two numbers for each box. Types,
  names and shapes do not show which one is the score and which one the class;
* `grid` (A, B) instead of everything: a single tensor, which can be read only with the
  number of classes. `map_channels` (K,) are the numbers of channels of feature maps that
  the network returned with it;
* `logits` (D, K) instead of scores: they can be read only with the number of classes, see
  `QUERIES`.

Rows of padding are removed. If some of these have only NaN, `n_nan_rows` (1,) is their
count.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

from advsearch.models.labels import list_sets_of_size
from advsearch.models.model import list_tensors
from advsearch.tasks.boxes import (
    Detections,
    are_counted_boxes,
    are_invalid,
    format_detection_option,
)

EXPECTED = (
    "expected boxes (N, D, 4) and scores (N, D, classes); boxes (N, D, 4), labels (N, "
    "D) and scores (N, D); rows (N, D, 6) of a box, a score and a class; one tensor "
    "(N, 4 + classes, D) or (N, D, 5 + classes) as YOLO's; or for each picture a "
    "mapping with boxes (D, 4), labels (D,) and scores (D,)"
)

# The two numbers after a box: a score and a label, or the other way round.
SCORES_FIRST = "boxes scores labels"
LABELS_FIRST = "boxes labels scores"
ORDERS = (SCORES_FIRST, LABELS_FIRST)

SIGMOID_QUERIES = "boxes logits"
SOFTMAX_QUERIES = "boxes logits nothing"
QUERIES = (SIGMOID_QUERIES, SOFTMAX_QUERIES)
"""Outputs of DETR networks: logits of independent classes, for a sigmoid (Zhu et al. 2021,
section 4); or logits of exclusive classes, for a softmax, where the last class means no
object (Carion et al. 2020, section 3.1).
"""

# Names of the logits in an output whose boxes are named `pred_boxes`.
QUERY_LOGITS = ("pred_logits", "logits")

PLAIN_HEAD = "boxes scores"
OBJECTNESS_HEAD = "boxes objectness scores"
HEADS = {PLAIN_HEAD: 4, OBJECTNESS_HEAD: 5}
"""Index of the channel with the first score, by the order of a YOLO head's channels."""

CHANNELS_FIRST = "channels first"
CHANNELS_LAST = "channels last"
LAYOUTS = (CHANNELS_FIRST, CHANNELS_LAST)
HEAD_ORDERS = frozenset(
    [*HEADS, *(f"{head} {layout}" for head in HEADS for layout in LAYOUTS)]
)
CLASS_COUNT_ORDERS = HEAD_ORDERS | frozenset(QUERIES)
"""Orders of outputs that can be read only with the number of classes. Their boxes are
center, width and height.
"""

TOLERANCE = 1e-3  # by how much a score may be outside of [0, 1]
_OBB_LIKE_ORDER = f"{OBJECTNESS_HEAD} {CHANNELS_FIRST}"
"""Order with as many channels as a head with oriented boxes (OBB), which has an angle after
the scores instead of objectness before them.
"""

_UNREAD = "which are not read"  # end of messages about outputs of other kinds
_ANGLE_PROBLEM = f"an angle after the scores, as OBB heads have it, {_UNREAD}"

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
"""Known names of each component of an output; the first is the usual one."""

WORDS = {
    "boxes": ("box",),
    "scores": ("score", "conf", "prob", "logit"),
    "labels": ("label", "class", "cls", "categ"),
}
"""Substrings that identify a component whose name is not in `NAMES`."""

ORDER_ADVICE = (
    f"say {' or '.join(format_detection_option(f'order: {order}') for order in ORDERS)}"
)
"""Advice of messages if scores and classes cannot be distinguished."""

NO_DETECTIONS: Detections = {
    "boxes": torch.zeros(0, 4),
    "score_or_label": torch.zeros(0, 2),
}


def parse_order(text: str) -> tuple[str, ...]:
    """Split the option `order` into its names and check them.

    They are boxes, scores and labels in any order, and optionally "batch" for the
    index of the image; or the words of one of `HEADS`, optionally with one of
    `LAYOUTS`; or those of one of `QUERIES`.

    Raises:
        ValueError: it is none of these.
    """
    names = tuple(text.replace(",", " ").split())
    is_head_or_query = " ".join(names) in CLASS_COUNT_ORDERS
    components = list(NAMES)  # boxes, scores and labels
    is_known = sorted(names) in (sorted(components), sorted([*components, "batch"]))
    if not is_head_or_query and not is_known:
        raise ValueError(
            f"expected boxes, scores and labels in their order, such as '{ORDERS[0]}', "
            f"of a YOLO's head {' or '.join(map(repr, HEADS))} with '{LAYOUTS[0]}' or "
            f"'{LAYOUTS[1]}' after it, or of a DETR's "
            f"{' or '.join(map(repr, QUERIES))}, got {text!r}"
        )
    return names


def read_detections(returned: Any, count: int, order: str = "") -> list[Detections]:
    """Read the detections of each of `count` images from what a detector returned.

    Args:
        returned: what the network returned, in one of the forms of `EXPECTED`.
        count: number of images.
        order: names of the components of a tuple or a row, such as "boxes scores
            labels"; "" to infer them.

    Returns:
        For each image, tensors by name: "boxes" and "scores", perhaps "labels"; or, if
        values have to show later what is a score, "grid", "logits" or
        "score_or_label".

    Raises:
        ValueError: the output has another form, or scores are not in [0, 1].
    """
    order_names = parse_order(order) if order else ()
    order = " ".join(order_names)
    _check_no_head_maps(returned)
    queries = _find_queries(returned, order)
    if queries is not None:
        return _split_queries(*queries)

    predictions, channels = _split_off_maps(returned)
    if _may_be_grid(predictions, count):
        detections_of_images = _read_tensor(predictions, channels, order)
        if detections_of_images is not None:
            return detections_of_images
    # If the user states the order of a YOLO head, the output should have been a grid.
    is_head_stated = "objectness" in order_names or "channels" in order_names
    if is_head_stated:
        raise ValueError(EXPECTED)
    components_of_images = _split_images(predictions, count, order_names)
    return [_check_detections(components) for components in components_of_images]


def _read_tensor(
    predictions: Tensor, channels: Collection[int], order: str
) -> list[Detections] | None:
    """Read a single tensor (N, A, B) as YOLO grids, or as rows with mask coefficients.

    Args:
        predictions: (N, A, B).
        channels: numbers of channels of feature maps that came with it.
        order: order that the user stated, or "".

    Returns:
        The detections of each image; None if it is neither.
    """
    map_channels = torch.tensor(sorted(channels), dtype=torch.long)
    # rows of a box, a score, a class and mask coefficients
    has_mask_rows = _has_mask_rows(predictions, channels)
    if _is_grid(predictions, order, has_mask_rows=has_mask_rows):
        return [
            {"grid": grid.float(), "map_channels": map_channels} for grid in predictions
        ]
    if not has_mask_rows:
        return None
    # The mask coefficients after the first six columns are not read.
    rows = read_detections(predictions[..., :6], len(predictions), order)
    return [{**detections, "map_channels": map_channels} for detections in rows]


def _may_be_grid(predictions: Any, count: int) -> bool:
    """Return whether predictions are a single tensor (count, A, B), and no boxes."""
    return (
        isinstance(predictions, Tensor)
        and predictions.ndim == 3
        and predictions.shape[0] == count
        and predictions.shape[2] != 4  # boxes without scores, as of a DETR
    )


def _is_grid(predictions: Tensor, order: str, *, has_mask_rows: bool) -> bool:
    """Return whether a tensor (N, A, B) is the output of a YOLO head.

    Its channels can be read only with the number of classes. Other tensors have rows: a
    box, a score and a class, and perhaps mask coefficients. Without a stated order, six
    columns are such rows.

    Args:
        predictions: the tensor.
        order: order that the user stated; "" for none.
        has_mask_rows: whether it has rows with mask coefficients.
    """
    if order:
        return order in HEAD_ORDERS
    has_six_columns = predictions.shape[2] == 6
    return not has_six_columns and not has_mask_rows


def _check_no_head_maps(returned: Any) -> None:
    """Raise ValueError if a detector returned only maps (N, K, h, w).

    They are the output of a head in training mode, without boxes.
    """
    is_sequence = isinstance(returned, (list, tuple)) and len(returned) > 0
    if is_sequence and all(isinstance(x, Tensor) and x.ndim > 3 for x in returned):
        raise ValueError(
            "expected boxes, got the maps of a head from which they "
            "are computed: export it in .eval()"
        )


def _has_mask_rows(grid: Tensor, channels: Collection[int]) -> bool:
    """Return whether rows (N, D, k) are a box, a score, a class and mask coefficients.

    Args:
        grid: the rows.
        channels: numbers of channels of the feature maps that came with them. One of
            these has a channel for each coefficient.
    """
    n_coefficients = grid.shape[2] - 6  # without a box (4 columns), a score and a class
    if n_coefficients not in channels:
        return False
    class_column = grid[..., 5]
    is_integer = class_column == class_column.round()
    return bool(is_integer.all())


def _split_queries(boxes: Tensor, logits: Tensor) -> list[Detections]:
    """Return the detections of each image from boxes (N, D, 4) and logits (N, D, C)."""
    if (
        boxes.ndim != 3
        or boxes.shape[2] != 4
        or logits.ndim != 3
        or boxes.shape[:2] != logits.shape[:2]
    ):
        raise ValueError("expected boxes (N, D, 4) and logits (N, D, classes)")
    return [
        {"boxes": image_boxes.float(), "logits": image_logits.float()}
        for image_boxes, image_logits in zip(boxes, logits, strict=True)
    ]


def _split_images(
    returned: Any, count: int, order_names: Sequence[str]
) -> list[dict[str, Tensor]]:
    """Split an output into the components of each of `count` images, unchecked.

    It may be a list with an element for each image, rows with the index of their image,
    or tensors whose first axis is the image.

    Args:
        returned: what the network returned.
        count: number of images.
        order_names: names of the components in the order that the user stated; empty
            without one.

    Raises:
        ValueError: the output has none of the forms of `EXPECTED`.
    """
    if _is_list_of_images(returned, count):
        return [
            dict(NO_DETECTIONS)
            if output is None
            else _find_components(output, order_names)
            for output in returned
        ]
    # rows (D, 7) of all images: a box, two numbers, and the index of the image
    has_rows_of_all_images = (
        isinstance(returned, Tensor) and returned.ndim == 2 and returned.shape[1] == 7
    )
    if has_rows_of_all_images:
        return _split_batch_rows(returned, count, order_names)
    return _split_components(_find_components(returned, order_names), count)


def _split_components(
    batch: Mapping[str, Tensor], count: int
) -> list[dict[str, Tensor]]:
    """Split the components of a batch, whose first axis is the image, by image.

    Raises:
        ValueError: they are not those of `count` images.
    """
    if batch["boxes"].ndim == 2 and count == 1:
        # The network has dropped the batch dimension, which is added again.
        batch = {name: component[None] for name, component in batch.items()}
    if batch["boxes"].ndim != 3 or any(len(x) != count for x in batch.values()):
        raise ValueError(EXPECTED)
    return [
        {name: component[index] for name, component in batch.items()}
        for index in range(count)
    ]


def _is_list_of_images(returned: Any, count: int) -> bool:
    """Return whether an output is a sequence with an element for each image."""
    return (
        isinstance(returned, (list, tuple))
        and len(returned) == count
        and all(map(_is_image_output, returned))
    )


def _split_batch_rows(
    rows: Tensor, count: int, order_names: Sequence[str]
) -> list[dict[str, Tensor]]:
    """Split rows (D, 7) of all images by their column with the index of the image.

    The index is in the first column, as ONNX exports with suppression have it, or in
    the column that the order calls "batch". A row with the index -1 is padding.

    Args:
        rows: rows of all images: four numbers of a box, a score and a label in any
            order, and the index.
        count: number of images.
        order_names: names of the components in the order that the user stated; empty
            without one.

    Raises:
        ValueError: that column does not hold indices of images.
    """
    batch_column = _find_batch_column(order_names)
    image_index = rows.detach()[:, batch_column]
    _check_image_indices(image_index, count)
    other_columns = torch.cat(
        [rows[:, :batch_column], rows[:, batch_column + 1 :]], dim=1
    )
    other_names = [name for name in order_names if name != "batch"]
    # Padding, with the index -1, is in no image.
    return [
        _find_components(other_columns[image_index == index], other_names)
        for index in range(count)
    ]


def _check_image_indices(numbers: Tensor, count: int) -> None:
    """Raise ValueError if numbers (D,) are not all indices of `count` images, or -1."""
    is_index = (
        (numbers == numbers.round())
        & (numbers >= -1)  # -1 is padding
        & (numbers < count)
    )
    if not bool(is_index.all()):
        raise ValueError(EXPECTED)


def _find_batch_column(order_names: Sequence[str]) -> int:
    """Return the column with the index of the image; the first without a stated order."""
    names_before: Sequence[str] = ()
    if "batch" in order_names:
        names_before = order_names[: order_names.index("batch")]
    # A name has one column, but "boxes" has four.
    return sum(4 if name == "boxes" else 1 for name in names_before)


def _find_queries(returned: Any, order: str) -> tuple[Tensor, Tensor] | None:
    """Find the boxes and logits of a DETR output; None if it is no such output.

    A sequence of tensors is a DETR output if the user states that order. A mapping or an
    object is one if it has "pred_boxes" and a component with a usual name of logits.

    Args:
        returned: what the network returned.
        order: order that the user stated, one of `QUERIES` for a DETR; "" for none.
    """
    if order in QUERIES and isinstance(returned, (list, tuple)):
        return _find_query_tensors(returned)
    is_other_form_stated = order not in ("", *QUERIES)
    if is_other_form_stated:
        return None
    # a function of a name and a default: items of a mapping, or attributes of an object
    get = returned.get if isinstance(returned, Mapping) else partial(getattr, returned)
    boxes = get("pred_boxes", None)
    if not isinstance(boxes, Tensor):
        return None
    candidates = (get(name, None) for name in QUERY_LOGITS)
    logits = next((x for x in candidates if isinstance(x, Tensor)), None)
    return None if logits is None else (boxes, logits)


def _find_query_tensors(returned: Sequence[Any]) -> tuple[Tensor, Tensor] | None:
    """Find the boxes and logits of a DETR output among values without names; None if
    one is missing.
    """
    tensors = [value for value in returned if isinstance(value, Tensor)]
    # Boxes are fractions, which logits are not.
    boxes = next(filter(_are_fraction_boxes, tensors), None)
    logits = next((tensor for tensor in tensors if tensor is not boxes), None)
    if boxes is None or logits is None:
        return None
    return boxes, logits


def _are_fraction_boxes(tensor: Tensor) -> bool:
    """Return whether a tensor may be boxes (..., 4) in fractions of the image."""
    return tensor.shape[-1] == 4 and bool(((tensor >= 0.0) & (tensor <= 1.0)).all())


def _split_off_maps(returned: Any) -> tuple[Any, set[int]]:
    """Take the predictions out of the tuple that a YOLO network returns.

    The predictions (N, A, B) come first. Feature maps (N, K, h, w) and prototypes of
    masks follow, also nested in lists and mappings.

    Returns:
        The predictions, and the numbers of channels K of the maps, of which one may be
        the number of mask coefficients. An output of any other form is returned
        unchanged, with an empty set.
    """
    is_sequence = isinstance(returned, (list, tuple)) and len(returned) > 0
    if not is_sequence or not isinstance(returned[0], Tensor):
        return returned, set()
    predictions = returned[0]
    rest = returned[1:]
    # boxes (N, D, 4) without scores, whose scores follow as another tensor
    is_boxes = predictions.ndim == 3 and predictions.shape[2] == 4
    # Feature maps have four axes. Tensors with fewer are scores or labels: then the tuple
    # is not that of a YOLO network.
    has_scores_or_labels = any(isinstance(x, Tensor) and x.ndim < 4 for x in rest)
    if predictions.ndim != 3 or is_boxes or has_scores_or_labels:
        return returned, set()
    channels = {
        tensor.shape[1]
        for tensor in list_tensors(list(rest))
        if tensor.ndim == 4 and len(tensor) == len(predictions)
    }
    return predictions, channels


def _is_image_output(value: Any) -> bool:
    """Return whether an element of a list may be the output for one image.

    Otherwise it is e.g. the boxes or the scores of all images. None stands for an image
    without detections.
    """
    if isinstance(value, Tensor):
        return value.ndim == 2 and value.shape[1] == 6  # a box, a score and a class
    is_object_with_boxes = _find_named(value) is not None
    return (
        value is None
        or isinstance(value, (Mapping, list, tuple))
        or is_object_with_boxes
    )


def _find_components(returned: Any, order_names: Sequence[str]) -> dict[str, Tensor]:
    """Find the components of detections in the output of one image, or of a batch.

    Args:
        returned: a tensor of rows of six numbers, named tensors, or a sequence of
            tensors.
        order_names: names of the components in the order that the user stated; empty
            without one.

    Returns:
        Tensors by name: "boxes" and "scores", perhaps with "labels". If it is unknown
        which of a box's two numbers is its score, both are "score_or_label", (..., 2).

    Raises:
        ValueError: the output has none of the forms of `EXPECTED`.
    """
    if isinstance(returned, Tensor):
        if returned.ndim not in (2, 3) or returned.shape[-1] != 6:
            raise ValueError(EXPECTED)
        return _split_columns(returned, order_names)
    named = _find_named(returned)
    if named is not None and "boxes" in named and "scores" in named:
        return named
    # Without known names, the stated order identifies the tensors, or else their shapes.
    tensors = _list_tensors_in_order(returned)
    if not order_names or len(tensors) != len(order_names):
        return _identify_by_shape(tensors)
    components = dict(zip(order_names, tensors, strict=True))
    # (D,) or (N, D). Scores and labels may have another axis of size one, which is
    # removed. Each order has boxes.
    shape = components["boxes"].shape[:-1]
    return {name: _squeeze_last(tensor, shape) for name, tensor in components.items()}


def _list_tensors_in_order(returned: Any) -> list[Tensor]:
    """Return the tensors of a sequence, or those among the values of a mapping.

    Raises:
        ValueError: it is neither, or the sequence has something else in it.
    """
    if isinstance(returned, Mapping):
        return [value for value in returned.values() if isinstance(value, Tensor)]
    if not isinstance(returned, Iterable):
        raise ValueError(EXPECTED)
    tensors = list(returned)
    if not all(isinstance(value, Tensor) for value in tensors):
        raise ValueError(EXPECTED)
    return tensors


def _split_columns(rows: Tensor, order_names: Sequence[str]) -> dict[str, Tensor]:
    """Split the columns of rows (..., 6): four of a box, and two single numbers.

    Without an order these two are "score_or_label", (..., 2).
    """
    if not order_names:
        return {"boxes": rows[..., :4], "score_or_label": rows[..., 4:]}
    widths = [4 if name == "boxes" else 1 for name in order_names]
    return {
        name: columns if name == "boxes" else columns[..., 0]
        for name, columns in zip(order_names, rows.split(widths, dim=-1), strict=True)
    }


def _squeeze_last(tensor: Tensor, shape: Sequence[int]) -> Tensor:
    """Remove the last axis of a tensor (*shape, 1); return other tensors unchanged."""
    return tensor[..., 0] if tensor.shape == (*shape, 1) else tensor


def _find_named(returned: Any) -> dict[str, Tensor] | None:
    """Find the components of a mapping or an object by their names.

    A component has one of its `NAMES`, or else is the only tensor with one of its
    `WORDS` in the name. A tensor is used once: for the first component, in the order of
    `NAMES`, that it fits.

    Returns:
        Those of "boxes", "scores" and "labels" that are found; None if it is neither a
        mapping nor an object with boxes.
    """
    tensors = _list_named_tensors(returned)
    if tensors is None:
        return None
    components = dict[str, Tensor]()
    for component, names in NAMES.items():
        match = _find_component_name(tensors, names, WORDS[component])
        if match is not None:
            # removed, so that no tensor is found for two components
            components[component] = tensors.pop(match)
    return components


def _find_component_name(
    tensor_names: Iterable[str], known_names: Sequence[str], words: Sequence[str]
) -> str | None:
    """Return the name of the tensor that is a component; None if none seems to be.

    Args:
        tensor_names: names of the tensors.
        known_names: names that the component may have.
        words: words of which one is in the name otherwise; then it has to be the only
            such name.
    """
    candidates = list(tensor_names)
    exact = [name for name in known_names if name in candidates]
    if exact:
        return exact[0]
    similar = [
        name for name in candidates if any(word in name.lower() for word in words)
    ]
    return similar[0] if len(similar) == 1 else None


def _list_named_tensors(returned: Any) -> dict[str, Tensor] | None:
    """Return the tensors of a mapping or an object by name.

    Of an object only attributes with one of `NAMES` are read. The result is None if
    `returned` is neither a mapping nor an object with boxes.
    """
    if isinstance(returned, Mapping):
        return {
            str(name): value
            for name, value in returned.items()
            if isinstance(value, Tensor)
        }
    if not any(hasattr(returned, name) for name in NAMES["boxes"]):
        return None
    known_names = [name for names in NAMES.values() for name in names]
    values = {name: getattr(returned, name, None) for name in known_names}
    return {name: value for name, value in values.items() if isinstance(value, Tensor)}


def _identify_by_shape(tensors: Sequence[Tensor]) -> dict[str, Tensor]:
    """Identify the components of a tuple by shape and type.

    Boxes have four columns. A single other tensor with the same number of axes is a
    score for every class. Otherwise there are two numbers for each box: the label has an
    integer type, or both are "score_or_label", (..., 2). Tensors that have no number for
    each box are left out.

    Raises:
        ValueError: shapes and types do not identify them.
    """
    boxes = _find_boxes_by_shape(tensors)
    shape = boxes.shape[:-1]
    others = [
        tensor
        for tensor in tensors
        if tensor is not boxes and tensor.shape[: len(shape)] == shape
    ]
    has_score_of_every_class = len(others) == 1 and others[0].ndim == boxes.ndim
    if has_score_of_every_class:
        return {"boxes": boxes, "scores": others[0]}
    numbers = [_squeeze_last(tensor, shape) for tensor in others]
    has_other_shape = any(tensor.shape != shape for tensor in numbers)
    if len(numbers) != 2 or has_other_shape:
        raise ValueError(EXPECTED)
    return {"boxes": boxes, **_identify_numbers(numbers, boxes.dtype)}


def _identify_numbers(
    numbers: Sequence[Tensor], dtype: torch.dtype
) -> dict[str, Tensor]:
    """Return scores and labels, or both as "score_or_label" (..., 2) of a dtype.

    The label has an integer type.

    Args:
        numbers: two numbers for each box.
        dtype: dtype of the result, if types do not identify them.

    Raises:
        ValueError: both are integers, so that none is a score.
    """
    integers = [tensor for tensor in numbers if not tensor.is_floating_point()]
    if len(integers) == 2:
        raise ValueError(EXPECTED)
    if integers:
        (labels,) = integers
        (scores,) = (tensor for tensor in numbers if tensor is not labels)
        return {"scores": scores, "labels": labels}
    pairs = [tensor.to(dtype) for tensor in numbers]
    return {"score_or_label": torch.stack(pairs, dim=-1)}


def _find_boxes_by_shape(tensors: Sequence[Tensor]) -> Tensor:
    """Return which of several tensors holds the boxes: it has four columns.

    Two kinds of scores have four columns, too. One score for each of exactly four boxes
    (N, 4) has an axis less than boxes (N, 4, 4). Scores of four classes (N, D, 4) have
    no values over 1, but boxes in pixels have. So of several tensors with as many axes,
    the only one with such values is chosen; otherwise the first one.

    Raises:
        ValueError: there are no boxes, or there is no other tensor.
    """
    with_four_columns = [x for x in tensors if x.ndim > 1 and x.shape[-1] == 4]
    max_ndim = max((x.ndim for x in with_four_columns), default=0)
    candidates = [x for x in with_four_columns if x.ndim == max_ndim]
    if not candidates or len(tensors) < 2:
        raise ValueError(EXPECTED)
    in_pixels = [x for x in candidates if bool((x.detach() > 1.0 + TOLERANCE).any())]
    return in_pixels[0] if len(in_pixels) == 1 else candidates[0]


def _check_detections(components: Mapping[str, Tensor]) -> Detections:
    """Return the detections of one image, checked and without rows of padding.

    Raises:
        ValueError: shapes, classes or scores are not those of detections.
    """
    boxes = _check_boxes(components)
    if "score_or_label" in components:
        return _remove_padded_pairs(boxes, components["score_or_label"].float())

    scores, labels = _check_scores(components)
    has_labels = labels is not None
    # (D, K): a score for every class, or a single one for the label of a box
    values = scores.detach()[:, None] if has_labels else scores.detach()
    is_padding = _find_padding(boxes, values, labels)
    _check_probabilities(values[~is_padding], has_labels=has_labels)
    checked = {"boxes": boxes, "scores": scores}
    if labels is not None:
        checked["labels"] = labels.long()
    detections = dict(_remove_padding(checked, is_padding, values))
    # Components of pairs "score_or_label" come here a second time, with scores and labels
    # identified. Rows of NaN were removed, and counted, the first time.
    if "n_nan_rows" in components:
        detections["n_nan_rows"] = components["n_nan_rows"]
    return detections


def _check_boxes(components: Mapping[str, Tensor]) -> Tensor:
    """Return the boxes (D, 4) of an image as floating-point numbers.

    Raises:
        ValueError: they have another shape, or a component has not a row for each.
    """
    boxes = components["boxes"]
    if boxes.numel() == 0:
        boxes = boxes.reshape(-1, 4)
    # Each component has a row for each box. Only "n_nan_rows" is a single count.
    row_tensors = [
        tensor for name, tensor in components.items() if name != "n_nan_rows"
    ]
    if (
        boxes.ndim != 2
        or boxes.shape[1] != 4
        or any(len(tensor) != len(boxes) for tensor in row_tensors)
    ):
        raise ValueError(EXPECTED)
    return boxes.float()


def _find_padding(boxes: Tensor, scores: Tensor, labels: Tensor | None) -> Tensor:
    """Return which rows of detections are padding, (D,) bool.

    Networks with a fixed number of rows fill unused rows with a score or a class of -1,
    or with an invalid box (such as zeros) and no score over 0.

    Args:
        boxes: (D, 4).
        scores: scores of each box, (D, K): for every class, or one for its label.
        labels: class of each box, (D,); None if there is a score for every class.
    """
    has_score = (scores > 0.0).any(dim=1)
    is_marked = (scores == -1.0).all(dim=1)
    is_padding = (are_invalid(boxes.detach()) & ~has_score) | is_marked
    if labels is not None:
        is_padding = is_padding | (labels < 0)
    return is_padding


def _remove_padded_pairs(boxes: Tensor, pairs: Tensor) -> Detections:
    """Return boxes with their pairs ("score_or_label"), without rows of padding.

    Such a row has an invalid box, and at least one of its two numbers is not positive
    (or NaN).

    Args:
        boxes: (D, 4).
        pairs: (D, 2) a score and a label, in an unknown order.
    """
    numbers = pairs.detach()
    are_positive = (numbers > 0.0).all(dim=1)
    is_padding = are_invalid(boxes.detach()) & ~are_positive
    components = {"boxes": boxes, "score_or_label": pairs}
    return _remove_padding(components, is_padding, numbers)


def _check_scores(components: Mapping[str, Tensor]) -> tuple[Tensor, Tensor | None]:
    """Check the scores and labels of detections, and return them.

    A label that is NaN makes the score of its box NaN, so that the output counts as
    broken. Labels are None if there is a score for every class.

    Raises:
        ValueError: the shapes do not match, or a label is not an integer.
    """
    scores = components["scores"].float()
    labels = components.get("labels")
    if labels is None:
        if scores.ndim != 2:
            raise ValueError(EXPECTED)
        return scores, None
    if scores.ndim != 1 or labels.shape != scores.shape:
        raise ValueError(EXPECTED)
    if labels.is_floating_point():
        is_nan = labels.detach().isnan()
        scores = scores.masked_fill(is_nan, math.nan)
        labels = labels.detach().masked_fill(is_nan, 0.0)
        if bool((labels != labels.round()).any()):
            raise ValueError("expected classes that are whole numbers")
    return scores, labels


def _check_probabilities(values: Tensor, *, has_labels: bool) -> None:
    """Raise ValueError if a score is outside [0, 1].

    NaN and plus infinity are no error here: they make an output broken, which is found
    later. Scores without labels may be logits of a DETR, and the message names the option
    that states this.

    Args:
        values: scores, of any shape.
        has_labels: whether each box has a label and a single score.
    """
    is_too_low = values < -TOLERANCE  # also minus infinity, which logits may be
    is_too_high = (values > 1.0 + TOLERANCE) & values.isfinite()
    if not bool((is_too_low | is_too_high).any()):
        return
    advice = ""
    if not has_labels:
        options = [format_detection_option(f"order: {order}") for order in QUERIES]
        advice = f", or set {' or '.join(options)}"
    raise ValueError(
        "expected scores that are probabilities in [0, 1]; apply a sigmoid or a "
        f"softmax to them{advice}"
    )


def _remove_padding(
    components: dict[str, Tensor], is_padding: Tensor, values: Tensor
) -> Detections:
    """Return the components of an image without rows of padding.

    If some of the removed rows are all NaN, their count is added as "n_nan_rows": an
    output without other rows may be broken.

    Args:
        components: components of one image, with a row for each box.
        is_padding: which rows are padding, (D,) bool.
        values: scores of each box, or its score and label, (D, K).
    """
    if not bool(is_padding.any()):
        return components
    is_nan_box = components["boxes"].detach().isnan().all(dim=1)
    is_nan_row = is_padding & values.isnan().all(dim=1) & is_nan_box
    remaining = {name: tensor[~is_padding] for name, tensor in components.items()}
    if bool(is_nan_row.any()):
        remaining["n_nan_rows"] = is_nan_row.sum()[None]
    return remaining


# ---- scores and classes by their values ----


def resolve_detections(
    detections: Detections, order: str = "", classes: int | None = None
) -> Detections:
    """Return the detections of an image with boxes, scores and labels identified.

    Args:
        detections: detections of one image. They may still have a "grid" (output of a
            YOLO head), "logits" (of a DETR), or "score_or_label" (two numbers for each
            box, of which one is the score).
        order: one of `ORDERS` or `QUERIES`, or of `HEADS` with a layout; "" to infer
            it from the values.
        classes: number of classes; None if it is unknown.

    Raises:
        ValueError: the values do not show the order, or contradict it.
    """
    if "grid" in detections or "logits" in detections:
        if classes is None:
            # Without the number of classes it can't be read. The message lists the outputs
            # that can.
            raise ValueError(EXPECTED)
        order = order or infer_order([detections], classes)
        return _check_detections(_split_by_class_count(detections, classes, order))
    if "score_or_label" in detections:
        order = order or infer_order([detections], classes)
        return _resolve_pairs(detections, order)
    # Scores and labels are known already. The channels of feature maps are only needed to
    # identify them.
    return {name: value for name, value in detections.items() if name != "map_channels"}


def _split_by_class_count(
    detections: Detections, classes: int, order: str
) -> dict[str, Tensor]:
    """Return boxes (D, 4) and scores (D, C) of a YOLO grid ("grid") or of DETR logits.

    Args:
        detections: detections of one image.
        classes: number of classes, C.
        order: one of `HEADS` with a layout for a grid, one of `QUERIES` for logits.
    """
    if "grid" in detections:
        boxes, scores = split_grid(detections["grid"], classes, order)
        return {"boxes": boxes, "scores": scores}
    logits = detections["logits"]
    if order == SOFTMAX_QUERIES:
        scores = logits.softmax(dim=1)[:, :classes]  # without a last class for nothing
    else:
        scores = logits.sigmoid()
    return {"boxes": detections["boxes"], "scores": scores}


def _resolve_pairs(detections: Detections, order: str) -> Detections:
    """Replace the pairs of numbers of an image ("score_or_label") by scores and labels.

    They are a score and a label, or two scores.

    Args:
        detections: detections of one image.
        order: order of the numbers: one of `ORDERS`, or one of `HEAD_ORDERS` if both
            are scores; "" if it is unknown.

    Raises:
        ValueError: the order is unknown, and there are boxes with a positive number or
            NaN.
    """
    pairs = detections["score_or_label"]
    if not order:
        _check_no_values(detections)
        order = SCORES_FIRST  # no box has a score, so that the order does not matter
    if order in HEAD_ORDERS:
        scores = _compute_pair_scores(pairs, order)
        return _check_detections({"boxes": detections["boxes"], "scores": scores})
    components = {
        name: value
        for name, value in detections.items()
        if name not in ("score_or_label", "map_channels")
    }
    names = ("scores", "labels") if order == SCORES_FIRST else ("labels", "scores")
    components.update(zip(names, pairs.unbind(dim=1), strict=True))
    return _check_detections(components)


def _compute_pair_scores(pairs: Tensor, order: str) -> Tensor:
    """Return the scores (D, classes) in pairs (D, 2) by an order of `HEAD_ORDERS`.

    Both numbers are scores of classes; or the first is objectness, the probability of
    any object in the box, and the score of the only class is their product.
    """
    has_objectness = order.startswith(OBJECTNESS_HEAD)
    return pairs.prod(dim=1, keepdim=True) if has_objectness else pairs


def _check_no_values(detections: Detections) -> None:
    """Raise ValueError if a pair of an image has a positive number or NaN."""
    is_nan = detections["score_or_label"].isnan().any(dim=1)
    has_values = are_counted_boxes(detections) | is_nan
    if bool(has_values.any()):
        raise ValueError(
            "the output does not show which of a box's two numbers is its score; "
            f"{ORDER_ADVICE}"
        )


def infer_order(
    detections_of_images: Sequence[Detections],
    classes: int | None = None,
    head: str = "",
) -> str:
    """Infer from values and sizes in which order a network returns scores and classes.

    The order of logits and grids follows from the number of classes, and is unknown
    without that. The order of two numbers of a box follows from their values
    (`_infer_pair_order`): a class is an integer, and a score is in [0, 1] and does not
    rise from box to box, since suppression sorts by score. If neither is a class, both
    are scores.

    Args:
        detections_of_images: detections of images.
        classes: number of classes; None if it is unknown.
        head: one of `HEADS` or `QUERIES` that the user stated for outputs in one
            tensor, or "".

    Returns:
        One of `ORDERS` or `QUERIES`, or of `HEADS` with its layout; "" if the
        detections leave it open.

    Raises:
        ValueError: no number can be a score, or none a class; or a grid of boxes has
            none or several of the orders; or the number of logits does not fit that of
            the classes.
    """
    if classes is not None:
        logits = [x["logits"] for x in detections_of_images if "logits" in x]
        if logits:
            n_logits = logits[0].shape[1]  # the same for all images
            return _infer_logit_order(n_logits, classes, head)
        grids = [x for x in detections_of_images if "grid" in x]
        if grids:
            return _infer_grid_order(grids, classes, head)
    return _infer_pair_order(detections_of_images, classes)


def _infer_logit_order(n_logits: int, classes: int, head: str) -> str:
    """Infer the order of a DETR output, one of `QUERIES`, from its number of logits.

    Without an order of the user, one logit more than classes stands for "no object", and
    the scores are a softmax. Otherwise they are sigmoids.

    Args:
        n_logits: number of logits of a box.
        classes: number of classes.
        head: one of `QUERIES` that the user stated, or "".

    Raises:
        ValueError: the number fits neither head; the message names sets of labels that
            would fit.
    """
    has_nothing_logit = n_logits == classes + 1
    order = head
    if not order:
        order = SOFTMAX_QUERIES if has_nothing_logit else SIGMOID_QUERIES
    # With a softmax there is a class for no object. It may be one of the labels, and is
    # then counted in `classes`; otherwise there is one logit more than classes.
    allows_nothing_logit = order == SOFTMAX_QUERIES
    if n_logits == classes or (allows_nothing_logit and has_nothing_logit):
        return order
    raise ValueError(
        f"expected {classes} logits of a box for {classes} classes, or "
        f"{classes + 1} with one for nothing, got {n_logits}; "
        f"{_advise_on_logits(n_logits)}"
    )


def _advise_on_logits(n_logits: int) -> str:
    """Return what to do about a number of logits that does not fit the classes."""
    # sets of labels with as many classes, without or with a logit for no object
    fitting_sets = dict.fromkeys(
        [*list_sets_of_size(n_logits), *list_sets_of_size(n_logits - 1)]
    )
    fitting = [f"`labels={name}`" for name in fitting_sets]
    if fitting:
        return f"{' or '.join(fitting)} would fit"
    return "set the `labels` of its classes"


def _infer_grid_order(grids: Sequence[Detections], classes: int, head: str) -> str:
    """Return the only order (such as "boxes scores channels first") that fits the YOLO
    grids of all images.

    Args:
        grids: detections with a "grid" each.
        classes: number of classes.
        head: one of `HEADS`, with or without a layout, that the user stated, or "".

    Raises:
        ValueError: no order fits all of them, or several do.
    """
    orders_of_images = []
    for detections in grids:
        map_channels = detections["map_channels"].tolist()
        fitting = find_head_orders(detections["grid"], map_channels, classes, head)
        orders_of_images.append(set(fitting))
    orders = set.intersection(*orders_of_images)
    if not orders:
        raise ValueError("the numbers of different pictures have different orders")
    if len(orders) > 1:
        options = [format_detection_option(f"order: {name}") for name in sorted(orders)]
        raise ValueError(
            "the output does not show the order of its numbers; set "
            f"{' or '.join(options)}"
        )
    return orders.pop()


def _infer_pair_order(
    detections_of_images: Sequence[Detections], classes: int | None
) -> str:
    """Infer the order of the two numbers of boxes ("score_or_label"); "" if unknown.

    Scores are in [0, 1], and classes are integers. If that allows both orders, the scores
    are in the column that never rises within an image, since suppression sorts boxes by
    score. If neither column can be classes, both are scores
    (`_infer_order_without_labels`).

    Args:
        detections_of_images: detections of images.
        classes: number of classes; None if it is unknown.

    Raises:
        ValueError: the numbers are neither scores nor classes.
    """
    pairs_of_images = _collect_pairs(detections_of_images)
    if not any(map(len, pairs_of_images)):
        return ""
    columns = torch.cat(pairs_of_images).unbind(dim=1)
    orders = _find_fitting_orders(columns, classes)
    if len(orders) > 1:
        # Numbers such as 0 and 1 may be scores or classes.
        return _find_falling_order(pairs_of_images)
    if orders:
        return orders[0]
    return _infer_score_order(detections_of_images, columns, classes)


def _infer_score_order(
    detections_of_images: Sequence[Detections],
    columns: Sequence[Tensor],
    classes: int | None,
) -> str:
    """Infer the order of two numbers of boxes of which neither seems to be a class.

    Args:
        detections_of_images: detections of images.
        columns: the first and the second number of all their boxes, (D,) each.
        classes: number of classes; None if it is unknown.

    Raises:
        ValueError: the numbers are neither scores nor classes.
    """
    are_scores = all(map(_may_be_scores, columns))
    order = _infer_order_without_labels(columns, classes) if are_scores else ""
    if order:
        return order
    if classes is not None:
        # An index may be too large because the number of classes is wrong: try without
        # that number.
        return _infer_pair_order(detections_of_images, classes=None)
    raise ValueError(
        "expected for each box a score in [0, 1] and the index of a "
        "class, got other numbers"
    )


def _find_fitting_orders(columns: Sequence[Tensor], classes: int | None) -> list[str]:
    """Return those of `ORDERS` in which two columns of numbers can be read.

    Args:
        columns: two columns (K,) of numbers of boxes.
        classes: number of classes; None if it is unknown.
    """
    first, second = columns
    max_classes = math.inf if classes is None else classes
    orders = []
    if _may_be_scores(first) and _may_be_classes(second, max_classes):
        orders.append(SCORES_FIRST)
    if _may_be_scores(second) and _may_be_classes(first, max_classes):
        orders.append(LABELS_FIRST)
    return orders


def _find_falling_order(pairs_of_images: Sequence[Tensor]) -> str:
    """Return the order in which the column that falls has the scores; "" if both
    columns fall, or none does.
    """
    fits_scores_first = _is_falling(pairs_of_images, column=0)
    fits_labels_first = _is_falling(pairs_of_images, column=1)
    if fits_scores_first == fits_labels_first:
        return ""
    return SCORES_FIRST if fits_scores_first else LABELS_FIRST


def _infer_order_without_labels(columns: Sequence[Tensor], classes: int | None) -> str:
    """Return the order of boxes that have two scores and no class; "" if unknown.

    They are the scores of two classes; or, with a single class, objectness (the
    probability of any object) and the score of that class. If a column has only
    integers, such as 0 and 1, it may hold classes, and the result is "".

    Args:
        columns: the two numbers of all boxes, (D,) each, in [0, 1].
        classes: number of classes; None if it is unknown.
    """
    has_integers = any(bool((x == x.round()).all()) for x in columns)
    if has_integers or classes not in (1, 2):
        return ""
    head = PLAIN_HEAD if classes == 2 else OBJECTNESS_HEAD
    return f"{head} {CHANNELS_LAST}"


def _collect_pairs(detections_of_images: Sequence[Detections]) -> list[Tensor]:
    """Return the pairs "score_or_label" (K, 2) of each image that has such pairs.

    Only finite pairs of boxes that count (`are_counted_boxes`) are returned.
    """
    pairs_of_images = []
    for detections in detections_of_images:
        if "score_or_label" in detections:
            pairs = detections["score_or_label"][are_counted_boxes(detections)]
            is_finite = pairs.isfinite().all(dim=1)
            pairs_of_images.append(pairs[is_finite].detach())
    return pairs_of_images


def _may_be_classes(values: Tensor, max_classes: float) -> bool:
    """Return whether all values can be class indices, or -1 for no class."""
    is_integer = values == values.round()
    return bool((is_integer & (values >= -1.0) & (values < max_classes)).all())


def _may_be_scores(values: Tensor) -> bool:
    """Return whether all values are in [0, 1]."""
    return bool(((values >= -TOLERANCE) & (values <= 1.0 + TOLERANCE)).all())


def _is_falling(pairs_of_images: Sequence[Tensor], column: int) -> bool:
    """Return whether a column never rises within any image."""
    return all(
        bool((pairs[:, column].diff() <= 0.0).all()) for pairs in pairs_of_images
    )


# ---- one tensor, as YOLO networks return it ----
#
# It is (A, B) for each image: "channels first" (boxes are columns: v8 to v12, YOLO11)
# or "channels last" (boxes are rows: v5 to v7, YOLOX, RT-DETR). The channels of a box
# are its center, width and height, in older versions objectness, by which the scores
# are multiplied, a score of each class, and mask coefficients.


def find_head_orders(
    returned: Tensor, map_channels: Collection[int], classes: int, order: str = ""
) -> tuple[str, ...]:
    """Return the orders in which the output (A, B) of one image can be read.

    An order says which channels are boxes, objectness and scores, and whether channels
    are the first or the last axis. It fits if the output has its number of channels,
    and the scores read in this order lie in [0, 1].

    Args:
        returned: output of a YOLO head for one image.
        map_channels: numbers of channels of feature maps that came with it, which may
            be mask coefficients.
        classes: number of classes.
        order: one of `HEADS`, with or without a layout, that narrows the orders.

    Returns:
        Orders such as "boxes scores channels first".

    Raises:
        ValueError: it has none of them, or it may be the output of an OBB head; the
            message states what it seems to be.
    """
    orders = list[str]()
    # Why no order fits, for the message: an angle if possible, otherwise the first reason.
    problem = ""
    for name in _list_orders_of_size(returned.shape, map_channels, classes, order):
        _, scores = split_grid(returned, classes, name, multiply_objectness=False)
        new_problem = _describe_misread_scores(scores.detach(), name)
        if not new_problem:
            orders.append(name)
        elif not problem or new_problem == _ANGLE_PROBLEM:
            problem = new_problem
    if not order:
        _check_no_angle(orders, classes)
    if orders:
        return tuple(orders)
    if problem:
        raise ValueError(f"it has {problem}")
    raise _make_channel_error((returned.shape[0], returned.shape[1]), classes)


def _describe_misread_scores(scores: Tensor, order: str) -> str:
    """Describe scores that are outside [0, 1] if an output is read in an order.

    The text is empty if none is. Scores that are not finite make an output broken, in
    any order.

    Args:
        scores: scores that are read in this order; the last axis is that of classes.
        order: the order.
    """
    is_outside = (scores < -TOLERANCE) | (scores > 1.0 + TOLERANCE)
    if not bool((is_outside & scores.isfinite()).any()):
        return ""
    is_only_last_outside = not bool(is_outside[:, :-1].any())
    if order == _OBB_LIKE_ORDER and is_only_last_outside:
        # The last channel is no score but an angle.
        return _ANGLE_PROBLEM
    return (
        f"scores from {float(scores.min()):.3g} to "
        f"{float(scores.max()):.3g} if it is read as '{order}'; "
        "expected probabilities in [0, 1]: apply a sigmoid to them"
    )


def _check_no_angle(orders: list[str], classes: int) -> None:
    """Raise ValueError if an output may be that of an OBB head, by its only order.

    An OBB head (box, scores, angle) has as many channels as a head with objectness (box,
    objectness, scores). If its angle is in [0, 1], both look the same. So this order is
    accepted only if the user states it.

    Args:
        orders: orders that fit the output.
        classes: number of classes.
    """
    if orders == [_OBB_LIKE_ORDER]:
        raise ValueError(
            f"its {5 + classes} channels may be those of an OBB head (with an angle), "
            f"{_UNREAD}; if it has objectness, set `task='detection={{order: "
            f"{_OBB_LIKE_ORDER}}}'`"
        )


def _list_orders_of_size(
    shape: Sequence[int], map_channels: Collection[int], classes: int, order: str
) -> Iterator[str]:
    """Yield the orders whose number of channels fits the output (A, B) of one image.

    Channels that the box and the scores leave over have to be mask coefficients; there
    are as many of them as a feature map has channels.

    Args:
        shape: sizes of the output, (A, B).
        map_channels: numbers of channels of feature maps that came with the output.
        classes: number of classes.
        order: one of `HEADS`, with or without a layout, to try alone; "" for all.
    """
    # The first layout has channels on the first axis, the second on the last.
    for layout, n_channels in zip(LAYOUTS, shape, strict=True):
        for head, n_channels_before_scores in HEADS.items():
            name = f"{head} {layout}"
            is_tried = order in ("", head, name)
            n_left_over = n_channels - n_channels_before_scores - classes
            if is_tried and n_left_over in (0, *map_channels):
                yield name


def _make_channel_error(shape: tuple[int, int], classes: int) -> ValueError:
    """Return the error for an output whose number of channels fits no YOLO head.

    Args:
        shape: sizes of the output of one image. The smaller one is taken for the number
            of channels, since there are usually more boxes than channels.
        classes: number of classes.
    """
    n_channels = min(shape)
    # With channels as the last axis, boxes are rows.
    is_channels_last = shape[0] >= shape[1]
    advice = _advise_on_channels(n_channels, classes, may_be_rows=is_channels_last)
    noun = "classes" if classes > 1 else "class"
    return ValueError(
        f"expected 4 + {classes} or 5 + {classes} numbers of a box for "
        f"{classes} {noun}, got {n_channels}{advice}"
    )


def _advise_on_channels(n_channels: int, classes: int, *, may_be_rows: bool) -> str:
    """Return the end of the message about a number of channels that does not fit.

    It explains what the channels other than boxes and scores seem to be, and what the
    user can do.

    Args:
        n_channels: number of channels of a box.
        classes: number of classes.
        may_be_rows: whether boxes are rows; these may begin with a box, a score and a
            class.
    """
    fitting = _list_fitting_labels(n_channels)
    if fitting:
        return f"; {' or '.join(fitting)} would fit"
    # channels after the box and a score for every class
    excess_channels = {n_channels - 4 - classes}
    if may_be_rows:  # or after the box, a score and a class
        excess_channels.add(n_channels - 4 - 2)
    # OBB heads have 1 channel in excess (an angle), YOLO's masks 32, and a keypoint 3.
    if 1 in excess_channels:
        return f", as OBB heads (oriented boxes, with an angle) have it, {_UNREAD}"
    if 32 in excess_channels:
        return (
            ", as with mask coefficients, but the network returned no prototypes (N, "
            "32, h, w) with them"
        )
    if any(excess > 0 and excess % 3 == 0 for excess in excess_channels):
        return (
            f", as pose heads (with keypoints) have it, {_UNREAD}; or set the "
            "`labels` of the model's classes"
        )
    return "; set the `labels` of the model's classes"


def _list_fitting_labels(n_channels: int) -> list[str]:
    """Return the settings of known label sets that fit a number of channels.

    Such a set has as many classes as there are channels from the first score on.
    """
    return [
        f"`labels={name}`"
        for n_channels_before_scores in HEADS.values()
        for name in list_sets_of_size(n_channels - n_channels_before_scores)
    ]


def split_grid(
    returned: Tensor, classes: int, order: str, *, multiply_objectness: bool = True
) -> tuple[Tensor, Tensor]:
    """Split the output (A, B) of one image into boxes and scores; differentiable.

    Args:
        returned: the output.
        classes: number of classes.
        order: one of `HEADS` with a layout.
        multiply_objectness: multiply the scores by objectness, if there is any.

    Returns:
        Boxes (D, 4) and scores (D, classes); (D, 1 + classes), objectness first, if it
        is not multiplied.
    """
    rows = returned.T if order.endswith(CHANNELS_FIRST) else returned
    boxes = rows[:, :4]
    if not order.startswith(OBJECTNESS_HEAD):
        return boxes, rows[:, 4 : 4 + classes]
    objectness = rows[:, 4:5]
    scores = rows[:, 5 : 5 + classes]
    if multiply_objectness:
        return boxes, objectness * scores
    return boxes, torch.cat([objectness, scores], dim=1)
