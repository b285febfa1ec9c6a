"""The settings of `harden`, its result, and the views of it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any, ClassVar, Literal

from pydantic import Field, JsonValue, model_validator

from advsearch.extend import (
    AttackConfig,
    ResultPart,
    RunResult,
    ShownResult,
    figures,
    results,
    setting,
    setting_as_in,
    views,
    wording,
)

STEPS = 40
"""Default of the steps of a search, as of an attack."""
ALL_OBJECTS = "all"
"""Value of `object` that stands for all bundled objects."""
PLAIN_SCENES = 6
"""Further scenes for each one of the training, with one plain view each.

With few of them the training generalizes worse to other scenes, and loses clean
accuracy.
"""
RENDERED_SCENES = 15
"""The same where controls are rendered: the view is rendered at random
configurations.
"""

TEXTURE_USES_PER_EPOCH = 6
"""How often an epoch uses a scene with a texture, over its views.

The texture is another one each time, while what was rendered stays.
"""

QUICK: dict[str, int] = {
    "rounds": 1,
    "scenes": 14,
    "views": 2,
    "epochs": 6,
    "measured": 14,
    "steps": 20,
}
"""Defaults of settings with `quick`: minutes instead of an hour."""


class HardenConfig(AttackConfig):
    """Settings of `harden`: training on worst cases, and measurement before and
    after.
    """

    # fmt: off
    command: ClassVar[str] = "harden"
    list_settings: ClassVar[tuple[str, ...]] = ("object", "environment")
    excluded_settings: ClassVar[tuple[str, ...]] = (
        "smallest", "ensemble", "printable", "aov", "metrics", "log", "target",
        "minimise", "over", "draws", "path", "shutter", "rolling", "average",
        "baseline", "seconds", "camera", "up", "facing", "size", "unit", "label",
        "measure", "estimators", "things", "judge", "backdrop", "occluder",
        "twins",
    )

    object: str = setting_as_in(
        AttackConfig, "object", default=ALL_OBJECTS,
        description="objects to train on, separated by commas; all: every bundled one "
                    "that the model has a class for; "
        "a file is called as its class: coffee-mug.glb",
    )
    environment: str | None = setting_as_in(
        AttackConfig, "environment",
        description="what lights the training; several, separated by commas, take turns",
        otherwise="the bundled environments that the reference model was trained in",
    )
    held_out: str | None = setting(
        None, "scene", "objects that training never sees, which are measured, "
                       "separated by commas",
        "names of objects or files", otherwise="other instances of the bundled objects",
        min_length=1,
    )
    held_out_environment: str | None = setting(
        None, "scene", "what lights the measurement, and never the training",
        "names of environments or files, separated by commas",
        otherwise="the bundled environments that the reference model was not trained in",
        min_length=1,
    )
    task: str | dict[str, JsonValue] = setting_as_in(
        AttackConfig, "task", description="what the model does: classification, "
                                          "detection or segmentation"
    )
    data: str | None = setting(
        None, "training", "pictures of your own that a detector is trained on too: "
                          "`annotations.json` and `images/`",
        "a folder, as of `export --format coco`", otherwise="none", min_length=1,
    )
    layers: Literal["all", "last"] = setting("all", "training", "layers that are trained")
    rounds: int = setting(2, "training", "rounds of search and training", ge=1, le=1000)
    scenes: int = setting(
        336, "training",
        "new scenes a round for each control; of what is rendered "
        f"{RENDERED_SCENES + 1} times as many",
        ge=1, le=100_000,
    )
    views: int = setting(2, "training", "views of each scene, unless it is rendered", ge=1, le=1000)
    epochs: int = setting(
        3, "training",
        "how often a round looks at each view; where a texture is searched, as many "
        "times as often as makes "
        f"{TEXTURE_USES_PER_EPOCH} for a scene, at most, over its views",
        ge=1, le=10_000,
    )
    rate: float = setting(1e-3, "training", "the highest learning rate", gt=0.0, le=1.0)
    clean_loss: float = setting(
        0.02, "training", "clean accuracy that may be lost; weights that lose more are "
                          "not kept", ge=0.0, le=1.0
    )
    measured: int = setting(28, "verification", "held-out scenes that are attacked, "
                                                "before and after", ge=1, le=100_000)
    steps: int = setting_as_in(AttackConfig, "steps", default=STEPS, otherwise="")
    trials: int | None = setting_as_in(AttackConfig, "trials", default=6)
    verify_spp: int | None = setting_as_in(AttackConfig, "verify_spp", default=32)
    workers: int | None = setting_as_in(
        AttackConfig, "workers", description="worker processes that share the scenes "
                                             "that are drawn and attacked"
    )
    quick: bool = setting(False, "training", "minutes instead of an hour: fewer "
                                             "rounds, scenes and steps")
    # fmt: on

    @model_validator(mode="before")
    @classmethod
    def _apply_quick(cls, data: Any) -> Any:
        """Fill in the defaults of `quick`; what is set stays."""
        return {**QUICK, **data} if data.get("quick") is True else data

    @property
    def texture_uses_per_epoch(self) -> int:
        """How often an epoch uses each view of a scene with a texture."""
        return max(1, TEXTURE_USES_PER_EPOCH // self.views)

    @property
    def title_words(self) -> tuple[str, ...]:
        return self.command, *self.controls


class Share(results.Fields):
    """The fraction of right predictions with its interval."""

    accuracy: float = Field(description="`right` of `count`")
    interval: results.Interval = Field(
        description="of that share, 95 %, over scenes of the objects at hand"
    )
    right: int
    count: int
    outcomes: results.Outcomes = results.optional_field(
        f"of plain pictures, {results.OUTCOME_TEXT} in the other ones; "
        f"{results.ONLY_OF_BOXES}"
    )


class HardenedControl(results.Fields):
    """Robust accuracy over the held-out scenes against searches over one control."""

    control: str
    before: Share
    stronger_before: Share = Field(
        description="before, against the search `stronger_search`"
    )
    after: Share
    stronger: Share = Field(description="after, against the search `stronger_search`")


class TrainingRound(results.Fields):
    """One round of search and training.

    It is evaluated on other scenes in the training's environments.
    """

    lessons: int = Field(description="views that it was trained on")
    part: float = Field(
        description="of the way from the weights that were given to "
        "the trained ones, in 0 to 1"
    )
    clean: float = Field(description="share of plain pictures that are right")
    robust: float = Field(
        description="share of the worst pictures, searched for against these weights"
    )
    is_selected: bool = Field(description="whether its weights are the result")


class SplitSide(results.Fields):
    """One part of the split.

    No object is in two parts, and no environment is in the held-out part and another.
    """

    objects: list[str]
    environments: list[str]
    scenes: int = Field(description="of those held out, a fourth is attacked")
    views: int


class HardenResult(views.InNotebook, RunResult):
    """How robust a model was, and how robust it is after training on worst cases."""

    command: ClassVar[str] = "harden"

    objects: list[str]
    model: str
    task: str = Field(description="what judges the predictions")
    before: Share | None = Field(
        description="held-out scenes that are right and in which no search over any "
        "control has found a wrong "
        "prediction; null if it was interrupted, as are the others"
    )
    after: Share | None = Field(
        description="the same, of the hardened model, searched again"
    )
    clean_before: Share | None = Field(
        description="plain renders of held-out scenes that are right"
    )
    clean_after: Share | None
    gained: int | None = Field(
        default=None,
        description="held-out scenes that are robust after and were not before; null "
        "if it was interrupted",
    )
    lost: int | None = Field(
        default=None,
        description="held-out scenes that were robust before and are not after",
    )
    p: float | None = Field(
        default=None,
        description="how likely it is by chance that one is so much larger, in further "
        "scenes of the same objects: "
        "McNemar's exact test over scenes. Of other objects it says nothing",
    )
    table: list[HardenedControl]
    search: str = Field(
        description="policy and steps of the searches of `before` and `after`"
    )
    stronger_search: str = Field(
        description="another policy with three times the steps"
    )
    split: dict[str, SplitSide] = Field(
        description="by side: `training`, `further training`, `validation`, `held out`"
    )
    rounds: list[TrainingRound]
    hardened: str | None = Field(
        description="what `model` takes to load the hardened "
        "one; null if nothing was kept"
    )
    weights: str | None = Field(description="the hardened weights, safetensors")
    pictures: str | None = Field(
        description="folder of the pictures of the training, a folder for each class"
    )
    shared: results.SharedWork | None = Field(
        default=None,
        description="how [workers](cluster.md) did that shared the work; "
        "absent without",
    )
    warnings: list[str] = Field(description="sentences that a reader has to know")

    @property
    def brief(self) -> str:
        """How many scenes are robust after and before; empty if that is unknown."""
        if self.before is None or self.after is None:
            return ""
        return (
            f"robust in {self.after.right} of {self.after.count} scenes, before "
            f"{self.before.right}"
        )


ROBUST_NOTE = (
    "Robust: the plain picture of a held-out scene is right, and the search finds no "
    "wrong one. 95 % intervals over scenes: Clopper-Pearson; of plain pictures, two of "
    "each scene, by bets. Scenes are of the objects that are named: intervals and p "
    "say "
    "nothing of other objects."
)
TRAINING_NOTE = (
    "Round 0 is the model as it was. Weights are part of the way from those to the "
    "trained ones. Judged on scenes in the training's environments on which it was not "
    "trained."
)
HEADS = ("on held-out scenes", "before", "95 % interval", "after", "95 % interval")
ROUND_COLUMNS: Mapping[str, views.Column] = {
    "round": "{0[0]}",
    "views trained on": "{0[1].lessons}",
    "part of the way": lambda row: wording.percent(row[1].part),
    "plain pictures right": lambda row: wording.percent(row[1].clean),
    "worst pictures right": lambda row: wording.percent(row[1].robust),
    "kept": lambda row: "yes" if row[1].is_selected else "",
}
SPLIT_COLUMNS: Mapping[str, views.Column] = {
    "side": "{0[0]}",
    "objects": lambda row: ", ".join(row[1].objects),
    "environments": lambda row: ", ".join(row[1].environments),
    "scenes": "{0[1].scenes}",
    "views": "{0[1].views}",
}

ShareChanges = Mapping[str, tuple[Share | None, Share | None]]
"""Fractions before and after, by what they are of."""


def make_harden_view(result: HardenResult) -> ShownResult:
    """Return the view of a hardening.

    The page has all tables; the terminal has the text, the facts and the first table.
    """
    facts = {
        "model": result.model,
        "searched with": result.search,
        "stronger": result.stronger_search,
        "load it with": f"model={result.hardened}" if result.hardened else "",
        "weights": result.weights or "",
        "pictures": result.pictures or "",
    }
    sections = [
        _make_robustness_part(result),
        ResultPart.make_table(
            enumerate(result.rounds),
            ROUND_COLUMNS,
            title="The training",
            note=TRAINING_NOTE,
            only="page",
        ),
        ResultPart.make_table(
            result.split.items(),
            SPLIT_COLUMNS,
            title="What it was trained and measured on",
            only="page",
        ),
    ]
    return ShownResult(
        _summarize(result),
        sections,
        facts,
        about=[",".join(result.objects), ", ".join(result.controls)],
    )


def _make_robustness_part(result: HardenResult) -> ResultPart:
    """Return the table of fractions before and after, with a chart if it has rows."""
    shares = _list_shares(result)
    chart: dict[str, Any] = {}
    if shares:
        chart = {
            "draw": partial(_draw_shares, shares=shares, model=result.model),
            "size": (6.4, 1.4 + 0.45 * len(shares)),
        }
    return ResultPart(
        "Before and after",
        heads=HEADS,
        rows=[
            [name, *_share_cells(before), *_share_cells(after)]
            for name, (before, after) in shares.items()
        ],
        note=ROBUST_NOTE,
        height=110 + 44 * len(shares),
        **chart,
    )


def _list_shares(
    result: HardenResult,
) -> dict[str, tuple[Share | None, Share | None]]:
    """Return the fractions of right images before and after, by what they are of."""
    shares: dict[str, tuple[Share | None, Share | None]] = {}
    for row in result.table:
        shares[f"robust to {row.control}"] = (row.before, row.after)
        shares[f"robust to {row.control}, stronger search"] = (
            row.stronger_before,
            row.stronger,
        )
    if len(result.table) > 1:
        shares["robust to each"] = (result.before, result.after)
    if result.clean_after is not None:
        shares["plain pictures right"] = (result.clean_before, result.clean_after)
    return shares


def _share_cells(share: Share | None) -> list[str]:
    """Return a fraction and its interval as texts, empty ones if it is unknown."""
    if share is None:
        return ["", ""]
    return [wording.percent(share.accuracy), wording.format_interval(share.interval)]


def _draw_shares(axes: Any, shares: ShareChanges, model: str) -> None:
    """Draw fractions before and after as bars with intervals."""
    bars = {
        name: [
            None if share is None else (share.accuracy, share.interval)
            for share in before_and_after
        ]
        for name, before_and_after in shares.items()
    }
    figures.draw_fractions(axes, bars, ("before", "after"), (figures.RED, figures.BLUE))
    axes.set(xlabel="share that is right, with 95 % interval")
    axes.set_title(f"Held-out scenes: {wording.shorten_name(model)}")
    axes.figure.legend(loc="outside lower center", ncols=2)


def _summarize(result: HardenResult) -> str:
    """Describe in words how robust and how accurate the model was and is.

    The run may have stopped before all of it was measured.
    """
    before = result.before
    after = result.after
    clean_before = result.clean_before
    clean_after = result.clean_after
    if before is None or after is None or clean_before is None or clean_after is None:
        return "Stopped before the hardened model was measured."
    text = (
        f"Of {after.count} held-out scenes the searches leave {after.right} right, "
        f"before {before.right}; "
        f"of {clean_after.count} plain pictures {clean_after.right} are right, before "
        f"{clean_before.right}."
    )
    for when, share in (("Now", clean_after), ("Before", clean_before)):
        outcomes = wording.format_outcomes(share.outcomes, result.task)
        if outcomes:
            text += f" {when}, the other plain pictures are {outcomes}."
    # `lost` is None if the scenes before and after cannot be compared one by one.
    if result.lost is not None:
        text += (
            f" Scene by scene: {result.gained} got better, {result.lost} worse "
            f"(p = {result.p:.2g}, for scenes of these objects; of other objects it "
            "says nothing)."
        )
    return text


def make_harden_claims(result: HardenResult) -> Iterator[views.Claim]:
    """Yield the shares of held-out scenes without a failure."""
    for when, share in (("Before", result.before), ("After hardening", result.after)):
        if share is not None:
            extent = {
                "what": "held-out scenes",
                "count": share.right,
                "of": share.count,
                "interval": share.interval,
                "counts_right": True,
            }
            text = (
                f"{when}, the searches ({result.search}) found no failure in "
                f"{share.right} of {share.count} "
                f"({wording.percent(share.accuracy)}, 95 % interval "
                f"{wording.format_interval(share.interval)}) held-out "
                "scenes. This does not show that there is none."
            )
            yield views.Claim.from_values(
                {"kind": "measured", "statement": text, "extent": extent}
            )
