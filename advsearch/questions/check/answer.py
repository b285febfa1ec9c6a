"""The result of `check`."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from advsearch.report.markup import InNotebook
from advsearch.runs.results.base import Fields, GradientStatus, JsonFloat, RunResult

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
