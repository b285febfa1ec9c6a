"""Depth: whether a model judges the object to be as far away as it is.

Models mean the z-depth, the distance along the camera's axis, and so it is what they
are compared with. Relative ones give it, or its inverse (disparity), up to a scale and
a shift, which are found by least squares (Ranftl et al. 2020, "Towards robust monocular
depth estimation", arXiv 1907.01341, sections 5 and 6). They are found on what is seen
beside the object, so that the object has no say in how it is judged.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from advsearch.extend import InputError, Model, Task, tasks

# cosine of the angle to the camera's axis from which on z-depth is no distance any more
ASIDE = 0.1
DISPARITY = "relative disparity"
RELATIVE = "relative depth"
METRIC = "metric depth"

KINDS = {
    DISPARITY: "the inverse of the distance, up to a scale and a shift",
    RELATIVE: "the distance, up to a scale and a shift",
    METRIC: "the distance in metres",
}
"""What a model's numbers may be."""

AS_FAR = "as far as it is"
OUT_OF_SHAPE = "out of shape"
NEARER = "nearer than it is"
FARTHER = "farther than it is"
GONE = "as far as what is behind it"
LABELS = {"nearer": NEARER, "farther": FARTHER, "gone": GONE}
GOALS = {
    "nearer": f"the object is judged {NEARER}",
    "farther": f"the object is judged {FARTHER}",
    "gone": f"the object is judged to be {GONE}",
}
"""What an attack may be after, by the name of the objective."""

FEWEST = 16
SPREAD = 1.1
"""Pixels beside the object on which scale and shift are found, at least, and how many
times as far as the nearest of them the farthest is.
"""
LARGEST = 100.0  # the largest factor by which a pixel counts as too near or too far

Map = Mapping[str, Tensor]
"""What a model returns for one picture: (h, w), by one of `KINDS`, or by "" where it
does not say.
"""


@dataclass(frozen=True, eq=False)
class Distances:
    """What is true of a picture: in which pixels the object is seen, (H, W) bool, and
    the z-depth of everything, (H, W), infinite where there is nothing: in metres, or in
    object sizes where the object's `metres` are not known.
    """

    mask: Tensor
    z: Tensor
    metres: float | None = None

    @property
    def seen(self) -> bool:
        """Whether there is anything of the object in the picture."""
        return bool(self.mask.any())

    @cached_property
    def beside(self) -> Tensor:
        """What is seen beside the object at a finite distance, (H, W) bool."""
        return self.z.isfinite() & ~self.mask

    @cached_property
    def anchored(self) -> bool:
        """Whether what is beside the object says scale and shift: enough pixels at
        distances that differ enough.
        """
        there = self.z[self.beside]
        return len(there) >= FEWEST and float(there.max()) >= SPREAD * float(
            there.min()
        )

    @property
    def fitted(self) -> Tensor:
        """Where scale and shift are found, (H, W) bool: beside the object, or in the
        whole picture where that says nothing.
        """
        return self.beside if self.anchored else self.z.isfinite()

    @cached_property
    def behind(self) -> Tensor:
        """The disparity of what is behind the object, as far as it can be told, (H, W):
        NaN where it can't. It is that of the nearest pixels beside the object in the
        same row, in a straight line between both: exact of a plane. What is infinitely
        far has a disparity of 0.
        """
        height, width = self.mask.shape
        inverse = self.z.reciprocal()
        column = torch.arange(width).expand(height, width)
        left = torch.where(self.mask, -1, column).cummax(dim=1).values
        right = (
            torch.where(self.mask, width, column).flip(1).cummin(dim=1).values.flip(1)
        )
        first = inverse.gather(1, left.clamp_min(0))
        last = inverse.gather(1, right.clamp_max(width - 1))
        between = first + (column - left) / (right - left).clamp_min(1) * (last - first)
        found = torch.where(left < 0, last, torch.where(right == width, first, between))
        return torch.where((left < 0) & (right == width), math.nan, found)


