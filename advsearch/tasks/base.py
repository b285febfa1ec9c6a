"""The contract of a task, and what it says of a picture.

A task is the only place that knows what a model's output means. The search maximises a
number of it, verification counts judgements, and store, tables and report print the
words: none of them knows of classes.
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

from advsearch.copies import hand_copies
from advsearch.errors import InputError
from advsearch.files import JsonValue
from advsearch.models import Model
from advsearch.options import FROM_RUN, NOT_A_NUMBER, OUT_OF_VIEW, Outcome, get_outcome

# what a model returns for N pictures: a tensor (N, ...), or a list with one thing for
# each picture
Output = Any
# what is true of a scene, as its task needs it: the right classes, a number, boxes
Truth = Any
Own = TypeVar("Own", bound="Task")


@dataclass(frozen=True)
class Prediction:
    """One prediction of a model about a picture.

    Attributes:
        label: in words.
        index: its number among the model's classes; None where there are no classes.
        probability: in [0, 1]; None where the model gives none.
    """

    label: str
    index: int | None = None
    probability: float | None = None

    @property
    def is_out_of_view(self) -> bool:
        """Whether nothing of what is judged can be seen in the picture."""
        return self.label == OUT_OF_VIEW


@dataclass(frozen=True)
class Judgement:
    """What a task says of a model's output for one picture.

    Attributes:
        score: over 0 where it is a success, which is what is sought. NaN is none.
        margin: the task's loss with its sign turned, whatever is sought: below 0
            exactly where the prediction is not right.
        right: whether the prediction is right. NaN is not right.
        prediction: what the model says.
        payload: what else is kept of it in the run's rows, as JSON values (boxes,
            masks); None where there is nothing.
        objective: what a search maximises, of this picture; None where nothing is
            searched.
        metrics: numbers that the run's metrics say of this picture, by name, or None in
            the place of one that is none; None where there are no metrics.
    """

    score: float
    margin: float
    right: bool
    prediction: Prediction
    payload: JsonValue = None
    objective: float | None = None
    metrics: Mapping[str, float | None] | None = None

    @classmethod
    def of(
        cls,
        score: float,
        margin: float,
        prediction: Prediction,
        payload: JsonValue = None,
    ) -> Judgement:
        """Return the judgement of an output; where its margin is NaN or infinite, that
        it is not a number.
        """
        if not math.isfinite(margin):
            return cls(
                math.nan, math.nan, right=False, prediction=Prediction(NOT_A_NUMBER)
            )
        return cls(score, margin, margin >= 0.0, prediction, payload)

    @property
    def success(self) -> bool:
        """Whether the output is what is sought."""
        return self.score > 0.0

    @property
    def outcome(self) -> Outcome | None:
        """What becomes of the object; None where the task does not say it."""
        return get_outcome(self.payload)

    @property
    def not_a_number(self) -> bool:
        """Whether the model returned NaN or infinity, which is neither right nor a
        success.
        """
        return self.prediction.label == NOT_A_NUMBER


# what a model says of a picture, and what else is kept of it
Said = tuple[Prediction, JsonValue]


@dataclass(frozen=True)
class Mark:
    """What a picture shows of a prediction, or of what is true: a box, or the pixels of
    a mask.

    Attributes:
        text: that stands beside it.
        true: whether it is what is true of the scene; otherwise it is what the model
            says.
        box: x0, y0, x1, y1 in pixels of the picture, from the top left.
        mask: (h, w) bool over the whole picture, of any size.
        map: (h, w) numbers over the whole picture, which are shown beside it, larger
            ones lighter.
    """

    text: str
    true: bool
    box: tuple[float, float, float, float] | None = None
    mask: Tensor | None = None
    map: Tensor | None = None


@dataclass(frozen=True, eq=False)
class Sight:
    """What the camera sees first through the middle of each pixel of a picture, without
    noise.

    Attributes:
        mask: (H, W) bool, where it is the object.
        depth: (H, W) float, how far it is, see `Facts.depth`.
        z_depth: (H, W) float, see `Facts.z_depth`.
        metres: of the object's longest side; None where they are not known, and
            distances are in object sizes.
    """

    mask: Tensor
    depth: Tensor
    z_depth: Tensor
    metres: float | None = None


@dataclass(frozen=True)
class Facts:
    """What a scene gives a task to judge by, in one configuration.

    Attributes:
        object: what it is called, for messages.
        label: what was said to be right (the setting `label`); None if nothing was.
        own_label: what the object says it is; None if it does not.
        describe: the numbers of the configuration by parameter ("pose.yaw"), in the
            units that rows have.
        look: says what is seen in the picture, see `mask` and `depth`; None where no
            configuration is meant.
        each: the facts of each thing that is judged, by name, the object first; empty
            where it is one thing alone.
        others: the facts of every other thing in the scene, the object included where a
            thing is judged.
        views: the facts in the picture of each camera of a rig; empty of one camera.
    """

    object: str
    label: str | None = None
    own_label: str | None = None
    describe: Callable[[], Mapping[str, float]] = dict
    look: Callable[[], Sight] | None = None
    each: Mapping[str, Facts] = field(default_factory=dict)
    others: tuple[Facts, ...] = ()
    views: tuple[Facts, ...] = ()
    gives_copies: ClassVar[bool] = True

    @cached_property
    def sight(self) -> Sight:
        """What is seen of the configuration; the camera looks when this is asked for,
        and once. Raises InputError for no configuration is meant.
        """
        if self.look is None:
            raise InputError(
                f"the task needs to see {self.object}, which depends on the "
                "configuration; set `varies = True` on it"
            )
        return self.look()

    @property
    def mask(self) -> Tensor:
        """The pixels of the picture in which the object is the first thing that the
        camera sees, (H, W) bool.

        Each is asked for at its middle. Where something hides the object, it is not
        seen; an image corruption leaves the mask as it is. Raises InputError: as for
        `sight`.
        """
        return self.sight.mask.clone()

    @property
    def depth(self) -> Tensor:
        """How far what is seen in each pixel is from the camera, along the ray, (H, W)
        float32.

        In metres; in object sizes where the size of the object is not known. Infinite
        where there is nothing but the environment. Asked for and unaffected as the mask
        is. Raises InputError: as for `sight`.
        """
        return self.sight.depth.clone()

    @property
    def z_depth(self) -> Tensor:
        """The part of `depth` that lies along the camera's axis, (H, W) float32: what a
        depth camera gives. Raises InputError: as for `sight`.
        """
        return self.sight.z_depth.clone()

    @cached_property
    def box(self) -> tuple[int, int, int, int] | None:
        """The smallest box round what is seen of the object: x0, y0, x1, y1 in pixels
        from the top left.

        The pixels have x0 <= x < x1 and y0 <= y < y1. None where nothing is seen.
        Raises InputError: as for `sight`.
        """
        columns, rows = (
            self.mask.any(dim=side).nonzero().flatten().tolist() for side in (0, 1)
        )
        return (columns[0], rows[0], columns[-1] + 1, rows[-1] + 1) if rows else None

    @cached_property
    def numbers(self) -> Mapping[str, float]:
        """The numbers of the configuration: of everything that varies, and of what the
        scene was given.
        """
        return MappingProxyType(dict(self.describe()))

    def number(self, name: str) -> float:
        """Return the number that a parameter has in this configuration. Raises
        InputError: nothing in the scene is called that.
        """
        if name not in self.numbers:
            known = ", ".join(sorted(self.numbers)) or "none"
            raise InputError(
                f"the task needs {name}, and the scene has numbers for {known}; add "
                "its control or `set` it"
            )
        return self.numbers[name]


@dataclass(frozen=True, kw_only=True)
class Task(ABC):
    """How a model's output is judged against what is true of the scene. Write one by
    the three abstract methods.

    A task is a dataclass; its fields are its options, but for those marked `FROM_RUN`:
    `on` gives the one that a run works with.

    Attributes:
        minimise: success is a right prediction: the object is to be made easier to
            recognise.
        target: what is sought in place of any wrong prediction, as if it were the
            truth; None for any.
        name: on the command line.
        objective: name of the objective where none is asked for; "score" is the task's
            own score.
        reads_logits: whether its models return logits (N, classes). Then their outputs
            are checked as such, and the objectives of classification take them.
        labelled: whether it takes a label; with one that takes none, others get it
            (`together`).
        names_from: where its names come from, if neither from the model nor from the
            setting `labels`.
        varies: whether the truth depends on the configuration; it is asked for at each
            one then.
        judges_rig: whether it judges the images of several cameras together.
        needs_all_images: whether one output is made of all images of a rig.
    """

    name: ClassVar[str]
    objective: ClassVar[str] = "score"
    reads_logits: ClassVar[bool] = False
    labelled: ClassVar[bool] = True
    names_from: ClassVar[str] = ""
    varies: ClassVar[bool] = False
    judges_rig: ClassVar[bool] = False
    needs_all_images: ClassVar[bool] = False

    minimise: bool = field(default=False, metadata=FROM_RUN)
    target: Truth = field(default=None, metadata=FROM_RUN)

    def __init_subclass__(cls, **more: Any) -> None:
        super().__init_subclass__(**more)
        asked = (
            "loss score predictions payloads marks judge said average "
            "after_calibration as_logits"
        ).split()
        hand_copies(cls, truth_names=slice(None), **dict.fromkeys(asked, slice(None)))

    def check_numbers(
        self, fits: Callable[[float], bool], expected: str, *names: str
    ) -> None:
        """Check options that are numbers. Raises InputError where one is none, or does
        not fit; it says what was `expected`.
        """
        for name in names:
            value: object = getattr(self, name)
            if (
                isinstance(value, bool)
                or not isinstance(value, (int, float))
                or not fits(value)
            ):
                raise InputError(
                    f"task {self.name}: {name}: expected {expected}, got {value!r}"
                )

    # ---- what a task has to say
    # -------------------------------------------------------------------------------------

    @abstractmethod
    def truth(self, facts: Facts) -> Truth:
        """Return what is true of the scene. Raises InputError: the facts do not say it,
        or the model cannot predict it.
        """

    @abstractmethod
    def loss(self, output: Output, truth: Truth) -> Tensor:
        """Return how wrong each of N outputs is, (N,): over 0 exactly where it is not
        right; differentiable.

        It is maximised where no other objective is asked for, so it should rise towards
        a wrong prediction from afar.
        """

    @abstractmethod
    def predictions(
        self, output: Output, count: int = 1
    ) -> list[tuple[Prediction, ...]]:
        """Return what the model says of each of N pictures: at most `count`
        predictions, the likeliest first.
        """

    # ---- what it may say
    # --------------------------------------------------------------------------------------------

    def read(self, returned: Any, count: int) -> Output:
        """Return the output in what a network returned for `count` pictures.

        Not called where the task `reads_logits`. What a network returns for each
        picture is kept in this order. Raises ValueError: there is none; the text says
        what was expected.
        """
        if isinstance(returned, Tensor) and returned.shape[:1] == (count,):
            return returned.float()
        raise ValueError(f"expected a tensor with {count} rows, one for each picture")

    def wrapped(self, network: Callable[..., Any]) -> Callable[..., Any]:
        """Return a network as it is called with pictures alone; its own, unless the
        task gives it more.
        """
        return network

    @property
    def calibrates(self) -> bool:
        """Whether the task is to be shown an output for a clean picture of the scene
        (`after_calibration`) before it judges.
        """
        return False

    def after_calibration(self: Own, output: Output, truth: Truth | None) -> Own:
        """Return the task with what its model's output for a clean picture of the scene
        shows of how outputs are read.

        Args:
            output: of one picture.
            truth: of the scene; None where nobody knows it.
        """
        return self

    @property
    def ambiguities(self) -> str:
        """What has to be said for its model's outputs to be read, as a message; empty
        where nothing has.
        """
        return ""

    @property
    def remarks(self) -> tuple[str, ...]:
        """Sentences that a reader has to know about how outputs are read."""
        return ()

    @property
    def reader(self) -> Callable[[Any, int], Output] | None:
        """What reads the outputs of its models; None where these are logits."""
        return None if self.reads_logits else self.read

    def on(
        self: Own, model: Model, *, target: str | None = None, minimise: bool = False
    ) -> Own:
        """Return the task for one model and what is sought.

        Args:
            model: whose output it will judge.
            target: the label that the model should predict; None for any wrong one.
            minimise: a right prediction is sought.

        Raises:
            InputError: there is no such target, or the task has none.
        """
        if target is not None:
            raise InputError(f"target: task {self.name} has none; leave it out")
        return replace(self, minimise=minimise)

    def seeking(self: Own, objective: str) -> Own:
        """Return the task where an objective of its own is maximised, which may say
        what counts as success.
        """
        return self

    def check(self, facts: Facts) -> None:
        """Refuse a scene of which nothing could be judged, before anything is rendered.
        Raises InputError: as for `truth`.
        """
        if not self.varies:
            self.truth(facts)

    def score(self, output: Output, truth: Truth) -> Tensor:
        """Return (N,): over 0 exactly where an output is a success; differentiable."""
        if self.target is not None:
            return -self.loss(output, self.target)
        loss = self.loss(output, truth)
        return -loss if self.minimise else loss

    def as_logits(self, output: Output, truth: Truth) -> Output:
        """Return the output as objectives of logits take it: without what is no
        prediction.
        """
        return output

    def payloads(self, output: Output) -> Sequence[Any]:
        """Return what is kept of each of N outputs beside the words, as JSON values."""
        return [None] * len(output)

    def marks(self, output: Output, truth: Truth) -> list[list[Mark]]:
        """Return what is drawn into each of N pictures to show the prediction; empty
        where words say it all.
        """
        return [[] for _ in range(len(output))]

    def average(self, outputs: Sequence[Output]) -> Output:
        """Return one output for several pictures of a configuration; each is of one
        picture, as is the result.
        """
        return torch.stack(list(outputs)).mean(dim=0)

    @property
    def of_one_image(self) -> Task:
        """The task of a single image: of a rig of cameras that of each of its images,
        otherwise the task itself.
        """
        return self

    @property
    def title(self) -> str:
        """What the task is called in results."""
        return self.name

    @property
    def goal(self) -> str:
        """What counts as success, in words."""
        return (
            "a target answer"
            if self.target is not None
            else "a right answer"
            if self.minimise
            else "a wrong answer"
        )

    @property
    def target_names(self) -> tuple[str, ...]:
        """The labels that are sought; empty where any wrong one is."""
        return () if self.target is None else self.truth_names(self.target)

    def truth_names(self, truth: Truth) -> tuple[str, ...]:
        """Return the right labels in words."""
        return (str(truth),)

    # ---- the judgement
    # ----------------------------------------------------------------------------------------------

    def judge(self, output: Output, truth: Truth) -> list[Judgement]:
        """Return what is to be said of each of N outputs."""
        with torch.no_grad():
            scores = self.score(output, truth).tolist()
            margins = (0.0 - self.loss(output, truth)).tolist()
            each = zip(scores, margins, self.said(output, truth, margins), strict=True)
            return [Judgement.of(score, margin, *said) for score, margin, said in each]

    def said(
        self, output: Output, truth: Truth, margins: Sequence[float]
    ) -> list[Said]:
        """Return the prediction of each of N pictures, and what is kept beside it;
        `margins` are theirs.
        """
        return [
            (first, kept)
            for (first, *_), kept in zip(
                self.predictions(output), self.payloads(output), strict=True
            )
        ]


def typical(judgements: Sequence[Judgement]) -> Judgement:
    """Return what the model usually says: the most frequent prediction (the lowest
    index of equals), with the mean score, margin and probability of the judgements that
    have it.
    """
    counts = Counter((one.prediction.label, one.prediction.index) for one in judgements)
    label, index = min(counts, key=lambda key: (-counts[key], key[1] or 0))
    chosen = [
        one
        for one in judgements
        if (one.prediction.label, one.prediction.index) == (label, index)
    ]
    sure = [
        one.prediction.probability
        for one in chosen
        if one.prediction.probability is not None
    ]
    prediction = Prediction(label, index, mean(sure) if sure else None)
    margins = [one.margin for one in chosen]
    scores = [one.score for one in chosen]
    return Judgement(
        mean(scores), mean(margins), chosen[0].right, prediction, chosen[0].payload
    )


def mean(values: Sequence[float]) -> float:
    """Return the mean of at least one number."""
    return math.fsum(values) / len(values)
