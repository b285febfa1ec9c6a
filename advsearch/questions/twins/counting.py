"""Count how far predictions about twins hold for photographs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from advsearch.extend import results, statistics
from advsearch.questions.twins.result import FactorPart, TwinPrediction, TwinRow

BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]

N_PARTS = 3  # number of parts of equal size into which a factor is divided
MIN_ROWS_PER_PART = 10
MIN_BOX_OVERLAP = 0.5  # minimum intersection over union of boxes that agree
Box = tuple[float, float, float, float]  # x, y, width and height


def make_table(
    rows: Sequence[TwinRow], surroundings: Sequence[str], task: str
) -> list[results.TwinAgreement]:
    """Return the agreement by model and surroundings: total, by object, by condition."""
    table = []
    for model in dict.fromkeys(row.model for row in rows):
        of_model = [row for row in rows if row.model == model]
        table += _make_model_table(of_model, surroundings, model, task)
    return table


def _make_model_table(
    rows: Sequence[TwinRow], surroundings: Sequence[str], model: str, task: str
) -> list[results.TwinAgreement]:
    """Return the rows of a table that are about one model.

    There is a row over all objects, one for each object if there are several, and one
    for each condition, such as "night".

    Args:
        rows: rows of the model.
        surroundings: names of the surroundings of twins, such as environments.
        model: name of the model.
        task: title of the task.
    """
    return [
        count_agreement(
            group,
            name,
            model=model,
            task=task,
            object_name=object_name,
            condition=condition,
        )
        for name in surroundings
        for object_name, condition, group in _list_groups(rows)
    ]


def _list_groups(
    rows: Sequence[TwinRow],
) -> list[tuple[str, str, Sequence[TwinRow]]]:
    """Return all rows, those of each object if there are several, and of each condition.

    Each group is (object, condition, rows); an empty name stands for all. There are no
    empty groups.
    """
    objects = sorted({row.object for row in rows})
    conditions = sorted({row.condition for row in rows if row.condition})
    groups: list[tuple[str, str, Sequence[TwinRow]]] = [("", "", rows)]
    if len(objects) > 1:
        for name in objects:
            groups.append((name, "", [row for row in rows if row.object == name]))
    for name in conditions:
        groups.append(("", name, [row for row in rows if row.condition == name]))
    return [group for group in groups if group[2]]


def count_agreement(
    rows: Sequence[TwinRow],
    surroundings: str,
    *,
    model: str,
    task: str,
    object_name: str = "",
    condition: str = "",
) -> results.TwinAgreement:
    """Count how often a model is right in both photograph and twin, or in neither.

    Intervals are over frames, as objects in one frame are not independent. `kappa` of
    the result is Cohen's kappa: agreement beyond chance.

    Args:
        rows: rows of one model, at least one.
        surroundings: name of the twins' surroundings, such as an environment.
        model: name of the model, for the result.
        task: title of the task, for the result.
        object_name: object of all rows; empty if they have several.
        condition: condition of all rows; empty if they have several.
    """
    units = number_units(rows)
    photos = [row.photo for row in rows]
    twins = [row.twin(surroundings) for row in rows]
    photo_wrong = np.array([not photo.right for photo in photos])
    twin_wrong = np.array([not twin.right for twin in twins])
    agrees = photo_wrong == twin_wrong
    return results.TwinAgreement(
        model=model,
        task=task,
        surroundings=surroundings,
        object=object_name,
        condition=condition,
        pairs=len(rows),
        frames=len(np.unique(units)),
        wrong_photos=int(photo_wrong.sum()),
        wrong_twins=int(twin_wrong.sum()),
        both_wrong=int((photo_wrong & twin_wrong).sum()),
        photo_right=estimate_rate(~photo_wrong, units),
        twin_right=estimate_rate(~twin_wrong, units),
        agreement=estimate_rate(agrees, units),
        kappa=estimate_kappa(photo_wrong, twin_wrong, units),
        margins=estimate_margin_correlation(photos, twins, units),
        boxes=estimate_box_agreement(rows, surroundings),
        photo_wrong=estimate_rate(photo_wrong, units),
        wrong_where_twin_wrong=estimate_conditional(photo_wrong, twin_wrong, units),
    )


def number_units(rows: Sequence[TwinRow]) -> IntArray:
    """Number the frames, and return the number (n,) of each row's frame.

    Frames are the independent units: rows of one frame are not independent.
    """
    names = [row.frame for row in rows]
    return np.unique(names, return_inverse=True)[1].reshape(-1).astype(np.int64)


def estimate_rate(happens: BoolArray, units: IntArray) -> results.Estimate:
    """Return the mean rate of an event over units, with its interval."""
    value, interval = statistics.agreement.estimate_rate(happens, units)
    return results.Estimate(value=value, interval=interval)


def estimate_conditional(
    event: BoolArray, condition: BoolArray, units: IntArray
) -> results.Estimate | None:
    """Return the rate of an event where another happens; None if in too few units."""
    n_units = statistics.agreement.count_units(condition, units)
    if n_units < statistics.agreement.MIN_UNITS:
        return None
    return estimate_rate(event[condition], units[condition])


def estimate_kappa(
    photo_wrong: BoolArray, twin_wrong: BoolArray, units: IntArray
) -> results.Estimate | None:
    """Return Cohen's kappa, the agreement of right and wrong beyond chance.

    None if the predictions about the photographs, or those about the twins, are wrong
    in too few units: then the interval would say nothing. How few are right does not
    matter.
    """
    agreement = statistics.agreement
    for wrong in (photo_wrong, twin_wrong):
        n_units_with_wrong = agreement.count_units(wrong, units)
        if n_units_with_wrong < agreement.MIN_UNITS:
            return None
    return _estimate_coefficient(
        agreement.compute_kappa, photo_wrong, twin_wrong, units
    )


def estimate_margin_correlation(
    photos: Sequence[TwinPrediction], twins: Sequence[TwinPrediction], units: IntArray
) -> results.Estimate | None:
    """Return the rank correlation of margins in photographs and twins.

    It is None if it has no interval, for example if there are too few frames.

    Args:
        photos, twins: predictions on both, in the same order.
        units: number of the frame of each row (n,).
    """
    first = np.array([photo.margin for photo in photos])
    second = np.array([twin.margin for twin in twins])
    is_known = np.isfinite(first) & np.isfinite(second)
    return _estimate_coefficient(
        statistics.agreement.compute_rank_correlation,
        first[is_known],
        second[is_known],
        units[is_known],
    )


def estimate_box_agreement(
    rows: Sequence[TwinRow], surroundings: str
) -> results.Estimate | None:
    """Return how often a detector's boxes agree in photograph and twin.

    In each, the best box of the right class is used. Rows in which one of them has no
    such box are left out. Boxes agree if their intersection over union is at least
    `MIN_BOX_OVERLAP`. The result is None without rows.

    Args:
        rows: rows of one model.
        surroundings: name of the twins' surroundings.
    """
    agrees = []
    used_rows = []
    for row in rows:
        first = find_box(row.photo.payload, row.label)
        second = find_box(row.twin(surroundings).payload, row.label)
        if first is not None and second is not None:
            agrees.append(compute_box_iou(first, second) >= MIN_BOX_OVERLAP)
            used_rows.append(row)
    if not used_rows:
        return None
    # Rows of one frame are not independent.
    return estimate_rate(np.array(agrees), number_units(used_rows))


def find_box(payload: Any, label: str) -> Box | None:
    """Return the best box of a class, x, y, width and height in pixels.

    None if the payload of a prediction is not a detector's, or has no such box.
    """
    if not isinstance(payload, dict):
        return None
    # A detector stores its detections under "found", the best first.
    for detection in payload.get("found") or []:
        if detection["label"] == label:
            left, top, right, bottom = detection["box"]
            return left, top, right - left, bottom - top
    return None


def compute_box_iou(first: Box, second: Box) -> float:
    """Return the intersection over union of two boxes (x, y, width, height)."""
    first_x, first_y, first_width, first_height = first
    second_x, second_y, second_width, second_height = second
    right = min(first_x + first_width, second_x + second_width)
    bottom = min(first_y + first_height, second_y + second_height)
    # below 0 if the boxes do not overlap
    width = right - max(first_x, second_x)
    height = bottom - max(first_y, second_y)
    overlap = max(width, 0.0) * max(height, 0.0)
    union = first_width * first_height + second_width * second_height - overlap
    return overlap / union if union > 0.0 else 0.0


def _estimate_coefficient(
    statistic: Callable[..., float],
    first: npt.NDArray[np.generic],
    second: npt.NDArray[np.generic],
    units: IntArray,
) -> results.Estimate | None:
    """Return a statistic of two arrays (n,), with its interval over units (n,).

    None if it has no interval.
    """
    interval = statistics.agreement.correlation_interval(
        statistic, first, second, units
    )
    if interval is None:
        return None
    return results.Estimate(value=statistic(first, second), interval=interval)


FACTORS: dict[str, tuple[str, Callable[[TwinRow], float | None]]] = {
    "size of the object": ("pixels", lambda row: row.size),
    "twin brighter than the photograph": ("", lambda row: row.brightness),
    "contrast of the background": ("", lambda row: row.contrast),
    "likeness of the texture": ("", lambda row: row.texture),
    "visible fraction": ("", lambda row: row.visible),
    "overlap of the silhouettes": ("", lambda row: row.overlap),
}
"""What may explain disagreement: the unit, and a function that reads it from a row."""


def explain_disagreement(
    rows: Sequence[TwinRow], surroundings: str
) -> list[FactorPart]:
    """Return how often photograph and twin disagree, by parts of each factor.

    A factor is a property such as the object's size. It is divided into `N_PARTS` parts
    with equally many rows. A factor is left out if it is constant, or known for too few
    rows.

    Args:
        rows: rows of all models.
        surroundings: name of the twins' surroundings.
    """
    parts: list[FactorPart] = []
    for name, (unit, get_value) in FACTORS.items():
        values = []
        known_rows = []
        for row in rows:
            value = get_value(row)
            if value is not None:
                values.append(value)
                known_rows.append(row)
        if len(known_rows) >= N_PARTS * MIN_ROWS_PER_PART:
            parts += _cut_factor(name, unit, np.array(values), known_rows, surroundings)
    return parts


def _cut_factor(
    name: str,
    unit: str,
    values: npt.NDArray[np.float64],
    rows: Sequence[TwinRow],
    surroundings: str,
) -> Iterator[FactorPart]:
    """Yield the parts of a factor with values (n,) of its rows.

    A factor is a property of the photographs, such as the object's size. A part has the
    rows between two quantiles of its values. If quantiles coincide, as those of a
    constant do, nothing is yielded.

    Args:
        name, unit: name and unit of the factor.
        values: value of the factor in each row (n,).
        rows: the rows.
        surroundings: name of the twins that are compared with the photographs.
    """
    edges = np.quantile(values, np.linspace(0.0, 1.0, N_PARTS + 1))
    if len(np.unique(edges)) <= N_PARTS:
        return
    part_of_row = _assign_to_parts(values, edges)
    units = number_units(rows)
    disagrees = _find_disagreements(rows, surroundings)
    for part in range(N_PARTS):
        inside = part_of_row == part
        yield FactorPart(
            factor=name,
            unit=unit,
            lower=float(edges[part]),
            upper=float(edges[part + 1]),
            pairs=int(inside.sum()),
            disagreeing=int(disagrees[inside].sum()),
            rate=estimate_rate(disagrees[inside], units[inside]),
        )


def _assign_to_parts(
    values: npt.NDArray[np.float64], edges: npt.NDArray[np.float64]
) -> npt.NDArray[np.intp]:
    """Return for each value (n,) the index of the part between two edges it lies in.

    The last edge, which is the largest value, belongs to the last part.
    """
    part_of_value = np.searchsorted(edges, values, side="right") - 1
    return np.clip(part_of_value, 0, N_PARTS - 1)


def _find_disagreements(rows: Sequence[TwinRow], surroundings: str) -> BoolArray:
    """Return whether only one of photograph and twin is right, for each row (n,)."""
    disagrees = [row.photo.right != row.twin(surroundings).right for row in rows]
    return np.array(disagrees)
