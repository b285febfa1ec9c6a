"""The result of `check`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar

from pydantic import Field

from advsearch.report.markup import InNotebook
from advsearch.report.shown import AnswerPart, Column, ShownAnswer
from advsearch.runs.results.base import OUT_OF_TIME, Fields, GradientStatus, JsonFloat, RunResult

WHOLE = "*"
"""What stands for the parameter in rows about a whole control."""


class CheckedPlace(Fields):
    """Where a derivative was checked, and of what."""

    object: str
    environment: str
    loss: str = Field(description="`linear`, or `model`: the model's own")


class GradientRow(CheckedPlace):
    """A derivative that was checked."""

    control: str
    parameter: str = Field(description="`*` for a whole control")
    estimator: str
    factor: float = Field(description="step as a multiple of the plan's")
    spp: int = Field(description="samples a pixel of the gradient")
    seconds: float = Field(description="of one gradient")
    status: GradientStatus

    @property
    def name(self) -> str:
        """``control.parameter``, or the name of the control where the row is about all of it."""
        return self.control if self.parameter == WHOLE else f"{self.control}.{self.parameter}"

    @property
    def short(self) -> bool:
        """Whether the gradient is not good enough."""
        return self.status in ("biased", "noisy")


class DirectionRow(GradientRow):
    """The gradient of a whole control beside the converged one."""

    cosine: JsonFloat
    converged: JsonFloat = Field(description="smallest cosine of two converged gradients")


class DerivativeRow(GradientRow):
    """The derivative along one parameter beside its reference."""

    gradient: JsonFloat = Field(description="mean over seeds")
    reference: JsonFloat = Field(description="by differences of many samples")
    reference_steps: tuple[JsonFloat, JsonFloat] = Field(description="its value at the larger and at the smaller step")
    reference_factor: float = Field(description="the larger step as a multiple of the plan's")
    reference_noise: JsonFloat
    relative_error: JsonFloat
    noise: JsonFloat = Field(description="standard deviation of one gradient, relative")


CheckedRow = DirectionRow | DerivativeRow


class CheckedRows(Fields):
    """Rows of both kinds."""

    rows: list[CheckedRow]


class CheckResult(InNotebook, CheckedRows, RunResult):
    """Every derivative of a scene beside differences, as far as they are measured."""

    command: ClassVar[str] = "check"

    object: str
    measured: int = Field(description="parts (a scene with a control and a loss) that are done")
    planned: int = Field(description="all parts")

    @property
    def brief(self) -> str:
        """How far it has come."""
        return f"{self.measured} of {self.planned} parts"


RESULT = CheckResult


READING = (
    "Each row sets a derivative as a search gets it (gradient) beside one that takes far more renders (reference). ok: "
    "they agree within 5 %, and one gradient scatters by less than 20 % (noise); biased: they disagree; noisy: it "
    "scatters more; reference unusable: the reference is too noisy to tell. adjoint: a second render that carries all "
    "derivatives back at once; differences, secant: two renders with the parameter moved by a step."
)

SINGLE: Mapping[str, Column] = {
    "object": "{0.object}",
    "parameter": "{0.name}",
    "estimator": "{0.estimator}",
    "step": "x {0.factor:.2g}",
    "gradient": "{0.gradient:.3g}",
    "reference": "{0.reference:.3g} +- {0.reference_noise:.1g}",
    "error": lambda one: f"{100 * one.relative_error:.1f} %",
    "noise": lambda one: f"{100 * one.noise:.0f} %",
    "seconds": "{0.seconds:.2f}",
    "status": "{0.status}",
}
WHOLE_CONTROLS: Mapping[str, Column] = {
    "object": "{0.object}",
    "control": "{0.control}",
    "estimator": "{0.estimator}",
    "step": "x {0.factor:.3g}",
    "samples": "{0.spp}",
    "cosine": "{0.cosine:.3f}",
    "converged": "{0.converged:.3f}",
    "seconds": "{0.seconds:.2f}",
    "status": "{0.status}",
}

LOSSES = {
    "linear": "Smooth linear loss of the raw picture",
    "model": "The model's loss, each parameter in the setting that is taken",
}


def shown(result: CheckResult) -> ShownAnswer:
    """Return what fell short, how to read the tables, and a table for each loss."""
    rows, left, said = result.rows, result.planned - result.measured, []
    if left:
        why = "The time was up" if result.ending == OUT_OF_TIME else "Stopped"
        said.append(f"{why} after {result.measured} of {result.planned} parts (a scene, its controls and a loss).")
    if short := short_names(rows):
        said.append(f"No estimator is good enough for {', '.join(short)}.")
    elif rows:
        said.append(f"Every parameter {'so far ' if left else ''}has a good gradient.")
    single = [row for row in rows if isinstance(row, DerivativeRow)]
    whole = [row for row in rows if isinstance(row, DirectionRow)]
    return ShownAnswer(
        " ".join(said),
        [
            AnswerPart(text=[READING] if rows else []),
            *(
                AnswerPart.table([row for row in single if row.loss == name], SINGLE, title=text)
                for name, text in LOSSES.items()
            ),
            AnswerPart.table(whole, WHOLE_CONTROLS, title="The model's loss, cosine with the converged gradient"),
        ],
    )


def short_names(rows: Sequence[CheckedRow]) -> list[str]:
    """Return the names of what no estimator is good enough for, each once."""
    return list(dict.fromkeys(f"{row.name} ({row.status})" for row in _best(rows) if row.short))


def _best(rows: Sequence[CheckedRow]) -> list[CheckedRow]:
    """For each parameter and loss the row with the best status: an estimator that no plan would take may fall short.

    Of the model's loss the rows of whole controls count: what matters is where their gradient points.
    """
    rows = [row for row in rows if row.loss == "linear" or isinstance(row, DirectionRow)]
    order = ("ok", "reference unusable", "noisy", "biased")
    best: dict[tuple[str, ...], CheckedRow] = {}
    for row in rows:
        key = row.object, row.environment, row.loss, row.control, row.parameter
        if key not in best or order.index(row.status) < order.index(best[key].status):
            best[key] = row
    return list(best.values())
