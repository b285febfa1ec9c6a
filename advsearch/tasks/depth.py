"""Task for depth: does a model predict the object at its true distance?

Models predict z-depth, the distance along the camera's axis. Relative models predict it,
or its inverse (disparity), up to a scale and a shift. These are fitted by least squares
(Ranftl et al. 2020, "Towards robust monocular depth estimation", arXiv 1907.01341,
sections 5 and 6). The fit uses the pixels outside the object, so that a wrong prediction
about the object does not change it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from advsearch.extend import InputError, Model, Task, tasks

# Minimum cosine of the angle to the camera's axis at which z-depth is a distance.
MIN_AXIS_COSINE = 0.1
DISPARITY = "relative disparity"
RELATIVE = "relative depth"
METRIC = "metric depth"

KINDS = {
    DISPARITY: "the inverse of the distance, up to a scale and a shift",
    RELATIVE: "the distance, up to a scale and a shift",
    METRIC: "the distance in metres",
}
"""Kinds of values that a model may predict, with a description."""

AS_FAR = "as far as it is"
OUT_OF_SHAPE = "out of shape"
NEARER = "nearer than it is"
FARTHER = "farther than it is"
AS_BACKGROUND = "as far as what is behind it"
LABELS = {"nearer": NEARER, "farther": FARTHER, "gone": AS_BACKGROUND}
GOALS = {
    "nearer": f"the object is judged {NEARER}",
    "farther": f"the object is judged {FARTHER}",
    "gone": f"the object is judged to be {AS_BACKGROUND}",
}
"""Goals of an attack, by the name of the objective."""

MIN_FIT_PIXELS = 16
MIN_DISTANCE_RATIO = 1.1
"""Minimum number of pixels outside the object for the fit of scale and shift, and
minimum ratio of their largest to their smallest distance.
"""
MAX_FACTOR = 100.0  # maximum factor by which a pixel counts as too near or too far
# smallest distance that is drawn: a predicted distance may be 0 or negative
MIN_MAP_DISTANCE = 1.0 / MAX_FACTOR

DepthMap = Mapping[str, Tensor]
"""The output for one image: a single map (h, w). Its key is the kind of its values, one of
`KINDS`, or "" if the network does not state the kind.
"""


@dataclass(frozen=True, eq=False)
class DepthTruth:
    """The truth of depth: the true distances in an image.

    Attributes:
        mask: (H, W) bool, the pixels in which the object is visible.
        z_depth: (H, W) z-depth of the visible surfaces, infinite where there is none; in
            metres, or in object sizes if `size_in_metres` is None.
        size_in_metres: size of the object's longest side; None if it is unknown.
    """

    mask: Tensor
    z_depth: Tensor
    size_in_metres: float | None = None

    @property
    def is_visible(self) -> bool:
        """Whether any of the object is visible."""
        return bool(self.mask.any())

    @cached_property
    def object_distance(self) -> float:
        """The geometric mean of the z-depth of the object's pixels, which are visible."""
        return float(self.z_depth[self.mask].double().log().mean().exp())

    @cached_property
    def outside_object(self) -> Tensor:
        """The pixels outside the object at a finite distance, (H, W) bool."""
        return self.z_depth.isfinite() & ~self.mask

    @cached_property
    def determines_scale(self) -> bool:
        """Whether the pixels outside the object determine scale and shift.

        There must be enough of them, and their distances must differ enough.
        """
        distances = self.z_depth[self.outside_object]
        if len(distances) < MIN_FIT_PIXELS:
            return False
        return float(distances.max()) >= MIN_DISTANCE_RATIO * float(distances.min())

    @property
    def fit_mask(self) -> Tensor:
        """The pixels on which scale and shift are fitted, (H, W) bool: those outside
        the object, or all if those do not determine them.
        """
        return self.outside_object if self.determines_scale else self.z_depth.isfinite()

    @cached_property
    def background_disparity(self) -> Tensor:
        """The disparity of the background behind the object, (H, W); NaN if unknown.

        Disparity is the inverse of z-depth, 0 at an infinite distance. It is
        interpolated linearly between the nearest pixels left and right of the object in
        the same row, which is exact for a plane. If the object reaches one edge of the
        image, the pixel on its other side is used. If it fills the row, the background
        is unknown.
        """
        width = self.mask.shape[1]
        disparity = self.z_depth.reciprocal()
        column = torch.arange(width).expand(self.mask.shape)
        left = self._find_left_neighbors(column)
        right = self._find_right_neighbors(column)
        has_left = left >= 0
        has_right = right < width
        # Clamped for `gather`: values without a neighbor are replaced below.
        left_disparity = disparity.gather(1, left.clamp_min(0))
        right_disparity = disparity.gather(1, right.clamp_max(width - 1))
        # Outside of the object both neighbors are the pixel itself: the width is 0.
        weight = (column - left) / (right - left).clamp_min(1)
        interpolated = left_disparity + weight * (right_disparity - left_disparity)
        result = torch.where(has_right, interpolated, left_disparity)
        result = torch.where(has_left, result, right_disparity)
        return torch.where(has_left | has_right, result, math.nan)

    def _find_left_neighbors(self, column: Tensor) -> Tensor:
        """Return the nearest column outside the object at or left of each pixel.

        It is -1 if there is none.

        Args:
            column: (H, W) column of each pixel.
        """
        # The running maximum over a row is the last column outside the object.
        columns_outside = torch.where(self.mask, -1, column)
        return columns_outside.cummax(dim=1).values

    def _find_right_neighbors(self, column: Tensor) -> Tensor:
        """Return the nearest column outside the object at or right of each pixel.

        It is the width of the image if there is none.

        Args:
            column: (H, W) column of each pixel.
        """
        # The running minimum from the right is the first column outside the object.
        width = self.mask.shape[1]
        columns_outside = torch.where(self.mask, width, column)
        return columns_outside.flip(1).cummin(dim=1).values.flip(1)