@dataclass(frozen=True, kw_only=True)
class Depth(Task):
    """A model judges how far the object is: off by a factor of less than 1 +
    `tolerance`, its pixels' geometric mean.

    Where nothing of the object is seen, every prediction is right.

    Args:
        tolerance: 0.25 for a factor of 1.25, the first threshold of Eigen et al. 2014
            (arXiv 1406.2283).
        kind: of the model's numbers, one of `KINDS`; "" for what the network says.
        size: of the real object, its longest side in metres, for a model that predicts
            metres; the scene's own without it.
        seek: what an attack is after, one of `GOALS`; "" for any wrong distance.

    Raises:
        InputError: a value that is none of these.
    """

    name = "depth"
    labelled = False
    varies = True

    tolerance: float = 0.25
    kind: str = ""
    size: float = 0.0
    seek: str = ""
    seen_kind: str = field(default="", metadata=tasks.FROM_RUN)  # what the network says
    missing: str = field(
        default="", metadata=tasks.FROM_RUN
    )  # what its user has to say before predictions can be judged

    def __post_init__(self) -> None:
        self.check_numbers(
            lambda value: 0.0 < value < LARGEST,
            "a number over 0, under 100",
            "tolerance",
        )
        self.check_numbers(
            lambda value: -1e-9 < value < 1e6, "a number over 0, under 1e+06", "size"
        )
        for name, known in (("kind", KINDS), ("seek", GOALS)):
            if getattr(self, name) not in ("", *known):
                raise InputError(
                    f"task depth: {name}: expected one of "
                    f"{', '.join(known)}, got {getattr(self, name)!r}"
                )

    # ---- what is read
    # -----------------------------------------------------------------------------------------------

    def read(self, returned: Any, count: int) -> list[Map]:
        """Return the map (h, w) of each picture in what a network returned, by what its
        numbers are. Raises ValueError: there is none.
        """
        kind = ""
        if isinstance(returned, Mapping):
            kind = next((one for one in KINDS if one in returned), "")
            returned = (
                returned[kind]
                if kind
                else returned.get("predicted_depth", returned.get("depth"))
            )
        elif hasattr(returned, "predicted_depth"):
            returned = returned.predicted_depth
        elif isinstance(returned, (list, tuple)) and returned:
            boxes = isinstance(returned[0], Tensor) and returned[0].shape[-1:] == (4,)
            returned = None if boxes and len(returned) > 1 else returned[0]
        if (
            isinstance(returned, Tensor)
            and returned.ndim == 4
            and returned.shape[1] == 1
        ):
            returned = returned[:, 0]
        if (
            not isinstance(returned, Tensor)
            or returned.ndim != 3
            or len(returned) != count
            or 0 in returned.shape
        ):
            raise ValueError(
                "expected a number for each pixel, (N, height, width) or (N, 1, "
                "height, width), or a mapping with "
                f"these under predicted_depth or {', '.join(KINDS)}"
            )
        return [{kind: one} for one in returned.float()]

    def on(
        self, model: Model, *, target: str | None = None, minimise: bool = False
    ) -> Depth:
        """See `Task.on`. Raises InputError: the model was loaded for another task or
        with names of classes, or there is a target.
        """
        if model.read is None:
            raise InputError(
                f"model {model.name}: it was loaded for its logits; load "
                'it with task="depth"'
            )
        if model.labels:
            raise InputError(
                "labels: task depth has no classes; leave them out, or give a network "
                "without classes of its own"
            )
        return super().on(model, target=target, minimise=minimise)

    def seeking(self, objective: str) -> Depth:
        return replace(self, seek=objective) if objective in GOALS else self

    @property
    def calibrates(self) -> bool:
        return True

    def after_calibration(
        self, output: Sequence[Map], truth: Distances | None
    ) -> Depth:
        kind = self.kind or next(iter(output[0]))
        return replace(self, seen_kind=kind, missing=self._missing(kind, truth))

    def _missing(self, kind: str, truth: Distances | None) -> str:
        if not kind:
            return (
                f"kind: expected what its numbers are, one of {', '.join(KINDS)}, and "
                "its network does not say it; "
                f"give `task='depth={{kind: {DISPARITY}}}'`, say"
            )
        if kind == METRIC and not self.size and (truth is None or truth.metres is None):
            return (
                "size: it predicts metres, and how large the object is is not known; "
                "give its longest side in metres, "
                "such as `size=0.1`"
            )
        if kind != METRIC and truth is not None and truth.seen and not truth.anchored:
            return (
                "it predicts up to a scale and a shift, which are found on what is "
                "seen beside the object: expected "
                f"{FEWEST} pixels at distances that differ by a factor of {SPREAD:g}, "
                f"got {int(truth.beside.sum())}; "
                "give a scene with a ground or a room, and a camera that sees it from "
                "the side"
            )
        return ""

    @property
    def ambiguities(self) -> str:
        return self.missing

    @property
    def remarks(self) -> tuple[str, ...]:
        if not self.seen_kind:
            return ()
        text = (
            f"The model's numbers are read as {self.seen_kind}: {KINDS[self.seen_kind]}"
        )
        if self.seen_kind == METRIC:
            return (
                f"{text}, of an object of {self.size:g} m."
                if self.size
                else f"{text}.",
            )
        return (
            f"{text}, which are found by least squares on what is seen beside the "
            "object.",
        )

    def check(self, facts: tasks.Facts) -> None:
        """See `Task.check`. Raises InputError: there is a label."""
        if facts.label is not None:
            raise InputError("label: task depth has no classes; leave it out")

    def truth(self, facts: tasks.Facts) -> Distances:
        """Return where the object is seen, and how far everything is. Raises
        InputError: the lens sees so far aside that the distance along its axis says
        nothing.
        """
        if bool((facts.z_depth < ASIDE * facts.depth).any()):
            raise InputError(
                "task depth: a model's depth is the distance along the camera's axis, "
                "and this lens sees things more "
                f"than {math.degrees(math.acos(ASIDE)):.0f} degrees from its axis; "
                "take a lens that sees less"
            )
        return Distances(facts.mask, facts.z_depth, facts.sight.metres)

    def truth_names(self, truth: Distances) -> tuple[str, ...]:
        return (AS_FAR,)

    # ---- scores
    # -----------------------------------------------------------------------------------------------------

    def loss(self, output: Sequence[Map], truth: Distances) -> Tensor:
        """Return by how much more than the tolerance the object's distance is off,
        (N,). That is the mean over its pixels of |log(judged / true)|, less log(1 +
        tolerance).
        """
        return self._each(
            output, truth, lambda factors: factors.abs().mean() - self._bar
        )

    def score(self, output: Sequence[Map], truth: Distances) -> Tensor:
        """Return how near each of N outputs is to what is sought, (N,): over 0 where it
        is a success. "nearer" and "farther" take the mean over pixels with its sign.
        "gone" is the lesser of the loss, and of how far the share of the object's
        relief that is left lies under a half; see `_relief`.
        """
        if self.minimise or not self.seek:
            return super().score(output, truth)
        if self.seek == "gone":
            return self._each(
                output,
                truth,
                lambda f: torch.minimum(
                    f.abs().mean() - self._bar, 0.5 - self._relief(f, truth)
                ),
            )
        sign = 1.0 if self.seek == "farther" else -1.0
        return self._each(
            output, truth, lambda factors: sign * factors.mean() - self._bar
        )

    @property
    def _bar(self) -> float:
        return math.log1p(self.tolerance)

    def _each(self, output: Sequence[Map], truth: Distances, value: Any) -> Tensor:
        """A value of the logarithms of factors of the object's pixels, picture by
        picture, (N,).
        """
        if not truth.seen:
            return torch.stack(
                [next(iter(one.values())).sum() * 0.0 - 1.0 for one in output]
            )
        return torch.stack([value(self._factors(one, truth)) for one in output])

    def _factors(self, one: Map, truth: Distances) -> Tensor:
        """log(judged / true) of each of the object's pixels, (P,); none is larger than
        `LARGEST`.
        """
        judged, inverse = self._judged(one, truth)
        mask = truth.mask.to(judged.device)
        z = truth.z.to(judged.device)
        ratio = judged[mask] * z[mask] if inverse else judged[mask] / z[mask]
        logarithms = ratio.clamp(1.0 / LARGEST, LARGEST).log()
        whole = judged.sum() * 0.0  # a number that is none anywhere in the map
        return (-logarithms if inverse else logarithms) + whole

    def _judged(self, one: Map, truth: Distances) -> tuple[Tensor, bool]:
        """What the model says of every pixel, (H, W) z-depth as the truth has it, or
        its inverse; and which of the two. A map is brought to the size of the picture
        as transformers does it in `post_process_depth_estimation`.
        """
        ((said, values),) = one.items()
        kind = self.kind or said
        size = (truth.mask.shape[0], truth.mask.shape[1])
        if values.shape != size:
            values = F.interpolate(
                values[None, None], size=size, mode="bicubic", align_corners=False
            )[0, 0]
        z = truth.z.to(values.device)
        at = truth.fitted.to(values.device)
        if kind == METRIC:
            return values * (
                (truth.metres or 1.0) / self.size if self.size else 1.0
            ), False
        return (
            (_fitted(values, z.reciprocal(), at), True)
            if kind == DISPARITY
            else (_fitted(values, z, at), False)
        )

    def _relief(self, factors: Tensor, truth: Distances) -> Tensor:
        """The share of the object's relief that is left, (): 1 where all is as it is, 0
        where it is as far as what is behind it, in disparity, by least squares over its
        pixels; 1 where nothing is known to be behind it.
        """
        mask = truth.mask
        inverse = truth.z[mask].reciprocal().to(factors)
        behind = truth.behind[mask].to(factors)
        known = behind.isfinite()
        true = (inverse - behind)[known]
        size = true.square().sum()
        if float(size) <= 1e-6 * float(inverse.square().sum()):
            return factors.sum() * 0.0 + 1.0
        said = (inverse * (-factors).exp() - behind)[known]
        return (said * true).sum() / size

    # ---- in words
    # ---------------------------------------------------------------------------------------------------

    def predictions(
        self, output: Sequence[Map], count: int = 1
    ) -> list[tuple[tasks.Prediction, ...]]:
        """Return between which numbers each map is."""
        found: list[tuple[tasks.Prediction, ...]] = []
        for one in output:
            ((said, values),) = one.items()
            low, high = (float(end) for end in values.detach().aminmax())
            text = f"{self.kind or said or 'numbers'} from {low:.3g} to {high:.3g}"
            found.append(
                (
                    tasks.Prediction(
                        text if math.isfinite(low + high) else tasks.NOT_A_NUMBER
                    ),
                )
            )
        return found

    def said(
        self, output: Sequence[Map], truth: Distances, margins: Sequence[float]
    ) -> list[tasks.Said]:
        """See `Task.said`; the payload has the factor by which the distance is off,
        what is left of the relief, and where scale and shift were found.
        """
        if not truth.seen:
            return [(tasks.Prediction(tasks.OUT_OF_VIEW), None)] * len(output)
        found: list[tasks.Said] = []
        distance = float(truth.z[truth.mask].double().log().mean().exp())
        for one, margin in zip(output, margins, strict=True):
            factors = self._factors(one, truth)
            mean = float(factors.mean())
            relief = float(self._relief(factors, truth))
            payload: dict[str, tasks.JsonValue] = {
                "distance": round(distance, 4),
                "judged": round(distance * math.exp(mean), 4),
                "factor": round(math.exp(float(factors.abs().mean())), 4),
                "relief": round(relief, 4),
            }
            if (self.kind or next(iter(one))) != METRIC:
                payload["fitted"] = (
                    "beside the object" if truth.anchored else "in the whole picture"
                )
            holds = {
                "nearer": -mean > self._bar,
                "farther": mean > self._bar,
                "gone": relief < 0.5,
            }
            names = sorted(
                ("gone", "nearer", "farther"), key=lambda name: name != self.seek
            )
            wrong = next((LABELS[name] for name in names if holds[name]), OUT_OF_SHAPE)
            found.append(
                (tasks.Prediction(AS_FAR if margin >= 0.0 else wrong), payload)
            )
        return found

    def marks(self, output: Sequence[Map], truth: Distances) -> list[list[tasks.Mark]]:
        """See `Task.marks`: the object, its pixels of which the distance is right, and
        the disparity of everything.
        """
        found = []
        for one in output:
            marks = [
                tasks.Mark("disparity", True, mask=truth.mask, map=truth.z.reciprocal())
            ]
            kind = self.kind or next(iter(one))
            if truth.seen and not self._missing(
                kind, truth if kind == METRIC else None
            ):
                right = torch.zeros_like(truth.mask)
                right[truth.mask] = (
                    self._factors(one, truth).detach().abs() <= self._bar
                ).to(right.device)
                judged, inverse = self._judged(one, truth)
                near = (
                    judged if inverse else judged.clamp_min(1.0 / LARGEST).reciprocal()
                )
                marks.append(
                    tasks.Mark("disparity", False, mask=right, map=near.detach().cpu())
                )
            found.append(marks)
        return found


def _fitted(values: Tensor, wanted: Tensor, at: Tensor) -> Tensor:
    """Return a scale times the values (H, W) plus a shift, the nearest to what is
    wanted where `at` (H, W) says, by least squares; there is a pixel there, and what is
    wanted is finite. A scale is not negative: what the model holds for near stays near.
    """
    x = values[at]
    y = wanted[at]
    x, y, middle, level = x - x.mean(), y - y.mean(), x.mean(), y.mean()
    scale = ((x * y).sum() / x.square().sum().clamp_min(1e-20)).clamp_min(0.0)
    return level + scale * (values - middle)
