"""What `check` needs to know, and its result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal

from pydantic import Field

from advsearch.extend import (
    DerivativeConfig,
    ResultPart,
    RunResult,
    SceneConfig,
    ShownResult,
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
"""What is as it is unless it is given, and has to be left so with `all`."""


class CheckConfig(DerivativeConfig):
    """Everything that decides what `check` does: gradients of a scene against
    differences.
    """

    command: ClassVar[str] = "check"
    free: ClassVar[tuple[str, ...]] = (*DerivativeConfig.free, "seconds")

    # fmt: off
    clashes: ClassVar[tuple[settings.Clash, ...]] = (
        *DerivativeConfig.clashes,
        settings.Clash("all", lambda config: any(getattr(config, name) != value for name, value in OF_ALL.items()),
              "takes scenes and controls of its own; leave `object`, `environment`, "
              "`controls` and `set` out"),
        settings.Clash("objective", lambda config: config.loss == "linear",
              "is of the model's loss, which `loss=linear` leaves out; leave one of "
              "the two out"),
    )

    all: bool = setting(False, "check", "every control, on three bundled scenes; takes "
                                        "hours")
    loss: Literal["linear", "model", "both"] = setting(
        "both", "check",
        "what is differentiated: a smooth linear loss of the raw picture, the model's "
        "own, or both in turn",
    )
    # fmt: on
    seconds: float | None = setting(
        None,
        "check",
        "time after which no measurement is begun any more; `advsearch resume` goes on "
        "for as long again",
        otherwise="no limit",
        unit="seconds",
        gt=0.0,
        le=1e9,
    )  # fmt: skip
    run: str | None = setting_as_in(
        SceneConfig, "run", otherwise="runs/OBJECT-check-NNN"
    )

    @property
    def title(self) -> tuple[str, ...]:
        return "all" if self.all else self.object, self.command

    @property
    def losses(self) -> tuple[str, ...]:
        return ("linear", "model") if self.loss == "both" else (self.loss,)


class CheckedRow(results.Measured):
    """A derivative along a parameter, or the gradient of a whole control, beside its
    reference.
    """

    object: str
    environment: str
    loss: str = Field(description="`linear`, or `model`: the model's own")


class GainRow(results.Fields):
    """What leaving one thing out saves, and the proof that it changes nothing."""

    item: str
    what: str
    time_gain: float = Field(
        description="a gradient's time x the picture's variance "
        "with it, over those without it"
    )
    picture_difference: results.JsonFloat = Field(
        description="root mean square at one seed, over that of two seeds"
    )
    gradient_difference: results.JsonFloat = Field(
        description="the same of gradients; 0 where there are none"
    )
    safe: bool = Field(
        description="whether pictures and gradients agree to within their noise"
    )
    seconds: float = Field(description="of a gradient with it")


class TexelRow(results.Fields):
    """How many texels of a searched texture a pixel shows."""

    control: str = Field(description="whose texture")
    side: int = Field(description="of the texture, in texels")
    seen: int = Field(description="texels that light reaches the camera from directly")
    pixels: int = Field(description="pixels that show the surface")
    enough: int = Field(
        description="side, `side` halved as often as the pixels still resolve as much"
    )


class SearchPlan(results.PlannedGradient):
    """How a search over the scene gets its derivatives, and what it leaves out."""

    left_out: list[str] = Field(description="what is not computed at all, in sentences")


class CheckResult(views.InNotebook, RunResult):
    """Every derivative of a scene beside differences, and the plan of a search over it,
    as far as they are measured.
    """

    command: ClassVar[str] = "check"

    object: str
    measured: int = Field(
        description="parts (a scene with a control and a loss) that are done"
    )
    planned: int = Field(description="all parts")
    rows: list[CheckedRow]
    plan: SearchPlan | None = results.optional("absent of `loss=linear` and of `all`")
    bounces: results.PathLength | None = results.optional(
        "how long the light paths of a long search are"
    )
    gains: list[GainRow] = Field(
        default=[], description="what is left out, and what that saves"
    )
    texels: list[TexelRow] = Field(default=[], description="of the searched textures")

    @property
    def falls_short(self) -> bool:
        return bool(short_names(self.rows))

    @property
    def brief(self) -> str:
        return f"{self.measured} of {self.planned} parts"


READING = (
    "Each row sets a derivative as a search gets it (gradient) beside one that takes "
    "far more renders (reference). ok: "
    "they agree within 5 %, and one gradient scatters by less than 20 % (noise); "
    "biased: they disagree; noisy: it "
    "scatters more; reference unusable: the reference is too noisy to tell. adjoint: a "
    "second render that carries all "
    "derivatives back at once; differences, secant: two renders with the parameter "
    "moved by a step. A cosine of 1 with "
    "the converged gradient means that a gradient points the right way."
)

SINGLE: Mapping[str, views.Column] = {
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
WHOLE: Mapping[str, views.Column] = {
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


def _step(group: results.GroupDerivative) -> str:
    if not group.step_reason:
        return ""
    unit = "" if group.unit == "1" else f" {group.unit}"
    return f"{group.step:.3g}" + (
        "" if group.step_in_unit is None else f" ({group.step_in_unit:.3g}{unit})"
    )


GROUPS: Mapping[str, views.Column] = {
    "parameter": "{0.name}",
    "numbers": "{0.size}",
    "estimator": "{0.estimator}",
    "step": _step,
}
GAINS: Mapping[str, views.Column] = {
    "left out": "{0.what}",
    "a gradient with it takes": "x {0.time_gain:.2f}",
    "picture differs": lambda row: _difference(row.picture_difference),
    "gradient differs": lambda row: _difference(row.gradient_difference),
    "": lambda row: "" if row.safe else "MORE THAN ITS NOISE",
}
LOSSES = {
    "linear": "Smooth linear loss of the raw picture",
    "model": "The model's loss, each parameter in the setting that is taken",
}


def shown(result: CheckResult) -> ShownResult:
    rows = result.rows
    left = result.planned - result.measured
    plan = result.plan
    sentences = []
    if left:
        stopped = (
            "The time was up" if result.ending == results.OUT_OF_TIME else "Stopped"
        )
        sentences.append(
            f"{stopped} after {result.measured} of {result.planned} parts (a scene, "
            "its controls and a loss)."
        )
    if short := short_names(rows):
        sentences.append(f"No estimator is good enough for {', '.join(short)}.")
    elif rows:
        sentences.append(
            f"Every parameter {'so far ' if left else ''}has a good gradient."
        )
    groups, left_out = (plan.groups, [*plan.left_out]) if plan else ([], [])
    reasons: dict[tuple[str, str], list[str]] = {}  # each once, with its parameters
    for group in groups:
        reasons.setdefault((group.estimator, group.reason), []).append(group.name)
    for group in groups:
        if group.step_reason:
            reasons.setdefault(("step", group.step_reason), []).append(group.name)
    if bounces := result.bounces:
        longest = (
            f"at most {bounces.depth} segments of {bounces.full}: {bounces.reason}"
        )
        left_out.append(f"light paths of a long search: {longest}")
    for texels in result.texels:
        seen = f"{texels.seen} are seen in {texels.pixels} pixels"
        left_out.append(
            f"texels of {texels.control}: {seen}, which resolve "
            f"{texels.enough} of {texels.side} a side"
        )
    why = [
        f"{what} of {', '.join(names)}: {reason}"
        for (what, reason), names in reasons.items()
    ]
    whole = [row for row in rows if row.quantity == "gradient"]
    facts = (
        {}
        if plan is None
        else {
            "renders a gradient": str(plan.renders_per_gradient),
            "samples": str(plan.spp),
        }
    )
    return ShownResult(
        " ".join(sentences),
        [
            ResultPart(text=[READING] if rows else []),
            *(
                ResultPart.table(
                    [
                        row
                        for row in rows
                        if row.loss == name and row.quantity == "derivative"
                    ],
                    SINGLE,
                    title=title,
                )
                for name, title in LOSSES.items()
            ),
            ResultPart.table(
                whole,
                WHOLE,
                title="The model's loss, cosine with the converged gradient",
            ),
            ResultPart.table(
                groups, GROUPS, title="How a search gets its derivatives", text=why
            ),
            ResultPart("Left out", left_out),
            ResultPart.table(result.gains, GAINS, title="What that saves"),
        ],
        facts,
    )


def short_names(rows: Sequence[CheckedRow]) -> list[str]:
    """Return the names of what no estimator is good enough for, each once.

    For each parameter and loss the row with the best status counts: an estimator that
    no plan would take may fall short. Of the model's loss those of whole controls
    count: what matters is where their gradient points.
    """
    order = ("ok", "reference unusable", "noisy", "biased")
    best: dict[tuple[str, ...], CheckedRow] = {}
    for row in rows:
        key = row.object, row.environment, row.loss, row.name
        counts = row.loss == "linear" or row.quantity == "gradient"
        if counts and (
            key not in best or order.index(row.status) < order.index(best[key].status)
        ):
            best[key] = row
    short = [row for row in best.values() if row.status in ("biased", "noisy")]
    return list(dict.fromkeys(f"{row.name} ({row.status})" for row in short))


def _difference(share: float) -> str:
    return "not at all" if share == 0.0 else f"by {share:.2g} of its noise"