@dataclass(frozen=True, kw_only=True)
class Depth(Task):
    """Judge whether the object's distance is right within a factor of 1 + `tolerance`.

    The factor is the geometric mean over the object's pixels. If nothing of the object
    is visible, every prediction is right.

    Args:
        tolerance: 0.25 for a factor of 1.25, the first threshold of Eigen et al. 2014
            (arXiv 1406.2283).
        kind: kind of the model's values, one of `KINDS`; "" for the kind that the
            network states.
        size: longest side of the real object in metres, for a model that predicts
            metres; 0 for that of the scene.
        seek: goal of an attack, one of `GOALS`; "" for any wrong distance.

    Raises:
        InputError: an option has another value.
    """

    name = "depth"
    labelled = False
    varies = True

    tolerance: float = 0.25
    kind: str = ""
    size: float = 0.0
    seek: str = ""
    # Which of `KINDS` the network states.
    resolved_kind: str = field(default="", metadata=tasks.FROM_RUN)
    # What the user has to state before predictions can be judged.
    missing_option_message: str = field(default="", metadata=tasks.FROM_RUN)

    def __post_init__(self) -> None:
        """Check that all options are within their limits."""
        self.check_numbers(
            lambda value: 0.0 < value < MAX_FACTOR,
            f"a number over 0, under {MAX_FACTOR:g}",
            "tolerance",
        )
        # 0 means that no size is set. It is allowed here, but not named in the message.
        self.check_numbers(
            lambda value: -1e-9 < value < 1e6, "a number over 0, under 1e+06", "size"
        )
        for option, choices in (("kind", KINDS), ("seek", GOALS)):
            value = getattr(self, option)
            if value not in ("", *choices):
                raise InputError(
                    f"task depth: {option}: expected one of "
                    f"{', '.join(choices)}, got {value!r}"
                )

    # ---- reading ----

    def read(self, returned: Any, count: int) -> list[DepthMap]:
        """Read the map (h, w) of each image from what a network returned.

        Each map is stored under the kind of its values, one of `KINDS`, such as
        "disparity"; "" if the network does not state the kind.

        Raises:
            ValueError: there is no map for each of `count` images.
        """
        kind, maps = _find_maps(returned)
        if isinstance(maps, Tensor) and maps.ndim == 4 and maps.shape[1] == 1:
            maps = maps[:, 0]
        is_stack = isinstance(maps, Tensor) and maps.ndim == 3 and len(maps) == count
        if not is_stack or 0 in maps.shape:
            raise ValueError(
                "expected a number for each pixel, (N, height, width) or (N, 1, "
                "height, width), or a mapping with these under predicted_depth or "
                f"{', '.join(KINDS)}"
            )
        return [{kind: depth_map} for depth_map in maps.float()]

    def on(
        self, model: Model, *, target: str | None = None, minimise: bool = False
    ) -> Depth:
        """Return the task for one depth model.

        Args:
            model: the model, loaded for this task.
            target: not possible, since there are no labels.
            minimise: whether a right prediction is sought.

        Raises:
            InputError: the model was loaded for another task or with names of classes,
                or there is a target.
        """
        if model.read is None:  # its outputs are logits, as those of a classifier
            raise InputError(
                f"model {model.name}: it was loaded for its logits; load "
                'it with task="depth"'
            )
        if model.labels:
            raise InputError(
                "labels: task depth has no classes; leave them out, or use a network "
                "without classes"
            )
        return super().on(model, target=target, minimise=minimise)

    def with_objective(self, objective: str) -> Depth:
        return replace(self, seek=objective) if objective in GOALS else self

    @property
    def calibrates(self) -> bool:
        return True

    def after_calibration(
        self, output: Sequence[DepthMap], truth: DepthTruth | None
    ) -> Depth:
        """Return the task with the kind of the values in the map of a clean image.

        The kind is that of the options, or that which the network states. If it is
        unknown, or predictions can't be judged, the message about it is stored in
        `missing_option_message`, which `ambiguity_message` returns.
        """
        kind = self._get_kind(output[0])
        missing = self._describe_missing_option(kind, truth)
        return replace(self, resolved_kind=kind, missing_option_message=missing)

    def _get_kind(self, depth_map: DepthMap) -> str:
        """Return the kind of the values of a map, one of `KINDS`.

        The option `kind` decides, or else the network. It is "" if neither states it.
        """
        (stated_kind,) = depth_map  # its only key
        return self.kind or stated_kind

    def _describe_missing_option(self, kind: str, truth: DepthTruth | None) -> str:
        """Return a message if predictions cannot be judged yet; "" if they can.

        The message says which option the user has to state, or what has to change in
        the scene.

        Args:
            kind: kind of the model's values, one of `KINDS`, or "" if it is unknown.
            truth: truth of the scene; None if it is not known yet.
        """
        if not kind:
            return (
                f"kind: expected the kind of its numbers, one of {', '.join(KINDS)}, "
                "which its network does not state; set, for example, "
                f"`task='depth={{kind: {DISPARITY}}}'`"
            )
        if kind == METRIC:
            return self._describe_missing_size(truth)
        # Nothing is missing if the pixels outside of the object determine the scale; or if
        # the object is out of view, when every prediction is right.
        if truth is None or not truth.is_visible or truth.determines_scale:
            return ""
        return (
            "it predicts distances up to a scale and a shift, which are fitted to the "
            f"pixels outside the object: expected {MIN_FIT_PIXELS} pixels at distances "
            f"that differ by a factor of {MIN_DISTANCE_RATIO:g}, got "
            f"{int(truth.outside_object.sum())}; use a scene with a ground or a room, "
            "and a camera that sees it from the side"
        )

    def _describe_missing_size(self, truth: DepthTruth | None) -> str:
        """Return a message if a model predicts metres and the object's size is unknown;
        "" if it is known.
        """
        has_scene_size = truth is not None and truth.size_in_metres is not None
        if self.size or has_scene_size:
            return ""
        return (
            "size: it predicts metres, and the size of the object is unknown; "
            "set its longest side in metres, such as `size=0.1`"
        )

    @property
    def ambiguity_message(self) -> str:
        return self.missing_option_message

    @property
    def output_remarks(self) -> tuple[str, ...]:
        """Return a sentence about the meaning of the model's numbers, once it is known.

        For example "The model's numbers are read as metric depth: the distance in
        metres."
        """
        if not self.resolved_kind:
            return ()
        text = (
            f"The model's numbers are read as {self.resolved_kind}: "
            f"{KINDS[self.resolved_kind]}"
        )
        if self.resolved_kind != METRIC:
            # the text ends with "up to a scale and a shift"
            return (
                f"{text}, which are fitted by least squares to the pixels outside the "
                "object.",
            )
        if self.size:
            return (f"{text}, of an object of {self.size:g} m.",)
        return (f"{text}.",)

    def check(self, facts: tasks.Facts) -> None:
        """Raise InputError if there is a label."""
        if facts.label is not None:
            raise InputError("label: task depth has no classes; leave it out")

    def truth(self, facts: tasks.Facts) -> DepthTruth:
        """Return the pixels in which the object is visible, and all distances.

        Raises:
            InputError: the lens sees so far from its axis that z-depth, the distance
                along the axis, says little about the distance.
        """
        # z-depth is the distance times the cosine of the angle to the camera's axis. The
        # comparison is false where nothing is seen, since both are infinite there.
        is_far_from_axis = facts.z_depth < MIN_AXIS_COSINE * facts.depth
        if bool(is_far_from_axis.any()):
            raise InputError(
                "task depth: a model's depth is the distance along the camera's axis, "
                "and this lens sees things more than "
                f"{math.degrees(math.acos(MIN_AXIS_COSINE)):.0f} degrees from its "
                "axis; use a lens with a smaller field of view"
            )
        return DepthTruth(facts.mask, facts.z_depth, facts.sight.size_in_metres)

    def truth_names(self, truth: DepthTruth) -> tuple[str, ...]:
        return (AS_FAR,)

    # ---- loss and score ----

    def loss(self, output: Sequence[DepthMap], truth: DepthTruth) -> Tensor:
        """Compute by how much the error of the object's distance exceeds the tolerance.

        That is the mean over its pixels of |log(predicted / true)|, minus log(1 +
        tolerance), (N,).
        """
        return self._map_images(
            output,
            truth,
            lambda log_factors: log_factors.abs().mean() - self._log_limit,
        )

    def score(self, output: Sequence[DepthMap], truth: DepthTruth) -> Tensor:
        """Compute how near each output is to what is sought, (N,), over 0 for a success."""
        if self.minimise or not self.seek:
            return super().score(output, truth)
        if self.seek == "gone":
            score_gone = partial(self._score_gone, truth)
            return self._map_images(output, truth, score_gone)
        return self._map_images(output, truth, self._score_shift)

    def _score_gone(self, truth: DepthTruth, log_factors: Tensor) -> Tensor:
        """Return how near the object is to being as far as the background, ().

        It is the smaller of two numbers: the loss, and by how much the remaining
        fraction of the object's relief (`_compute_relief_fraction`) is below a half. So
        an object counts as gone if its distance is wrong and less than half of its
        relief is left.

        Args:
            truth: truth of the image.
            log_factors: log(predicted / true) of the object's pixels, (P,).
        """
        excess = log_factors.abs().mean() - self._log_limit
        lost_relief = 0.5 - self._compute_relief_fraction(log_factors, truth)
        return torch.minimum(excess, lost_relief)

    def _score_shift(self, log_factors: Tensor) -> Tensor:
        """Return by how much the object is too near, or too far, ().

        For "farther" it is the mean of `log_factors` over pixels, log(predicted /
        true), minus the tolerance; for "nearer" minus the mean, minus the tolerance.
        """
        sign = 1.0 if self.seek == "farther" else -1.0
        return sign * log_factors.mean() - self._log_limit

    @property
    def _log_limit(self) -> float:
        """Logarithm of the factor up to which a distance is right."""
        return math.log1p(self.tolerance)

    def _map_images(
        self,
        output: Sequence[DepthMap],
        truth: DepthTruth,
        function: Callable[[Tensor], Tensor],
    ) -> Tensor:
        """Apply a function to each image, (N,).

        If the object is out of view, the value is -1, which stands for a right
        prediction.

        Args:
            output: output for N images.
            truth: truth of the scene.
            function: function from log(predicted / true) of the object's pixels, (P,), to
                the value of an image, ().
        """
        values = []
        for depth_map in output:
            if truth.is_visible:
                values.append(function(self._compute_log_factors(depth_map, truth)))
            else:
                (distances,) = depth_map.values()  # the only map
                # The product keeps the value attached to the graph.
                values.append(distances.sum() * 0.0 - 1.0)
        return torch.stack(values)

    def _compute_log_factors(self, depth_map: DepthMap, truth: DepthTruth) -> Tensor:
        """Compute log(predicted / true) of each of the object's pixels, (P,).

        The factors are clamped to `MAX_FACTOR` and its inverse.
        """
        predicted, is_inverse = self._align_to_truth(depth_map, truth)
        mask = truth.mask.to(predicted.device)
        z = truth.z_depth.to(predicted.device)
        if is_inverse:
            ratio = predicted[mask] * z[mask]  # inverse distances: predicted over 1 / z
        else:
            ratio = predicted[mask] / z[mask]  # distances
        # Clamped first, since a prediction may be 0 or negative.
        log_ratio = ratio.clamp(1.0 / MAX_FACTOR, MAX_FACTOR).log()
        # of distances in both cases
        log_factors = -log_ratio if is_inverse else log_ratio
        # 0, or NaN if the map has a NaN anywhere, also outside the object
        nan_or_zero = predicted.sum() * 0.0
        return log_factors + nan_or_zero

    def _align_to_truth(
        self, depth_map: DepthMap, truth: DepthTruth
    ) -> tuple[Tensor, bool]:
        """Convert a predicted map to the size and the units of the truth.

        A map in metres is only scaled. Other maps are known up to a scale and a shift,
        which are fitted to the truth by least squares. A map of another size is resized
        as `post_process_depth_estimation` of transformers does it.

        Returns:
            The predicted z-depth of every pixel, (H, W), or for a map of disparity the
            inverse of z-depth; and whether it is the inverse.
        """
        kind = self._get_kind(depth_map)
        (values,) = depth_map.values()  # the only map
        values = _resize_depth_map(values, (truth.mask.shape[0], truth.mask.shape[1]))
        if kind == METRIC:
            return values * self._find_metric_scale(truth), False
        z = truth.z_depth.to(values.device)
        fit_mask = truth.fit_mask.to(values.device)
        if kind == DISPARITY:
            return _fit_scale_and_shift(values, z.reciprocal(), fit_mask), True
        return _fit_scale_and_shift(values, z, fit_mask), False

    def _find_metric_scale(self, truth: DepthTruth) -> float:
        """Return the factor from a model's metres to the units of the scene."""
        if not self.size:
            return 1.0
        # The model predicts metres for an object of the real size, the option `size`.
        # They are converted to the units of the scene, in which the object has this
        # size: in metres, or 1 object size if that is unknown.
        scene_size = truth.size_in_metres or 1.0
        return scene_size / self.size

    def _compute_relief_fraction(
        self, log_factors: Tensor, truth: DepthTruth
    ) -> Tensor:
        """Compute how much of the object's relief is left in a prediction, ().

        The relief is how far the object stands out from what is behind it: the disparity
        of each of its pixels minus that of the background there. The predicted relief is
        fitted by a multiple of the true one (least squares), and the fraction is this
        multiple: 1 if all distances are true, 0 if the object is as far as the
        background. It is 1 as well if the background is unknown, or the true relief is
        negligible.

        Args:
            log_factors: log(predicted / true) of the object's pixels, (P,).
            truth: truth of the image.
        """
        mask = truth.mask
        disparity = truth.z_depth[mask].reciprocal().to(log_factors)
        behind = truth.background_disparity[mask].to(log_factors)
        is_known = behind.isfinite()
        true_relief = (disparity - behind)[is_known]
        squared_relief = true_relief.square().sum()
        is_negligible = float(squared_relief) <= 1e-6 * float(disparity.square().sum())
        if is_negligible:
            # A constant 1, but computed from the factors, so that autograd can go on.
            return log_factors.sum() * 0.0 + 1.0
        # A predicted distance is the true one times exp(log_factors).
        predicted_disparity = disparity * (-log_factors).exp()
        predicted_relief = (predicted_disparity - behind)[is_known]
        return (predicted_relief * true_relief).sum() / squared_relief

    # ---- predictions ----

    def predictions(
        self, output: Sequence[DepthMap], count: int = 1
    ) -> list[tuple[tasks.Prediction, ...]]:
        """Return the range of the values of each map."""
        predictions_of_images: list[tuple[tasks.Prediction, ...]] = []
        for depth_map in output:
            (values,) = depth_map.values()  # the only map
            lowest, highest = (float(limit) for limit in values.detach().aminmax())
            kind = self._get_kind(depth_map) or "numbers"
            label = f"{kind} from {lowest:.3g} to {highest:.3g}"
            if not math.isfinite(lowest + highest):
                label = tasks.NOT_A_NUMBER
            predictions_of_images.append((tasks.Prediction(label),))
        return predictions_of_images

    def describe(
        self, output: Sequence[DepthMap], truth: DepthTruth, margins: Sequence[float]
    ) -> list[tasks.PredictionWithPayload]:
        """Return whether the object's distance is right in each image, and a payload.

        Args:
            output: maps of N images.
            truth: truth of the scene.
            margins: margin of each image; below 0 if it is wrong.
        """
        if not truth.is_visible:
            return [(tasks.Prediction(tasks.OUT_OF_VIEW), None)] * len(output)
        return [
            self._describe_map(depth_map, truth, is_right=not margin < 0.0)
            for depth_map, margin in zip(output, margins, strict=True)
        ]

    def _describe_map(
        self, depth_map: DepthMap, truth: DepthTruth, *, is_right: bool
    ) -> tasks.PredictionWithPayload:
        """Return whether the object's distance is right in an image, and a payload.

        The payload has the true and the predicted distance (geometric means over the
        object's pixels), the mean factor of an error in either direction, the remaining
        fraction of the relief, and the pixels on which scale and shift were fitted.
        """
        log_factors = self._compute_log_factors(depth_map, truth)
        mean_log_factor = float(log_factors.mean())
        relief = float(self._compute_relief_fraction(log_factors, truth))
        distance = truth.object_distance
        payload: dict[str, tasks.JsonValue] = {
            "distance": round(distance, 4),
            # the predicted distance
            "judged": round(distance * math.exp(mean_log_factor), 4),
            "factor": round(math.exp(float(log_factors.abs().mean())), 4),
            "relief": round(relief, 4),
        }
        if self._get_kind(depth_map) != METRIC:
            has_scale = truth.determines_scale
            fitted = "beside the object" if has_scale else "in the whole picture"
            payload["fitted"] = fitted
        label = AS_FAR
        if not is_right:
            label = self._choose_error_label(mean_log_factor, relief)
        return tasks.Prediction(label), payload

    def _choose_error_label(self, mean_log_factor: float, relief: float) -> str:
        """Return the label of a wrong distance.

        If several labels fit, that of the search's goal is returned.

        Args:
            mean_log_factor: mean of log(predicted / true) over the object's pixels.
            relief: remaining fraction of the object's relief, see `_compute_relief_fraction`.
        """
        fits = {
            "gone": relief < 0.5,
            "nearer": -mean_log_factor > self._log_limit,
            "farther": mean_log_factor > self._log_limit,
        }
        sought_first = sorted(fits, key=lambda goal: goal != self.seek)  # False first
        for goal in sought_first:
            if fits[goal]:
                return LABELS[goal]
        return OUT_OF_SHAPE

    def marks(
        self, output: Sequence[DepthMap], truth: DepthTruth
    ) -> list[list[tasks.Mark]]:
        """Return what is drawn for each image.

        The true mark has the object's mask and the true disparity; the predicted mark
        has the pixels with a right distance and the predicted disparity.
        """
        true_mark = tasks.Mark(
            "disparity", true=True, mask=truth.mask, map=truth.z_depth.reciprocal()
        )
        marks_of_images = []
        for depth_map in output:
            marks = [true_mark]
            if truth.is_visible and self._can_draw(depth_map, truth):
                marks.append(self._make_predicted_mark(depth_map, truth))
            marks_of_images.append(marks)
        return marks_of_images

    def _can_draw(self, depth_map: DepthMap, truth: DepthTruth) -> bool:
        """Return whether kind and size of a map are known, so that it can be drawn.

        The truth is needed for the size of a map in metres only. It is not checked
        whether scale and shift are determined: maps of relative values are always
        drawn.
        """
        kind = self._get_kind(depth_map)
        truth_with_size = truth if kind == METRIC else None
        return not self._describe_missing_option(kind, truth_with_size)

    def _make_predicted_mark(
        self, depth_map: DepthMap, truth: DepthTruth
    ) -> tasks.Mark:
        """Return the predicted disparity, with a mask of the object's right pixels."""
        # (P,) log(predicted / true) of the object's pixels
        log_factors = self._compute_log_factors(depth_map, truth).detach()
        is_right_pixel = log_factors.abs() <= self._log_limit
        right_mask = torch.zeros_like(truth.mask)
        right_mask[truth.mask] = is_right_pixel.to(right_mask.device)
        disparity, is_inverse = self._align_to_truth(depth_map, truth)
        if not is_inverse:  # the inverse of a distance is the disparity
            disparity = disparity.clamp_min(MIN_MAP_DISTANCE).reciprocal()
        disparity = disparity.detach().cpu()
        return tasks.Mark("disparity", true=False, mask=right_mask, map=disparity)


