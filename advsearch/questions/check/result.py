"""The settings and the result of `check`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal

from pydantic import Field

from advsearch.extend import (
    DerivativeConfig,
    RunResult,
    SceneConfig,
    results,
    setting,
    setting_as_in,
    settings,
    views,
)

OF_ALL: Mapping[str, object] = {
    "object": "mug",
    "environment": None,
    "controls": {"texture": {}},
    "set_": {},
}
"""Defaults of the settings that cannot be changed with `all`."""


class CheckConfig(DerivativeConfig):
    """The settings of `check`: gradients of a scene against differences."""

    command: ClassVar[str] = "check"
    changeable_settings: ClassVar[tuple[str, ...]] = (
        *DerivativeConfig.changeable_settings,
        "seconds",
    )

    clashes: ClassVar[tuple[settings.Clash, ...]] = (
        *DerivativeConfig.clashes,
        settings.Clash(
            "all",
            lambda config: any(
                getattr(config, name) != value for name, value in OF_ALL.items()
            ),
            "takes scenes and controls of its own; leave `object`, `environment`, "
            "`controls` and `set` out",
        ),
        settings.Clash(
            "objective",
            lambda config: config.loss == "linear",
            "belongs to the model's loss, which `loss=linear` leaves out; leave one of "
            "the two out",
        ),
    )

    all: bool = setting(
        False, "check", "every control, on three bundled scenes; takes hours"
    )
    loss: Literal["linear", "model", "both"] = setting(
        "both",
        "check",
        "what is differentiated: a smooth linear loss of the raw picture, the model's "
        "own, or both in turn",
    )
    seconds: float | None = setting(
        None,
        "check",
        "time after which no further measurement begins; `advsearch resume` continues "
        "for as long again",
        otherwise="no limit",
        unit="seconds",
        gt=0.0,
        le=1e9,
    )
    run: str | None = setting_as_in(
        SceneConfig, "run", otherwise="runs/OBJECT-check-NNN"
    )

    @property
    def run_name_words(self) -> tuple[str, ...]:
        return "all" if self.all else self.object, self.command

    @property
    def losses(self) -> tuple[str, ...]:
        """The losses that are differentiated."""
        return ("linear", "model") if self.loss == "both" else (self.loss,)


class CheckedRow(results.Measured):
    """A derivative along a parameter, or the gradient of a control, and its
    reference.
    """

    object: str
    environment: str
    loss: str = Field(description="`linear`, or `model` for the loss of the model")


class GainRow(results.Fields):
    """What leaving one thing out saves, and the proof that it changes nothing."""

    item: str
    what: str
    time_gain: float = Field(
        description="time of a gradient x variance of the picture, with the item "
        "divided by without it"
    )
    picture_difference: results.JsonFloat = Field(
        description="difference of the pictures with and without it at the same seed, "
        "divided by the difference between two seeds"
    )
    gradient_difference: results.JsonFloat = Field(
        description="the same for gradients; 0 if there are none"
    )
    safe: bool = Field(
        description="whether pictures and gradients agree within their noise"
    )
    seconds: float = Field(description="time of a gradient with the item")


class TexelRow(results.Fields):
    """How many texels of a searched texture are visible, and how many suffice."""

    control: str = Field(description="the control that changes the texture")
    side: int = Field(description="side of the texture, in texels")
    seen: int = Field(
        description="visible texels: light gets directly from them to the camera"
    )
    pixels: int = Field(description="pixels that show the texture")
    enough: int = Field(
        description="smallest sufficient side: `side` halved while there are still "
        "enough texels for the pixels"
    )


class SearchPlan(results.PlannedGradient):
    """How a search over the scene gets its derivatives, and what it leaves out."""

    left_out: list[str] = Field(description="sentences about what is not computed")


class CheckResult(views.InNotebook, RunResult):
    """Every derivative of a scene, compared with differences, and the plan of a
    search.
    """

    command: ClassVar[str] = "check"

    object: str
    measured: int = Field(
        description="number of parts (a scene with a control and a loss) that are done"
    )
    planned: int = Field(description="number of all parts")
    rows: list[CheckedRow]
    plan: SearchPlan | None = results.optional_field(
        "plan of a search; absent with `loss=linear` and with `all`"
    )
    bounces: results.PathLength | None = results.optional_field(
        "how long the light paths of a search with many steps are"
    )
    gains: list[GainRow] = Field(
        default=[], description="what is left out, and what that saves"
    )
    texels: list[TexelRow] = Field(
        default=[], description="texels of the searched textures"
    )

    @property
    def falls_short(self) -> bool:
        """Whether a gradient is biased or noisy."""
        return bool(find_inadequate(self.rows))

    @property
    def outcome_summary(self) -> str:
        """How many parts are measured."""
        return f"{self.measured} of {self.planned} parts"


READING = (
    "Each row compares a derivative as a search gets it (gradient) with one that takes "
    "far more renders (reference). ok: they agree within 5 %, and single gradients "
    "scatter by less than 20 % (noise); biased: they disagree; noisy: gradients scatter "
    "more; reference unusable: the reference is too noisy to compare with. adjoint: a "
    "second render that propagates all derivatives back at once; differences, secant: "
    "two renders with the parameter changed by a step. A cosine of 1 with the converged "
    "gradient means that a gradient has the right direction."
)

DERIVATIVE_COLUMNS: Mapping[str, views.Column] = {
    "object": "{0.object}",
    "parameter": "{0.name}",
    "estimator": "{0.estimator}",
    "step": "x {0.factor:.2g}",
    "gradient": "{0.value:.3g}",
    "reference": "{0.reference:.3g}",
    "error": lambda row: f"{100 * row.bias:.1f} %",
    "noise": lambda row: f"{100 * row.noise:.0f} %",
    "seconds": "{0.seconds:.2f}",
    "status": "{0.status}",
}
GRADIENT_COLUMNS: Mapping[str, views.Column] = {
    "object": "{0.object}",
    "control": "{0.control}",
    "estimator": "{0.estimator}",
    "step": "x {0.factor:.3g}",
    "samples": "{0.spp}",
    "cosine": "{0.cosine:.3f}",
    "of converged ones": "{0.reference_cosine:.3f}",
    "seconds": "{0.seconds:.2f}",
    "status": "{0.status}",
}


def _step_text(group: results.GroupDerivative) -> str:
    """Return the step of finite differences; empty without one.

    It is a fraction of the parameter's range. In parentheses follows the step in the
    parameter's unit, if that is a single number.
    """
    if not group.step_reason:  # the estimator takes no differences
        return ""
    if group.step_in_unit is None:
        return f"{group.step:.3g}"
    unit = "" if group.unit == "1" else f" {group.unit}"
    return f"{group.step:.3g} ({group.step_in_unit:.3g}{unit})"


GROUP_COLUMNS: Mapping[str, views.Column] = {
    "parameter": "{0.name}",
    "numbers": "{0.size}",
    "estimator": "{0.estimator}",
    "step": _step_text,
}
GAIN_COLUMNS: Mapping[str, views.Column] = {
    "left out": "{0.what}",
    "a gradient with it takes": "x {0.time_gain:.2f}",
    "picture differs": lambda row: _difference_text(row.picture_difference),
    "gradient differs": lambda row: _difference_text(row.gradient_difference),
    "": lambda row: "" if row.safe else "MORE THAN ITS NOISE",
}
LOSSES = {
    "linear": "Smooth linear loss of the raw picture",
    "model": "The model's loss, each parameter with the estimator and step that are used",
}


def make_check_view(result: CheckResult) -> views.ShownResult:
    """Return the view of a check.

    It has tables of derivatives, of the model's gradients, of the plan of a search, and
    of what that plan leaves out.
    """
    gradient_rows = [row for row in result.rows if row.quantity == "gradient"]
    sections = [
        views.ResultPart(text=[READING] if result.rows else []),
        *_make_derivative_tables(result),
        views.ResultPart.make_table(
            gradient_rows,
            GRADIENT_COLUMNS,
            title="The model's loss, cosine with the converged gradient",
        ),
        views.ResultPart.make_table(
            result.plan.groups if result.plan else [],
            GROUP_COLUMNS,
            title="How a search gets its derivatives",
            text=_reason_texts(result),
        ),
        views.ResultPart("Left out", _left_out_texts(result)),
        views.ResultPart.make_table(
            result.gains, GAIN_COLUMNS, title="What that saves"
        ),
    ]
    return views.ShownResult(_verdict(result), sections, _list_costs(result))


def _make_derivative_tables(result: CheckResult) -> list[views.ResultPart]:
    """Return a table of derivatives for each loss."""
    tables = []
    for loss, title in LOSSES.items():
        derivatives = [
            row
            for row in result.rows
            if row.loss == loss and row.quantity == "derivative"
        ]
        tables.append(
            views.ResultPart.make_table(derivatives, DERIVATIVE_COLUMNS, title=title)
        )
    return tables


def _list_costs(result: CheckResult) -> dict[str, str]:
    """Return the renders and samples of a gradient of the plan, by what they are."""
    if result.plan is None:
        return {}
    return {
        "renders a gradient": str(result.plan.renders_per_gradient),
        "samples": str(result.plan.spp),
    }


def _verdict(result: CheckResult) -> str:
    """Return the result in a sentence or two."""
    sentences = []
    has_parts_left = result.measured < result.planned
    if has_parts_left:
        sentences.append(_describe_stop(result))
    names = find_inadequate(result.rows)
    if names:
        sentences.append(f"No estimator is good enough for {', '.join(names)}.")
    elif result.rows:
        so_far = "so far " if has_parts_left else ""
        sentences.append(f"Every parameter {so_far}has a good gradient.")
    return " ".join(sentences)


def _describe_stop(result: CheckResult) -> str:
    """Return a sentence about how far the check came, and why it stopped."""
    stopped = "Stopped"
    if result.ending == results.OUT_OF_TIME:
        stopped = "The time was up"
    return (
        f"{stopped} after {result.measured} of {result.planned} parts (a scene, "
        "its controls and a loss)."
    )


def _reason_texts(result: CheckResult) -> list[str]:
    """Return why a search takes its estimators and steps: each reason once."""
    groups = result.plan.groups if result.plan else []
    # (name of the group, what was chosen, why): all estimators first, then the steps
    choices = [(group.name, group.estimator, group.reason) for group in groups]
    choices += [
        (group.name, "step", group.step_reason) for group in groups if group.step_reason
    ]
    names_by_choice: dict[tuple[str, str], list[str]] = {}
    for name, choice, reason in choices:
        names_by_choice.setdefault((choice, reason), []).append(name)
    return [
        f"{choice} of {', '.join(names)}: {reason}"
        for (choice, reason), names in names_by_choice.items()
    ]


def _left_out_texts(result: CheckResult) -> list[str]:
    """Return what a search leaves out, in sentences."""
    texts = [*result.plan.left_out] if result.plan else []
    bounces = result.bounces
    if bounces:
        texts.append(
            f"light paths of a long search: at most {bounces.depth} segments instead of "
            f"{bounces.full}: {bounces.reason}"
        )
    for row in result.texels:
        texts.append(
            f"texels of {row.control}: {row.seen} are visible in {row.pixels} pixels; a "
            f"texture with a side of {row.enough} instead of {row.side} texels would "
            "suffice"
        )
    return texts


def find_inadequate(rows: Sequence[CheckedRow]) -> list[str]:
    """Return the names of parameters for which no estimator is good enough, each once.

    For each parameter and loss only the best row counts, as a plan may use that
    estimator alone. For the model's loss, gradients of full controls count and single
    derivatives do not: an attack needs the direction of the gradient. A parameter whose
    best estimator has an unusable reference is not reported, as its errors are unknown.
    """
    names = dict.fromkeys(
        f"{row.name} ({row.status})"
        for row in _find_best_rows(rows)
        if row.status in ("biased", "noisy")
    )
    return list(names)


def _find_best_rows(rows: Sequence[CheckedRow]) -> list[CheckedRow]:
    """Return the row of the best estimator of each parameter and loss.

    Single derivatives of the model's loss are left out.
    """
    order = ("ok", "reference unusable", "noisy", "biased")  # the best first
    best_rows: dict[tuple[str, ...], CheckedRow] = {}
    for row in rows:
        is_derivative = row.quantity == "derivative"
        if row.loss == "model" and is_derivative:
            continue
        key = (row.object, row.environment, row.loss, row.name)
        best = best_rows.get(key)
        if best is None or order.index(row.status) < order.index(best.status):
            best_rows[key] = row
    return list(best_rows.values())


def _difference_text(fraction: float) -> str:
    """Describe by how much something differs, as a fraction of its noise."""
    return "not at all" if fraction == 0.0 else f"by {fraction:.2g} of its noise"
