"""The base class of tasks, which evaluate a model's output.

Only a task knows the meaning of a model's output. The search maximizes a number that the
task computes, verification counts its judgements, and results and reports print its
labels. None of these depends on classes.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any, ClassVar, TypeVar

import torch
from torch import Tensor

from advsearch.copies import copy_method_arguments
from advsearch.errors import InputError
from advsearch.files import JsonValue
from advsearch.models import Model
from advsearch.options import FROM_RUN, NOT_A_NUMBER, OUT_OF_VIEW, Outcome, get_outcome

# What a model returns for N images: a tensor (N, ...), or a list with N elements.
Output = Any
# The ground truth of a scene, as its task needs it: right classes, a number, boxes.
Truth = Any
TaskType = TypeVar("TaskType", bound="Task")


@dataclass(frozen=True)
class Prediction:
    """One prediction of a model about an image.

    Attributes:
        label: label in words.
        index: index of the class; None if there are no classes.
        probability: probability in [0, 1]; None if the model states none.
    """

    label: str
    index: int | None = None
    probability: float | None = None

    @property
    def is_out_of_view(self) -> bool:
        """Whether nothing of the evaluated object is visible in the image."""
        return self.label == OUT_OF_VIEW


@dataclass(frozen=True)
class Judgement:
    """The evaluation of a model's output for one image.

    Attributes:
        score: number over 0 if the output is a success of the search. NaN is no
            success.
        margin: minus the loss of the task, whatever the search seeks. It is negative
            if and only if the prediction is wrong.
        right: whether the prediction is right. False if the margin is NaN.
        prediction: prediction of the model.
        payload: further values to store in the run's rows, as JSON values (boxes,
            masks). None if there are none.
        objective: value that the search maximizes for this image; None without a
            search.
        metrics: values of the run's metrics for this image by name, None for one that
            is not a number; None if there are no metrics.
    """

    score: float
    margin: float
    right: bool
    prediction: Prediction
    payload: JsonValue = None
    objective: float | None = None
    metrics: Mapping[str, float | None] | None = None

    @classmethod
    def from_margin(
        cls,
        score: float,
        margin: float,
        prediction: Prediction,
        payload: JsonValue = None,
    ) -> Judgement:
        """Create the judgement of an output.

        If the margin is not finite, the model returned NaN or infinity. Then the
        prediction is `NOT_A_NUMBER`, which is neither right nor a success.

        Args:
            score: how near the output is to what is sought; over 0 for a success.
            margin: minus the loss; at least 0 for a right output.
            prediction: prediction for the user.
            payload: further values for the stored row; None for none.
        """
        if not math.isfinite(margin):
            not_a_number = Prediction(NOT_A_NUMBER)
            return cls(math.nan, math.nan, right=False, prediction=not_a_number)
        return cls(score, margin, margin >= 0.0, prediction, payload)

    @property
    def success(self) -> bool:
        """Whether the output is a success of the search."""
        return self.score > 0.0

    @property
    def outcome(self) -> Outcome | None:
        """Outcome for the object, such as "missed"; None if the task does not state it."""
        return get_outcome(self.payload)

    @property
    def is_non_finite(self) -> bool:
        """Whether the model returned NaN or infinity, neither right nor a success."""
        return self.prediction.label == NOT_A_NUMBER


# The prediction about an image, and its payload: further values that are stored.
PredictionWithPayload = tuple[Prediction, JsonValue]


@dataclass(frozen=True)
class Mark:
    """A box, a mask or a map to draw on an image, of a prediction or of the truth.

    Attributes:
        text: the label next to it.
        true: whether it shows the ground truth; otherwise it shows the prediction.
        box: x0, y0, x1, y1 in pixels of the image, from the top left.
        mask: (h, w) bool over the full image, of any size.
        map: (h, w) values over the full image, drawn next to it, larger ones lighter.
    """

    text: str
    true: bool
    box: tuple[float, float, float, float] | None = None
    mask: Tensor | None = None
    map: Tensor | None = None


@dataclass(frozen=True, eq=False)
class Sight:
    """The first surface that the camera sees through the center of each pixel.

    It is computed without noise.

    Attributes:
        mask: (H, W) bool, whether the surface is that of the object.
        depth: (H, W) float, distance of the surface, see `Facts.depth`.
        z_depth: (H, W) float, see `Facts.z_depth`.
        size_in_metres: size in metres of the object's longest side; None if it is
            unknown, and distances are in object sizes.
    """

    mask: Tensor
    depth: Tensor
    z_depth: Tensor
    size_in_metres: float | None = None


@dataclass(frozen=True)
class Facts:
    """The ground truth of a scene in one configuration.

    A task computes its own truth from it, such as the right classes.

    Attributes:
        object: name of the object, for messages.
        label: right label, as the setting `label` states it. None without that.
        object_label: label that the object's file states. None if it states none.
        compute_numbers: function that returns the values of the configuration by
            parameter ("pose.yaw"), in the units of a run's rows.
        compute_sight: function that computes what is visible in the image, see `mask`
            and `depth`. None if the facts are those of a scene without a configuration.
        facts_of_thing: facts of each evaluated thing by name, the object first. Empty
            if only one thing is evaluated.
        facts_of_others: facts of every other thing in the scene, including the object if another
            thing is evaluated.
        facts_of_views: facts for the image of each camera of a rig. Empty for a single camera.
    """

    object: str
    label: str | None = None
    object_label: str | None = None
    compute_numbers: Callable[[], Mapping[str, float]] = dict
    compute_sight: Callable[[], Sight] | None = None
    facts_of_thing: Mapping[str, Facts] = field(default_factory=dict)
    facts_of_others: tuple[Facts, ...] = ()
    facts_of_views: tuple[Facts, ...] = ()
    gives_copies: ClassVar[bool] = True

    @cached_property
    def sight(self) -> Sight:
        """What is visible in the configuration; computed at the first access only.

        Raises:
            InputError: these are facts of the scene, and not of a single configuration.
        """
        if self.compute_sight is None:
            raise InputError(
                f"the task needs the view of {self.object}, which depends on the "
                "configuration; set `varies = True` in the class of the task"
            )
        return self.compute_sight()

    @property
    def mask(self) -> Tensor:
        """The pixels in which the object is visible, (H, W) bool.

        That is, the object is the first surface on the ray through the pixel's center.
        The mask is false where something occludes the object. Image corruptions do not
        change it.

        Raises:
            InputError: these are facts of the scene, and not of a single configuration.
        """
        return self.sight.mask.clone()

    @property
    def depth(self) -> Tensor:
        """The distance from the camera along the ray of each pixel, (H, W) float32.

        It is in metres, or in object sizes if the size of the object is unknown. It is
        infinite where only the environment is visible.

        Raises:
            InputError: these are facts of the scene, and not of a single configuration.
        """
        return self.sight.depth.clone()

    @property
    def z_depth(self) -> Tensor:
        """The component of `depth` along the camera's axis, (H, W) float32.

        That is what a depth camera measures.

        Raises:
            InputError: these are facts of the scene, and not of a single configuration.
        """
        return self.sight.z_depth.clone()

    @cached_property
    def box(self) -> tuple[int, int, int, int] | None:
        """The smallest box around the visible part of the object, (x0, y0, x1, y1).

        The unit is pixels from the top left; pixels of the box have x0 <= x < x1 and y0
        <= y < y1. It is None if the object is out of view.

        Raises:
            InputError: these are facts of the scene, and not of a single configuration.
        """
        columns = self.mask.any(dim=0).nonzero().flatten().tolist()
        rows = self.mask.any(dim=1).nonzero().flatten().tolist()
        if not rows:
            return None
        return columns[0], rows[0], columns[-1] + 1, rows[-1] + 1

    @cached_property
    def numbers(self) -> Mapping[str, float]:
        """The values of the configuration by parameter, both varied and fixed ones."""
        return MappingProxyType(dict(self.compute_numbers()))

    def get_number(self, name: str) -> float:
        """Return the value of a parameter in this configuration.

        Args:
            name: name of the parameter, such as "pose.yaw".

        Raises:
            InputError: the scene has no such parameter.
        """
        if name not in self.numbers:
            known = ", ".join(sorted(self.numbers)) or "none"
            raise InputError(
                f"the task needs {name}, and the scene has values of {known}; add "
                "its control or `set` it"
            )
        return self.numbers[name]


@dataclass(frozen=True, kw_only=True)
class Task(ABC):
    """Base class for all tasks, which evaluate a model's output against the truth.

    Your tasks should subclass this class and define `truth`, `loss` and `predictions`.
    A task is a dataclass. Its fields are its options, except for those with the metadata
    `FROM_RUN`, which `on` sets for a run.

    Attributes:
        minimise: whether the search seeks a right prediction, so that the object is
            easier to recognize.
        target: prediction that the search seeks, in the form of a truth. None for any
            wrong prediction.
        name: name of the task on the command line.
        objective: name of the default objective; "score" is the score of the task.
        reads_logits: whether the models return logits (N, classes). Then their outputs
            are checked as logits, and the objectives of classification accept them.
        labelled: whether the task takes a label. In a joint task, a label is passed to
            the tasks that take one.
        names_source: source of the names of classes, in words, if it is neither the
            model nor the setting `labels`.
        varies: whether the truth depends on the configuration. Then it is computed for
            each one.
        judges_rig: whether the task evaluates the images of several cameras together.
        needs_all_images: whether all images of a rig have a single output.
    """

    name: ClassVar[str]
    objective: ClassVar[str] = "score"
    reads_logits: ClassVar[bool] = False
    labelled: ClassVar[bool] = True
    names_source: ClassVar[str] = ""
    varies: ClassVar[bool] = False
    judges_rig: ClassVar[bool] = False
    needs_all_images: ClassVar[bool] = False

    minimise: bool = field(default=False, metadata=FROM_RUN)
    target: Truth = field(default=None, metadata=FROM_RUN)

    def __init_subclass__(cls, **keywords: Any) -> None:
        """Make methods of a user's class get copies of their arguments.

        So a method may change its arguments in place without changing the search.
        `copy_method_arguments` leaves classes of this package as they are.
        """
        super().__init_subclass__(**keywords)
        # the methods that get outputs or the truth
        receive_copies: tuple[Callable[..., Any], ...] = (
            Task.truth_names,
            Task.loss,
            Task.score,
            Task.predictions,
            Task.payloads,
            Task.marks,
            Task.judge,
            Task.describe,
            Task.average,
            Task.after_calibration,
            Task.as_logits,
        )
        method_names = [method.__name__ for method in receive_copies]
        all_arguments = slice(None)  # which arguments are copied
        copy_method_arguments(cls, **dict.fromkeys(method_names, all_arguments))

    def check_numbers(
        self, fits: Callable[[float], bool], expected: str, *names: str
    ) -> None:
        """Check options that are numbers.

        Args:
            fits: function that returns whether a value is in range.
            expected: the range in words, such as "a number between 0 and 1".
            *names: names of the options, which are attributes of the task.

        Raises:
            InputError: a value is not a number, or does not fit.
        """
        for name in names:
            value: object = getattr(self, name)
            is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
            if not is_number or not fits(value):  # type: ignore[arg-type]
                raise InputError(
                    f"task {self.name}: {name}: expected {expected}, got {value!r}"
                )

    # ---- a task must define ----

    @abstractmethod
    def truth(self, facts: Facts) -> Truth:
        """Return the ground truth of the scene for this task.

        Raises:
            InputError: the facts do not contain it, or the model cannot predict it.
        """

    @abstractmethod
    def loss(self, output: Output, truth: Truth) -> Tensor:
        """Compute how wrong each of N outputs is, (N,); differentiable.

        It is over 0 exactly if the output is not right. It is maximised if no other
        objective is chosen, so it should rise towards a wrong prediction from afar.
        """

    @abstractmethod
    def predictions(
        self, output: Output, count: int = 1
    ) -> list[tuple[Prediction, ...]]:
        """Return at most `count` predictions for each of N images, the most probable
        first.
        """

    # ---- a task may define ----

    def read(self, returned: Any, count: int) -> Output:
        """Read the output from what a network returned for `count` images.

        Not called if the task `reads_logits`. The order of the images is kept.

        Raises:
            ValueError: there is no such output; the message states what was expected.
        """
        if isinstance(returned, Tensor) and returned.shape[:1] == (count,):
            return returned.float()
        raise ValueError(f"expected a tensor with {count} rows, one for each picture")

    def wrap_network(self, network: Callable[..., Any]) -> Callable[..., Any]:
        """Return a network that takes only images.

        It is the given network by default. A task can pass further inputs to it.
        """
        return network

    @property
    def calibrates(self) -> bool:
        """Whether the task has to be calibrated before it can judge outputs.

        Then `after_calibration` is called with the output for a clean image of the
        scene, and returns the calibrated task.
        """
        return False

    def after_calibration(
        self: TaskType, output: Output, truth: Truth | None
    ) -> TaskType:
        """Return the task after it has read the output for a clean image of the scene.

        Args:
            output: output for one image.
            truth: truth of the scene; None if it is unknown.
        """
        return self

    @property
    def ambiguity_message(self) -> str:
        """Message about an option that the user must state before outputs can be read.

        It is empty if nothing is missing.
        """
        return ""

    @property
    def output_remarks(self) -> tuple[str, ...]:
        """Sentences for the user about how outputs are read."""
        return ()

    @property
    def output_reader(self) -> Callable[[Any, int], Output] | None:
        """Function that reads the outputs of the models; None if they are logits."""
        return None if self.reads_logits else self.read

    def on(
        self: TaskType,
        model: Model,
        *,
        target: str | None = None,
        minimise: bool = False,
    ) -> TaskType:
        """Return the task for one model and a goal of the search.

        Here, the task does not depend on the model. Subclasses override this if theirs
        does, or if they allow a target.

        Args:
            model: model whose outputs the task will evaluate.
            target: label that the model should predict; None for any wrong one.
            minimise: whether the search seeks a right prediction, not a wrong one.

        Raises:
            InputError: there is no such target, or the task has none.
        """
        if target is not None:
            raise InputError(f"target: task {self.name} has none; leave it out")
        return replace(self, minimise=minimise)

    def with_objective(self: TaskType, objective: str) -> TaskType:
        """Return the task with one of its objectives.

        An objective may define what counts as a success.
        """
        return self

    def check(self, facts: Facts) -> None:
        """Reject a scene that cannot be evaluated, before anything is rendered.

        Raises:
            InputError: as for `truth`.
        """
        # If the truth varies with the configuration, it needs a rendered image.
        if not self.varies:
            self.truth(facts)  # raises if there is none

    def score(self, output: Output, truth: Truth) -> Tensor:
        """Compute how near each output is to a success, (N,); differentiable.

        It is over 0 exactly if the output is a success.
        """
        if self.target is not None:
            # A target is a truth as well: the loss is over 0 where it is not reached.
            return -self.loss(output, self.target)
        loss = self.loss(output, truth)
        # With `minimise`, a right prediction is a success.
        return -loss if self.minimise else loss

    def as_logits(self, output: Output, truth: Truth) -> Output:
        """Return the output as logits, for the objectives of classification.

        Classes that do not count as predictions, such as "background", are excluded.
        """
        return output

    def payloads(self, output: Output) -> Sequence[Any]:
        """Return further values to store for each of N outputs, as JSON values.

        By default only the label is stored.
        """
        return [None] * len(output)

    def marks(self, output: Output, truth: Truth) -> list[list[Mark]]:
        """Return the marks to draw on each of N images, such as boxes.

        By default there are none, as the label describes the prediction.
        """
        return [[] for _ in range(len(output))]

    def average(self, outputs: Sequence[Output]) -> Output:
        """Average the outputs of several images of a configuration.

        Args:
            outputs: outputs for one image each.

        Returns:
            An output for one image.
        """
        return torch.stack(list(outputs)).mean(dim=0)

    @property
    def single_image_task(self) -> Task:
        """The task for a single image.

        That is the task itself, except for the task of a rig of cameras: then it is the
        task for each image of the rig.
        """
        return self

    @property
    def title(self) -> str:
        """The name of the task in results."""
        return self.name

    @property
    def success_description(self) -> str:
        """What counts as success, in words."""
        if self.target is not None:
            return "a target answer"
        return "a right answer" if self.minimise else "a wrong answer"

    @property
    def target_names(self) -> tuple[str, ...]:
        """The labels that are sought; empty if any wrong one is."""
        return () if self.target is None else self.truth_names(self.target)

    def truth_names(self, truth: Truth) -> tuple[str, ...]:
        """Return the right labels in words."""
        return (str(truth),)

    # ---- judgement ----

    def judge(self, output: Output, truth: Truth) -> list[Judgement]:
        """Judge each of N outputs: its score, margin, prediction and payload.

        Args:
            output: output of the model for N images.
            truth: truth of the scene.
        """
        with torch.no_grad():
            scores = self.score(output, truth).tolist()
            # not `-loss`, which would be -0.0 for a loss of 0
            margins = (0.0 - self.loss(output, truth)).tolist()
            predictions = self.describe(output, truth, margins)
            return [
                Judgement.from_margin(score, margin, prediction, payload)
                for score, margin, (prediction, payload) in zip(
                    scores, margins, predictions, strict=True
                )
            ]

    def describe(
        self, output: Output, truth: Truth, margins: Sequence[float]
    ) -> list[PredictionWithPayload]:
        """Return the prediction about each of N images and its payload.

        Subclasses override it if a prediction depends on the truth.

        Args:
            output: output for N images.
            truth: truth of the scene.
            margins: margin of each of the N judgements (`Judgement.margin`).
        """
        first_predictions = [predictions[0] for predictions in self.predictions(output)]
        return list(zip(first_predictions, self.payloads(output), strict=True))


def most_frequent_judgement(judgements: Sequence[Judgement]) -> Judgement:
    """Return a judgement with the most frequent of several predictions.

    Of equally frequent predictions it is the one with the lowest class index. Score,
    margin and probability are means over the judgements with this prediction. Whether it
    is right, and the payload, can't be averaged: they are those of the first of these
    judgements.

    Args:
        judgements: judgements of several images of the same configuration, at least
            one.
    """
    label_and_index = [(x.prediction.label, x.prediction.index) for x in judgements]
    most_frequent = _find_most_frequent(label_and_index)
    matching = [
        judgement
        for judgement, candidate in zip(judgements, label_and_index, strict=True)
        if candidate == most_frequent
    ]
    label, index = most_frequent
    return Judgement(
        score=mean([judgement.score for judgement in matching]),
        margin=mean([judgement.margin for judgement in matching]),
        right=matching[0].right,
        prediction=Prediction(label, index, _average_probability(matching)),
        payload=matching[0].payload,
    )


def _find_most_frequent(
    label_and_index: Sequence[tuple[str, int | None]],
) -> tuple[str, int | None]:
    """Return the most frequent label with its class index; of several, the one with
    the lowest index.
    """
    counts = Counter(label_and_index)

    def sort_key(candidate: tuple[str, int | None]) -> tuple[int, int]:
        """Return a key by which the most frequent comes first, then a low index."""
        _, class_index = candidate
        # without classes, equally frequent ones keep their order
        return -counts[candidate], 0 if class_index is None else class_index

    return min(counts, key=sort_key)


def _average_probability(judgements: Sequence[Judgement]) -> float | None:
    """Return the mean of those probabilities that are known; None if none is."""
    probabilities = [
        judgement.prediction.probability
        for judgement in judgements
        if judgement.prediction.probability is not None
    ]
    return mean(probabilities) if probabilities else None


def mean(values: Sequence[float]) -> float:
    """Return the mean of at least one number."""
    return math.fsum(values) / len(values)