def _resize_depth_map(values: Tensor, size: tuple[int, int]) -> Tensor:
    """Return a map (h, w) at a size (height, width)."""
    if values.shape == size:
        return values
    return F.interpolate(
        values[None, None], size=size, mode="bicubic", align_corners=False
    )[0, 0]


def _find_maps(returned: Any) -> tuple[str, Any]:
    """Find the maps in what a network returned.

    Returns:
        The kind of the values that the network states, one of `KINDS`, or "" if it
        states none; and the maps. These are not checked: they may be None or something
        else.
    """
    if isinstance(returned, Mapping):
        kind = next((kind for kind in KINDS if kind in returned), "")
        if kind:
            return kind, returned[kind]
        return "", returned.get("predicted_depth", returned.get("depth"))
    if hasattr(returned, "predicted_depth"):  # an output of transformers
        return "", returned.predicted_depth
    if isinstance(returned, (list, tuple)) and returned:
        first = returned[0]
        # A tuple that begins with boxes is that of a detector, and has no maps.
        is_boxes = isinstance(first, Tensor) and first.shape[-1:] == (4,)
        has_maps = not (is_boxes and len(returned) > 1)
        return "", first if has_maps else None
    return "", returned


def _fit_scale_and_shift(values: Tensor, expected: Tensor, mask: Tensor) -> Tensor:
    """Return `scale * values + shift`, (H, W), fitted to a map by least squares.

    The scale is at least 0, so that the model's order of near and far is kept.

    Args:
        values: predicted map, (H, W).
        expected: map to fit, (H, W), finite inside of the mask.
        mask: (H, W) bool, the pixels of the fit, at least one.
    """
    fit_values = values[mask]
    fit_expected = expected[mask]
    x_mean = fit_values.mean()
    y_mean = fit_expected.mean()
    x = fit_values - x_mean
    y = fit_expected - y_mean
    # clamped for constant values, whose slope is then 0
    slope = (x * y).sum() / x.square().sum().clamp_min(1e-20)
    return y_mean + slope.clamp_min(0.0) * (values - x_mean)
